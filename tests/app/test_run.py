"""All steps in one go give what the single commands give."""

import json

import h5py
import numpy as np
import pytest
import tifffile

from clra.io.alignment_file import read_alignment
from clra.io.volumes.volume_files import read_volume

CONFIG = """
[import]
angles = "{angles}"
pixel-size = 0.2
source-distance = 40
detector-distance = 60
kind = "line-integrals"
[align]
schedule = "1FR"
"""


@pytest.fixture
def frames(tmp_path, scan):
    """Radiographs of the tiny scan as TIFF, taken for those of a circle."""
    (tmp_path / "frames").mkdir()
    for view, image in enumerate(scan.read(0, scan.views)):
        tifffile.imwrite(tmp_path / "frames" / f"f{view:03}.tif", image)
    angles = tmp_path / "angles.txt"
    np.savetxt(angles, np.arange(scan.views) * 360 / scan.views)
    (tmp_path / "scan.toml").write_text(CONFIG.format(angles=angles))
    return tmp_path


def test_it_is_the_same_as_the_single_commands(clra, frames):
    config = ("--config", frames / "scan.toml", "-q")
    one, all_of_it = frames / "one", frames / "all"
    one.mkdir()
    pattern = frames / "frames" / "*.tif"
    status, out, error = clra("run", pattern, "-o", all_of_it, *config, "--json")
    assert status == 0, error
    assert json.loads(out)["volume"] == str(all_of_it / "volume.h5")
    names = {"scan.nxs", "motion.h5", "volume.h5", "report.html"}
    assert {path.name for path in all_of_it.iterdir()} == names
    clra("import", pattern, "-o", one / "scan.nxs", *config)
    clra("align", one / "scan.nxs", "-o", one / "motion.h5", *config)
    motion = ("--motion", one / "motion.h5")
    clra("reconstruct", one / "scan.nxs", *motion, "-o", one / "volume.h5", *config)
    found, expected = (read_alignment(f / "motion.h5").motion for f in (all_of_it, one))
    assert found == expected
    volumes = [read_volume(folder / "volume.h5")[0] for folder in (all_of_it, one)]
    assert np.array_equal(*volumes)
    with h5py.File(all_of_it / "volume.h5") as file:
        assert file.attrs["command"].startswith("clra reconstruct ")


def test_it_goes_on_where_it_was(clra, frames, scan_file):
    folder = frames / "all"
    config = ("--config", frames / "scan.toml", "-q")
    assert clra("run", scan_file, "-o", folder, *config)[0] == 0
    kept = (folder / "motion.h5").stat().st_mtime_ns
    (folder / "volume.h5").unlink()
    assert clra("run", scan_file, "-o", folder, *config, "--resume")[0] == 0
    assert (folder / "motion.h5").stat().st_mtime_ns == kept
    assert (folder / "volume.h5").exists() and not (folder / "scan.nxs").exists()


def test_a_file_is_no_folder(clra, frames, scan_file):
    status, _, error = clra("run", scan_file, "-o", frames / "scan.toml")
    assert status == 2 and "--output: found a file, expected a folder" in error
