"""Commands in this process: what they print, refuse and write."""

import json
import os
import re
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from alignments import keep_motion

from clra.app import demonstration
from clra.app.simulation import paper_like, sample
from clra.io.alignment_file import read_alignment, write_alignment
from clra.io.nxtomo.writer import write_nxtomo
from clra.io.scan_files import read_scan, write_scan
from clra.io.volumes.volume_files import read_volume
from clra.methods.alignment.autofocus import Focus
from clra.methods.alignment.result import AlignmentInterrupted
from clra.model.detector_pose import with_detector
from clra.model.grid import default_grid
from clra.model.motion import Motion
from clra.model.scan import Scan

COMMANDS = (
    "devices", "info", "import", "simulate", "align", "reconstruct", "correct", "report",
    "export-motion", "run", "config", "demo",
)  # fmt: skip


def refused(done, status, *parts):
    code, out, err = done
    assert code == status, err
    assert out == ""
    *progress, line = err.splitlines()
    assert line.startswith("interrupted: " if status == 130 else "error: ") and err.endswith("\n")
    assert all(re.fullmatch(r".*: \d+ of \d+.*", told) for told in progress)
    for part in parts:
        assert str(part) in line


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_examples_and_the_common_options(clra, command):
    code, out, _ = clra(command, "--help")
    assert code == 0
    assert re.search(rf"^  Examples:\n    clra {command}", out, re.MULTILINE)
    for option in ("--device", "--quiet", "--json"):
        assert option in out


def test_help_lists_the_commands(clra):
    code, out, _ = clra("--help")
    assert code == 0
    assert re.findall(r"^  ([a-z-]+)  ", out.partition("Commands:")[2], re.MULTILINE) == list(
        COMMANDS
    )
    assert clra()[1] == out
    code, out, _ = clra("--version")
    assert code == 0 and re.fullmatch(r"clra \d+\.\d+\.\d+\n", out)


def test_devices(clra):
    code, out, _ = clra("devices", "--json")
    told = json.loads(out)
    assert code == 0 and told["taken"] in [device["index"] for device in told["devices"]]
    code, out, _ = clra("devices")
    assert code == 0 and out.startswith("* ") and len(out.splitlines()) == len(told["devices"])


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["devices", "--nonsense"], "--nonsense"),
        (["nonsense"], "nonsense"),
        (["align", "scan.nxs"], "--output"),
        (["reconstruct"], "SCAN"),
        (["simulate", "s.nxs", "--views", "many"], "many"),
    ],
)
def test_wrong_usage_is_one_line(clra, arguments, part):
    refused(clra(*arguments), 2, part, "--help)")


def test_a_device_that_is_not_there_fails_with_what_there_is(clra):
    refused(clra("devices", "--device", "abacus"), 1, "'abacus'", "found")


@pytest.mark.filterwarnings("default")
def test_without_any_device_there_is_advice_and_info_still_describes(
    clra, monkeypatch, scan_file, tmp_path
):
    monkeypatch.setattr("clra.ops.runtime.devices._all_devices", list)
    refused(clra("devices"), 1, "PoCL")
    refused(clra("align", scan_file, "-o", tmp_path / "m.h5"), 1, "PoCL")
    code, out, err = clra("info", scan_file)
    assert code == 0 and "space-filling" in out
    assert "warning: no times" in err and "PoCL" in err
    told = json.loads(clra("info", scan_file, "--json")[1])
    assert told["levels"][0]["iteration_s"] is None


