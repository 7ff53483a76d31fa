"""The command that corrects, by workers: the file is the one that it writes alone."""

import h5py
import numpy as np
import pytest

from clra.methods import correction
from clra.ops.runtime.devices import choose_device


@pytest.mark.filterwarnings("ignore:.*other radiographs:clra.errors.ClraWarning")
@pytest.mark.parametrize("option", ["--cluster=local:1", "--device=all"])
def test_the_file_is_the_same(clra, monkeypatch, scan_file, motion_file, tmp_path, option):
    folder = tmp_path / "out"
    folder.mkdir()
    command = ("correct", scan_file, "--motion", motion_file, "--quiet", "-o")
    code, _, err = clra(*command, folder / "alone.nxs")
    assert code == 0, err
    if "cluster" in option:
        pytest.importorskip("distributed")
    else:
        device = choose_device()
        monkeypatch.setattr(correction, "usable_devices", lambda _: [device, device])
    code, _, err = clra(*command, folder / "shared.nxs", option)
    assert code == 0, err
    assert sorted(path.name for path in folder.iterdir()) == ["alone.nxs", "shared.nxs"]
    with h5py.File(folder / "alone.nxs") as alone, h5py.File(folder / "shared.nxs") as shared:
        for name in ("data", "image_key"):
            path = f"entry/instrument/detector/{name}"
            np.testing.assert_array_equal(shared[path], alone[path])
