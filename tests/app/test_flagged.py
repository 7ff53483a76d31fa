"""A scan with bad views, as a user meets it: told, listed, and left out of the volume."""

import json
import re

import h5py
import numpy as np
import pytest
from alignments import keep_motion

from clra.app.simulation import paper_like, sample, simulated_motion
from clra.io.alignment_file import read_alignment
from clra.io.scan_files import read_scan, write_scan
from clra.io.volumes.volume_files import read_volume
from clra.model.scan import Scan

VIEWS, BLANK, SATURATED = 60, 11, 40


def spoilt(scan, values):
    pixels = scan.read(0, scan.views).copy()
    pixels[[BLANK, SATURATED]] = np.reshape(values, (2, 1, 1))
    return Scan(pixels, scan.geometry, truth=scan.truth, name="spoilt")


@pytest.fixture(scope="module")
def measured():
    geometry = paper_like("space-filling", VIEWS, (72, 64))
    truth = simulated_motion("random", geometry, shift=(-3.0, 3.0), magnification=0.002)
    moved = geometry.with_motion(truth)
    return Scan(sample("porous", geometry).line_integrals(moved), geometry, truth=truth)


@pytest.fixture(scope="module")
def bad_file(measured, tmp_path_factory):
    path = tmp_path_factory.mktemp("bad") / "bad.nxs"
    write_scan(path, spoilt(measured, [0.0, 9.0]))
    return path


def lines_of(text):
    return dict(re.findall(r"^([\w ]+): +(.*)$", text, re.MULTILINE))


def test_flagged_views_and_the_unobservable_are_told_and_kept(clra, bad_file, tmp_path):
    motion, page = tmp_path / "m.h5", tmp_path / "r.html"
    code, out, err = clra(
        "align", bad_file, "-o", motion, "--schedule", "1QR-1HR", "--report", page
    )
    assert code == 0, err
    told = lines_of(out)
    assert told["confidence"].endswith(f"2 views flagged: {BLANK}, {SATURATED}")
    with h5py.File(motion) as file:
        assert file["motion/flagged"][()].tolist() == [BLANK, SATURATED]
        assert not file["motion/confidence"][()][[BLANK, SATURATED]].any()
        modes = json.loads(file.attrs["gauge"])
        found = {name: file[f"motion/{name}"][()] for name in ("shift_u", "magnification")}
    # Each movement of the sample that is large enough to be seen, the largest first.
    parts = re.findall(r"([a-z]+(?: [xyz])?) (\d+\.\d\d)", told["unobservable"])
    seen = {name: size for name, size in modes.items() if size >= 0.005}
    assert {name: float(size) for name, size in parts} == pytest.approx(seen, abs=0.006)
    assert [size for _, size in parts] == sorted((size for _, size in parts), reverse=True)
    assert told["unobservable"].endswith("taken out")
    # Raw errors over all views, as printed, from the files themselves.
    truth = read_scan(bad_file).truth
    valid_views = np.delete(np.arange(VIEWS), [BLANK, SATURATED])
    for name, views in (("error", slice(None)), ("not flagged", valid_views)):
        u = np.abs(found["shift_u"] - truth.shift_u)[views].mean()
        m = np.abs(found["magnification"] - truth.magnification)[views].mean()
        assert told[name].startswith(f"mean {u:.3f}, ")
        assert told[name].endswith(f"; magnification {m:.1e}")
        assert "gauge-free" in told[name]
    html = page.read_text(encoding="utf-8")
    for part in (
        f"Flagged views: {BLANK}, {SATURATED}.",
        "It was taken out of the motion.",
        "gauge-free, without flagged views",
        "stretch z",
    ):
        assert part in html


def test_the_unobservable_stays_if_it_is_to(clra, bad_file, tmp_path):
    found = {}
    for gauge, fate in (("anchored", "taken out"), ("free", "left in")):
        motion = tmp_path / f"{gauge}.h5"
        options = ["-o", motion, "--schedule", "1QR", "--gauge", gauge]
        code, out, err = clra("align", bad_file, *options)
        assert code == 0, err
        assert lines_of(out)["unobservable"].endswith(fate)
        page = tmp_path / f"{gauge}.html"
        assert clra("report", motion, "-o", page)[0] == 0
        assert f"It was {fate}" in page.read_text(encoding="utf-8")
        found[gauge] = read_alignment(motion).motion
    # A translation along z is a constant in v.
    assert abs(found["free"].shift_v.mean()) > 2 * abs(found["anchored"].shift_v.mean())


@pytest.mark.parametrize("method", ["fbp", "imgr"])
def test_flagged_views_are_left_out_of_the_volume(clra, measured, tmp_path, method):
    motion = tmp_path / "m.h5"
    keep_motion(motion, measured.truth, flagged=[BLANK, SATURATED])
    volumes = []
    for name, values in (("bad", [0.0, 9.0]), ("worse", [7.0, -5.0])):
        path = tmp_path / f"{name}.nxs"
        write_scan(path, spoilt(measured, values))
        out = tmp_path / f"{name}.h5"
        options = ["--motion", motion, "--method", method, "-o", out]
        code, _, err = clra("reconstruct", path, *options, "--quiet")
        assert code == 0, err
        volumes.append(read_volume(out)[0])
    assert volumes[0].std() > 0
    assert np.array_equal(*volumes)


def test_flagged_views_are_marked_invalid_where_radiographs_are_corrected(clra, measured, tmp_path):
    motion, source, out = tmp_path / "m.h5", tmp_path / "bad.nxs", tmp_path / "c.nxs"
    write_scan(source, spoilt(measured, [0.0, 9.0]))
    keep_motion(motion, read_scan(source).truth, flagged=[BLANK, SATURATED])
    code, told, err = clra("correct", source, "--motion", motion, "-o", out)
    assert code == 0, err
    assert f"2 views flagged: {BLANK}, {SATURATED}; marked invalid" in told
    with h5py.File(out) as file:
        keys = file["entry/instrument/detector/image_key"][()]
        assert np.flatnonzero(keys == 3).tolist() == [BLANK, SATURATED]
        assert (np.delete(keys, [BLANK, SATURATED]) == 0).all()
    # What is read back is the views that are left, as they would have been without motion.
    corrected = read_scan(out)
    valid_views = np.delete(np.arange(VIEWS), [BLANK, SATURATED])
    geometry = measured.geometry.subset(valid_views)
    vectors = geometry.to_astra()
    vectors[:, 9:] *= -1  # rows run down in a file
    assert np.allclose(corrected.geometry.to_astra(), vectors, rtol=0, atol=1e-9)
    ideal = sample("porous", measured.geometry).line_integrals(geometry)
    error, before = (
        np.sqrt(np.mean((images - ideal)[:, 6:-6, 6:-6] ** 2, axis=(1, 2)))
        for images in (corrected.read(0, 58)[:, ::-1], measured.read(0, 60)[valid_views])
    )
    assert (error < 0.02 * ideal.max()).all() and np.median(error / before) < 0.2


def test_nothing_is_marked_where_nothing_was_flagged(clra, measured, bad_file, tmp_path):
    motion, out = tmp_path / "m.h5", tmp_path / "c.nxs"
    keep_motion(motion, measured.truth)
    code, told, err = clra("correct", bad_file, "--motion", motion, "-o", out)
    assert code == 0, err
    assert "flagged" not in told
    assert read_scan(out).views == VIEWS