def test_bad_input_is_refused_before_work(clra, scan_file, motion_file, tmp_path):
    volume = tmp_path / "v.h5"
    refused(clra("info", tmp_path / "none.nxs"), 2, "none.nxs")
    refused(clra("info", motion_file), 2, motion_file)
    for suffix in ("jpg", "txt"):
        refused(clra("reconstruct", scan_file, "-o", tmp_path / f"v.{suffix}"), 2, suffix, ".h5")
    refused(
        clra("reconstruct", scan_file, "-o", volume, "--motion", motion_file, "--align"),
        2,
        "--motion",
        "--align",
    )
    refused(clra("reconstruct", scan_file, "-o", volume, "--method", "magic"), 2, "magic", "fbp")
    refused(clra("reconstruct", scan_file, "-o", tmp_path / "no" / "v.h5"), 1, "make the folder")
    refused(clra("align", scan_file, "-o", volume, "--schedule", "2XR"), 2, "2XR")
    refused(clra("align", scan_file, "-o", volume, "--estimate", "all"), 2, "all")
    refused(clra("align", scan_file, "-o", tmp_path / "no" / "m.h5"), 1, "make the folder")
    refused(clra("report", scan_file, "-o", tmp_path / "r.html"), 2, scan_file)
    keep_motion(tmp_path / "short.h5", Motion.identity(7))
    for arguments in (
        ["reconstruct", scan_file, "-o", volume, "--motion", tmp_path / "short.h5"],
        ["correct", scan_file, "-o", tmp_path / "c.nxs", "--motion", tmp_path / "short.h5"],
        ["report", tmp_path / "short.h5", "-o", tmp_path / "r.html", "--scan", scan_file],
    ):
        refused(clra(*arguments), 2, "short.h5", "7 views", "24")
    keep_motion(tmp_path / "none.h5", Motion.identity(24), flagged=range(24))
    for command, out in (("reconstruct", volume), ("correct", tmp_path / "c.nxs")):
        found = clra(command, scan_file, "-o", out, "--motion", tmp_path / "none.h5")
        refused(found, 2, "none.h5", "/motion/flagged", "all 24 views")
    left = sorted(file.name for file in tmp_path.iterdir())
    assert left == ["motion.h5", "none.h5", "short.h5"]


def test_simulate_writes_a_scan_that_knows_its_motion(clra, tmp_path):
    out = tmp_path / "s.nxs"
    options = ["--trajectory", "helix", "--motion", "smooth", "--shift", "-3,2", "--views", 13]
    code, text, _ = clra("simulate", out, *options, "--detector", "21x17", "--noise", 500, "--json")
    told = json.loads(text)
    assert code == 0 and told["views"] == 13 and told["largest_shift"] < 5
    scan = read_scan(out)
    assert scan.shape == (13, 21, 17)
    assert scan.truth is not None
    assert np.abs(scan.truth.shift_u).max() == pytest.approx(told["largest_shift"], abs=2)
    code, text, err = clra("simulate", out, "--views", 4, "--detector", "9x9", "--quiet")
    assert (code, text, err) == (0, "", "")
    refused(clra("simulate", out, "--detector", "9"), 2, "--detector", "'9'")
    refused(clra("simulate", out, "--trajectory", "spiral"), 2, "spiral", "helix")
    assert read_scan(out).views == 4  # what stood there before stands there still


def test_import_makes_a_scan_of_frames(clra, tmp_path):
    random = np.random.default_rng(0)
    frames = random.integers(200, 900, (5, 6, 7)).astype("<u2")
    frames.tofile(tmp_path / "frames.raw")
    np.full((1, 6, 7), 1000, "<u2").tofile(tmp_path / "flat.raw")
    (tmp_path / "angles.txt").write_text("0\n72\n144\n216\n288\n", encoding="ascii")
    options = [
        "--angles", tmp_path / "angles.txt", "--source-distance", 10, "--detector-distance", 90,
        "--pixel-size", 0.1, "--shape", "6x7", "--flat", tmp_path / "flat.raw",
    ]  # fmt: skip
    out = tmp_path / "scan.nxs"
    code, text, _ = clra("import", tmp_path / "frames.raw", *options, "-o", out)
    told = "5 radiographs of 6 x 7, 1 flats, 0 darks; the sample turns from 0 to 288 degrees"
    assert code == 0 and text == f"wrote {out}: {told}\n"
    scan = read_scan(out)
    np.testing.assert_allclose(scan.read(0, 5), -np.log(frames / 1000.0), rtol=1e-5, atol=1e-6)
    assert scan.geometry.source_to_detector == pytest.approx(100)
    (tmp_path / "angles.txt").write_text("0\n72\n", encoding="ascii")
    refused(clra("import", tmp_path / "frames.raw", *options, "-o", out), 2, "angles.txt", "2", "5")


def test_info_tells_size_and_cost(clra, scan_file):
    code, out, _ = clra("info", scan_file)
    assert code == 0
    for part in ("space-filling", "41 rows x 33 columns", "FR", "QR", "iteration"):
        assert part in out
    code, out, _ = clra("info", scan_file, "--json")
    told = json.loads(out)
    assert told["scan"]["views"] == 24 and told["levels"][0]["level"] == "FR"
    assert told["scan"]["path"]["kind"] == "space-filling"


