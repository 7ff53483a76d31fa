"""Iterative reconstruction from the command line: what it writes, refuses, keeps and resumes."""

import json

import numpy as np
import pytest
from alignments import keep_motion

from clra.app.simulation import paper_like
from clra.errors import ClraWarning
from clra.io.alignment_file import read_alignment
from clra.io.scan_files import read_scan, write_scan
from clra.io.volumes.volume_files import read_volume, write_volume
from clra.methods.reconstruction.iterative import Multigrid
from clra.methods.reconstruction.reconstruct import reconstruct
from clra.model.grid import default_grid
from clra.model.motion import Motion
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.model.scan import Scan
from clra.ops.streaming.stream import Stream
from tests.app.test_cli import refused


def test_osem_tr_starts_from_a_volume(clra, scan_file, tmp_path):
    first, second = tmp_path / "a.h5", tmp_path / "b.h5"
    code, out, err = clra(
        "reconstruct", scan_file, "-o", first, "--method", "osem-tr", "--passes", 1, "--subsets", 3
    )
    assert code == 0 and str(first) in out, err
    again = ("--initial", first, "--i0", 5000, "--passes", 1, "--update", "optimal")
    code, out, err = clra("reconstruct", scan_file, "-o", second, "--method", "osem-tr", *again)
    assert code == 0, err
    (one, grid), (other, _) = read_volume(first), read_volume(second)
    assert one.shape == default_grid(read_scan(scan_file).geometry).shape
    assert one.min() >= 0 and not np.array_equal(one, other)
    wrong = tmp_path / "wrong.h5"
    write_volume(wrong, one[1:], grid.slab(1, grid.shape[0]))
    done = clra("reconstruct", scan_file, "-o", second, "--method", "osem-tr", "--initial", wrong)
    refused(done, 2, wrong, "/volume", one[1:].shape, one.shape)


def test_align_by_imgr_writes_motion_volume_and_report(clra, scan_file, tmp_path):
    motion, volume, page = (tmp_path / name for name in ("m.h5", "v.h5", "r.html"))
    outputs = ("-o", motion, "--volume", volume, "--report", page)
    code, out, err = clra(
        "align", scan_file, *outputs, "--method", "imgr", "--schedule", "HR-FR", "--json"
    )
    assert code == 0, err
    told = json.loads(out)
    assert told["volume"] == str(volume)
    assert [i["level"] for i in told["history"]][:2] == ["HR", "FR"]
    assert all(i["misfit"] > 0 for i in told["history"])
    assert read_volume(volume)[0].std() > 0
    text = page.read_text(encoding="utf-8")
    assert "without and with alignment inside" in text
    assert "Correction of each radiograph" in text


@pytest.fixture
def stopping(monkeypatch):
    """Press Ctrl-C after so many levels."""

    def after(levels):
        reports = []

        def report(self, stage, done, total):
            if levels is not None and len(reports) >= levels:
                raise KeyboardInterrupt
            if "misfit" in stage:
                reports.append(stage)

        monkeypatch.setattr(Stream, "report", report)

    return after


def test_resumed_to_the_bit(clra, scan_file, tmp_path, stopping):
    options = ("--method", "imgr", "--align", "--levels", "HR-FR")
    whole, out = tmp_path / "whole.h5", tmp_path / "volume.h5"
    code, _, err = clra("reconstruct", scan_file, "-o", whole, *options)
    assert code == 0, err

    refused(clra("reconstruct", scan_file, "-o", out, *options, "--resume"), 2, "not found")
    stopping(1)
    done = clra("reconstruct", scan_file, "-o", out, *options)
    refused(done, 130, "volume.h5.resume", "keeps cycle 1 up to HR", "--resume")
    assert not out.exists()
    assert np.load(tmp_path / "volume.h5.resume" / "1.npy").std() > 0
    stopping(None)
    done = clra("reconstruct", scan_file, "-o", out, "--method", "imgr", "--resume")
    refused(done, 2, "state.json", "expected")
    # The file is the same, but it is read with another geometry.
    done = clra("reconstruct", scan_file, "-o", out, *options, "--rotation", "cw", "--resume")
    refused(done, 2, "state.json", "expected")
    code, told, err = clra("reconstruct", scan_file, "-o", out, *options, "--resume", "--json")
    assert code == 0, err
    assert [step["level"] for step in json.loads(told)["steps"]][:2] == ["HR", "FR"]
    np.testing.assert_array_equal(read_volume(out)[0], read_volume(whole)[0])
    assert not (tmp_path / "volume.h5.resume").exists()