def test_align_to_a_reference_scan(clra, scan, scan_file, tmp_path):
    still = scan.geometry
    quick, motion = tmp_path / "quick.nxs", tmp_path / "drift.h5"
    write_scan(quick, Scan(sample("spheres", still).line_integrals(still), still, name="quick"))
    code, out, err = clra(
        "align", scan_file, "-o", motion, "--method", "reference", "--reference", quick, "--json"
    )
    assert code == 0, err
    assert json.loads(out)["schedule"] == "reference"
    with h5py.File(motion) as file:
        assert "--method reference" in file.attrs["command"]
        assert f"--reference {quick}" in file.attrs["command"]
    refused(clra("align", scan_file, "-o", motion, "--method", "reference"), 2, "reference")


def test_an_auto_focus_goes_with_the_motion(clra, monkeypatch, scan_file, tmp_path):
    geometry = with_detector(read_scan(scan_file).geometry, offset_u=2.0, tilt=0.01)
    monkeypatch.setattr(
        "clra.methods.alignment.autofocus.autofocus", lambda *_, **__: Focus(2.0, 0.01, 1.25)
    )
    motion, fixed = tmp_path / "motion.h5", tmp_path / "fixed.nxs"
    code, out, err = clra("align", scan_file, "-o", motion, "--schedule", "1HR", "--autofocus")
    assert code == 0, err
    assert "axis 2 pixel aside, image turned by 0.572958 degree" in out
    assert clra("correct", scan_file, "--motion", motion, "-o", fixed)[0] == 0
    np.testing.assert_allclose(
        read_scan(fixed).geometry.u, geometry.u, atol=1e-6 * np.abs(geometry.u).max()
    )
    with h5py.File(motion, "r+") as file:
        file.attrs["detector_tilt"] = "much"
    refused(clra("correct", scan_file, "--motion", motion, "-o", fixed), 2, "@detector", "much")


def test_align_reconstruct_correct_report(clra, scan_file, tmp_path):
    motion, page = tmp_path / "m.h5", tmp_path / "r.html"
    code, out, err = clra(
        "align", scan_file, "-o", motion, "--schedule", "1HR", "--report", page, "--json"
    )
    assert code == 0, err
    told = json.loads(out)
    assert told["views"] == 24 and len(told["history"]) == 1 and told["mae_u"] > 0
    with h5py.File(motion) as file:
        assert file["motion/shift_u"].shape == (24,)
        assert file.attrs["estimate"] == "shift+scale"
    assert "Before and after" in page.read_text(encoding="utf-8")
    for name in ("v.h5", "v.tif"):
        code, out, err = clra("reconstruct", scan_file, "-o", tmp_path / name, "--motion", motion)
        assert code == 0 and str(tmp_path / name) in out, err
    volume, grid = read_volume(tmp_path / "v.h5")
    expected = default_grid(read_scan(scan_file).geometry)
    assert volume.shape == expected.shape and grid.voxel_size == pytest.approx(expected.voxel_size)
    assert volume.std() > 0
    code, out, err = clra(
        "correct", scan_file, "--motion", motion, "-o", tmp_path / "c.nxs", "--quiet"
    )
    assert (code, out, err) == (0, "", "")
    assert read_scan(tmp_path / "c.nxs").shape == (24, 41, 33)
    code, out, err = clra("report", motion, "-o", tmp_path / "short.html")
    assert code == 0 and "--scan SCAN" in (tmp_path / "short.html").read_text(encoding="utf-8")


def test_alignment_goes_on_from_a_motion(clra, monkeypatch, scan_file, tmp_path):
    first, last = tmp_path / "first.h5", tmp_path / "last.h5"
    monkeypatch.setattr(
        "clra.methods.alignment.autofocus.autofocus", lambda *_, **__: Focus(2.0, 0.01, 1.25)
    )
    assert clra("align", scan_file, "-o", first, "--schedule", "2HR", "--autofocus")[0] == 0
    code, out, err = clra(
        "align", scan_file, "-o", last, "--schedule", "1HR", "--start", first, "--json"
    )
    assert code == 0, err
    begun, ended = read_alignment(first), read_alignment(last)
    assert ended.history[:2] == begun.history and len(json.loads(out)["history"]) == 3
    assert ended.about["detector_tilt"] == begun.about["detector_tilt"] == "0.572958 degree"
    assert (
        ended.command == f"clra align {scan_file} -o {last} --schedule 1HR --start {first} --json"
    )
    # It begins where the other ended: were it at no motion, it would move by most of it again.
    moved = np.abs(ended.motion.shift_v - begun.motion.shift_v).mean()
    assert moved < 0.3 * np.abs(begun.motion.shift_v).mean()
    assert ended.history[2].update_v_median < 0.3 * begun.history[0].update_v_median
    for option in (["--autofocus"], ["--reference", scan_file]):
        told = clra("align", scan_file, "-o", last, "--start", first, *option)
        refused(told, 2, "--start", option[0], "found both")
    refused(clra("align", scan_file, "-o", last, "--start", tmp_path / "none.h5"), 2, "none.h5")


def test_ctrl_c_keeps_the_finished_iterations(clra, monkeypatch, result, scan_file, tmp_path):
    def interrupted(*_, **__):
        raise AlignmentInterrupted(result)

    monkeypatch.setattr("clra.methods.alignment.align.align", interrupted)
    motion = tmp_path / "m.h5"
    told = clra("align", scan_file, "-o", motion)
    refused(told, 130, "m.h5", "2 iterations", "HR", f"--start {motion}")
    with h5py.File(motion) as file:
        np.testing.assert_array_equal(file["motion/shift_u"], result.motion.shift_u)
        assert file.attrs["interrupted"] == "yes"


def test_ctrl_c_before_that_leaves_nothing(clra, monkeypatch, scan_file, tmp_path):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("clra.methods.alignment.align.align", interrupted)
    refused(clra("align", scan_file, "-o", tmp_path / "m.h5"), 130, "nothing was written")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_noticed_before_work(clra, monkeypatch, scan_file, tmp_path):
    full = shutil._ntuple_diskusage(100, 99, 1)
    monkeypatch.setattr("clra.io.atomic.shutil.disk_usage", lambda path: full)
    refused(clra("reconstruct", scan_file, "-o", tmp_path / "v.h5"), 1, "v.h5", "free some space")


@pytest.mark.filterwarnings("ignore:.*other radiographs")
def test_nothing_that_is_read_is_overwritten(clra, scan_file, motion_file, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    shutil.copy(scan_file, "scan.nxs")
    Path("link.nxs").symlink_to("scan.nxs")
    tifffile.imwrite("frame.tif", np.ones((2, 4, 6), np.uint16))
    Path("angles.txt").write_text("0\n90\n")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    motion, scanner = ("--motion", motion_file), ("--pixel-size", 1, "--parallel")
    for arguments in (
        ("align", "scan.nxs", "-o", "scan.nxs"),
        ("align", "scan.nxs", "-o", "link.nxs"),
        ("align", "scan.nxs", "-o", "m.h5", "--reference", "link.nxs", "--report", "./link.nxs"),
        ("align", "scan.nxs", "-o", "m.h5", "--report", tmp_path / "m.h5"),
        ("align", "scan.nxs", "-o", "m.h5", "--start", motion_file, "--report", motion_file),
        ("correct", "scan.nxs", *motion, "-o", "scan.nxs"),
        ("correct", "scan.nxs", *motion, "-o", motion_file),
        ("reconstruct", "scan.nxs", *motion, "-o", motion_file),
        ("report", motion_file, "-o", motion_file),
        ("report", motion_file, "--scan", "scan.nxs", "-o", "scan.nxs"),
        ("import", "frame.tif", "--angles", "0:90:2", *scanner, "-o", "frame.tif"),
        ("import", "frame.tif", "--angles", "angles.txt", *scanner, "-o", "angles.txt"),
    ):
        refused(clra(*arguments), 2, "cannot write", "give another name")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.filterwarnings("default")
def test_a_motion_found_with_another_geometry_is_warned_of(clra, record, scan_file, tmp_path):
    path, out = tmp_path / "m.h5", tmp_path / "c.nxs"
    about = {**record.about, "geometry": "--rotation cw"}
    write_alignment(path, replace(record, about=about))
    for options in ((), ("--source-distance", 5.0), ("--rotation", "cw")):
        code, _, err = clra("correct", scan_file, "--motion", path, "-o", out, "-q", *options)
        assert code == 0
        assert err.count("estimated with --rotation cw, and now") == ("cw" not in options)
        assert all(line.startswith("warning: ") for line in err.splitlines())


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    ("counts", "told"),
    [
        (lambda t: 20 + 1000 * t, ""),
        (lambda t: t, "are not brighter than the darks"),
        (lambda t: 20 - 1000 * np.log(t), "more than 1.5 times as bright as the open beam"),
    ],
    ids=["counts", "transmission", "line integrals"],
)
def test_radiographs_that_the_flats_are_not_of_are_noticed(clra, counts, told, tmp_path):
    # Sorted, so that bright pixels lie side by side as they do in radiographs.
    transmission = np.sort(np.random.default_rng(0).uniform(0.1, 1, (9, 16, 18)), axis=2)
    geometry = paper_like("circular", 9, (16, 18))
    frame = np.ones((1, 16, 18))
    scan = tmp_path / "scan.nxs"
    flats, darks = 1020 * frame, 20 * frame
    write_nxtomo(scan, counts(transmission), geometry, flats=flats, darks=darks)
    code, _, err = clra("info", scan, "-q")
    assert code == 0, err
    assert told in err and err.count("\n") == bool(told)