def test_another_motion_is_not_gone_on_with(clra, scan_file, tmp_path, stopping):
    out, first, second = (tmp_path / name for name in ("volume.h5", "one.h5", "two.h5"))
    scan = read_scan(scan_file)
    keep_motion(first, Motion.identity(scan.views))
    keep_motion(second, Motion(shift_u=np.ones(scan.views), shift_v=np.zeros(scan.views)))
    options = ("reconstruct", scan_file, "-o", out, "--method", "imgr", "--levels", "HR-FR")
    stopping(1)
    assert clra(*options, "--motion", first)[0] == 130
    stopping(None)
    refused(clra(*options, "--motion", second, "--resume"), 2, "state.json", "expected")
    assert clra(*options, "--motion", first, "--resume")[0] == 0


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        (["--subsets", 3], ["subsets", "fbp does not have"]),
        (["--method", "osem-tr", "--levels", "QR-HR-FR"], ["levels", "osem-tr does not have"]),
        (["--method", "fbp", "--resume"], ["--resume", "expected osem-tr, imgr or --align"]),
        (["--method", "osem-tr", "--update", "newton"], ["update", "'newton'", "paraboloid"]),
        (["--method", "osem-tr", "--i0", -5], ["i0", "found -5", "photons"]),
        (["--method", "osem-tr", "--subsets", 25], ["subsets", "found 25", "at most 24"]),
        (["--method", "imgr", "--levels", "FR-HR"], ["levels", "'FR-HR'", "'QR-HR-FR'"]),
    ],
)
def test_wrong_options_are_refused(clra, scan_file, tmp_path, options, parts):
    out = tmp_path / "v.h5"
    refused(clra("reconstruct", scan_file, "-o", out, *options), 2, *parts)
    assert not out.exists()


def test_a_volume_of_other_methods_is_refused(clra, scan_file, tmp_path):
    done = clra("align", scan_file, "-o", tmp_path / "m.h5", "--volume", tmp_path / "v.h5")
    refused(done, 2, "--volume", "expected imgr")


def test_an_alignment_goes_on(clra, scan_file, tmp_path, monkeypatch):
    out, folder = tmp_path / "m.h5", tmp_path / "m.h5.resume"
    command = ("align", scan_file, "-o", out, "--schedule", "3HR")

    def stop(error):
        def report(self, stage, done, total):
            if (folder / "1.npz").exists():
                raise error

        monkeypatch.setattr(Stream, "report", report)

    stop(MemoryError("too many voxels"))
    done = clra(*command)
    refused(done, 1, "too many voxels; ", folder, "keeps 1 iteration, the last at HR, --resume")
    assert not out.exists()
    stop(KeyboardInterrupt())
    done = clra(*command, "--resume")
    refused(done, 130, out, "keeps what 1 iteration", "--resume goes on")
    assert done[2].count("--resume") == 1
    assert len(read_alignment(out).history) == 1
    monkeypatch.undo()
    assert clra(*command, "--resume", "--quiet") == (0, "", "")
    assert len(read_alignment(out).history) == 3 and not folder.exists()


@pytest.mark.filterwarnings("default")
def test_imgr_crops_masked_detectors_and_tells_of_truncation(clra, tmp_path):
    geometry = paper_like("circular", 24, (24, 33))
    wide = Ellipsoids([[0.4, 0.2, 0]], [[1.5, 1.5, 1.5]], [0.5]).line_integrals(geometry)
    mask = np.ones(geometry.shape, np.bool_)
    mask[:, :4] = False
    path, out = tmp_path / "masked.nxs", tmp_path / "v.h5"
    write_scan(path, Scan(wide, geometry, mask=mask))
    options = ("--method", "imgr", "--levels", "HR-FR")
    code, _, err = clra("reconstruct", path, "-o", out, *options)
    assert code == 0 and "reaches beyond the detector" in err
    volume, grid = read_volume(out)
    assert grid == default_grid(read_scan(path).cropped().geometry)
    with pytest.warns(ClraWarning, match="reaches beyond the detector"):
        expected = reconstruct(read_scan(path), "imgr", options=Multigrid(levels="HR-FR"))
    np.testing.assert_array_equal(volume, expected)