@pytest.mark.filterwarnings("default")
def test_the_motion_of_another_scan_is_warned_of(clra, record, scan_file, tmp_path):
    path = tmp_path / "m.h5"
    keep_motion(path, record.motion, checksum="sha256:other")
    code, _, err = clra("correct", scan_file, "--motion", path, "-o", tmp_path / "c.nxs", "-q")
    assert code == 0
    assert err.startswith("warning: ") and "other radiographs" in err and err.count("\n") == 1


def test_demo_shows_that_it_works(clra, monkeypatch, tmp_path):
    small = partial(demonstration.run_demo, views=120, detector=(96, 72))
    monkeypatch.setattr("clra.app.demonstration.run_demo", small)
    code, out, err = clra("demo", "--output", tmp_path / "d", "--json")
    assert code == 0, err
    told = json.loads(out)
    assert told["gauge_free_mae_u"] < 0.5 and told["gauge_free_mae_v"] < 1
    names = {file.name for file in (tmp_path / "d").iterdir()}
    assert names == {"scan.nxs", "motion.h5", "before.h5", "after.h5", "report.html"}


def test_files_that_are_there_are_kept_where_that_is_wanted(clra, scan_file, tmp_path):
    out = tmp_path / "v.h5"
    out.write_text("old")
    done = clra("reconstruct", scan_file, "-o", out, "--no-overwrite")
    refused(done, 2, "v.h5", "it is there already", "--no-overwrite")
    assert out.read_text() == "old" and os.listdir(tmp_path) == ["v.h5"]
    assert clra("reconstruct", scan_file, "-o", tmp_path / "w.h5", "--no-overwrite")[0] == 0


@pytest.mark.filterwarnings("ignore:.*other radiographs")
def test_outputs_tell_the_command_that_made_them(clra, scan_file, motion_file, record, tmp_path):
    volume, corrected = tmp_path / "a volume.h5", tmp_path / "c.nxs"
    for command, out in (("reconstruct", volume), ("correct", corrected)):
        assert clra(command, scan_file, "-o", out, "--motion", motion_file)[0] == 0
        with h5py.File(out) as file:
            told = dict(file.attrs)
        assert told["command"].startswith(f"clra {command} {scan_file} -o ")
        assert told["scan_checksum"] == read_scan(scan_file).checksum()
        assert told["alignment_checksum"] == record.checksum_of_motion()


@pytest.mark.filterwarnings("default")
def test_json_tells_what_was_warned_of(clra, record, scan_file, tmp_path):
    path = tmp_path / "m.h5"
    keep_motion(path, record.motion, checksum="sha256:other")
    options = ("--motion", path, "-o", tmp_path / "c.nxs", "--json")
    code, out, err = clra("correct", scan_file, *options)
    assert code == 0, err
    (told,) = json.loads(out)["warnings"]
    assert told["code"] == "scan" and "other radiographs" in told["message"]
    assert told["severity"] == "warning" and told["message"] in err
