"""A scan with bad pixels and a beam that decays, as a user meets it."""

import json

import h5py
import numpy as np
import pytest

from clra.app.simulation import paper_like, sample, simulated_motion
from clra.io.alignment_file import read_alignment
from clra.io.nxtomo.writer import write_nxtomo
from clra.io.volumes.volume_files import read_volume

VIEWS, SHAPE, WHITE = 72, (72, 80), 20000.0
# Mean absolute difference of the shifts from those of the clean scan [pixel]; measured: 0.005.
WITHIN = 0.01


@pytest.fixture(scope="module")
def radiographs():
    geometry = paper_like("space-filling", VIEWS, SHAPE)
    truth = simulated_motion("random", geometry, shift=(-3.0, 3.0), seed=5)
    images = sample("porous", geometry, 5).line_integrals(geometry.with_motion(truth))
    return geometry, truth, np.exp(-images)


@pytest.fixture(scope="module")
def bad():
    bad = np.random.default_rng(6).random(SHAPE) < 0.005
    bad[:, [13, 44, 61]] = True
    return bad


@pytest.fixture(scope="module")
def write(radiographs, bad, tmp_path_factory):
    """Write counts with flats and darks, with defects or without."""
    folder = tmp_path_factory.mktemp("counts")

    def write(name, *, defects=False, in_flats=False, decay=0.0, blank=()):
        geometry, truth, transmission = radiographs
        random = np.random.default_rng(7)
        beam = 1 - decay * np.arange(VIEWS) / VIEWS
        counts = random.poisson(WHITE * beam[:, None, None] * transmission) + 100
        flats = random.poisson(WHITE, (8, *SHAPE)) + 100
        hot = bad & (np.arange(SHAPE[0]) % 2 > 0)[:, None]
        for frames, spoil in ((counts, defects), (flats, in_flats)):
            if spoil:
                frames[:, bad] = 100
                frames[:, hot] = 65535
        counts[list(blank)] = 100
        path = folder / f"{name}.nxs"
        write_nxtomo(
            path,
            counts.astype(np.uint16),
            geometry,
            flats=flats.astype(np.uint16),
            darks=np.full((1, *SHAPE), 100, np.uint16),
            truth=truth,
        )
        return path

    return write


@pytest.fixture(scope="module")
def clean(write):
    return write("clean")


def shifts(path):
    motion = read_alignment(path).motion
    return np.stack([motion.shift_u, motion.shift_v])


@pytest.mark.filterwarnings("ignore:.*saturated")
@pytest.mark.parametrize("in_flats", [False, True])
def test_bad_pixels_whether_the_flats_have_them_or_not(clra, write, clean, bad, in_flats, tmp_path):
    scan = write(f"bad{in_flats}", defects=True, in_flats=in_flats)
    for name, path in (("clean", clean), ("bad", scan)):
        code, _, err = clra("align", path, "-o", tmp_path / f"{name}.h5", "--json")
        assert code == 0, err
        volume = tmp_path / f"{name}-volume.h5"
        code, _, err = clra("reconstruct", path, "-o", volume, "--motion", tmp_path / f"{name}.h5")
        assert code == 0, err
    off = np.abs(shifts(tmp_path / "bad.h5") - shifts(tmp_path / "clean.h5"))
    assert (off.mean(axis=1) < WITHIN).all()
    one, other = (
        read_volume(tmp_path / f"{name}-volume.h5")[0].ravel() for name in ("clean", "bad")
    )
    assert np.corrcoef(one, other)[0, 1] > 0.99
    code, out, err = clra("info", scan, "--json")
    assert code == 0, err
    told = json.loads(out)["scan"]["defects"]
    if not in_flats:
        single = bad.sum() - 3 * SHAPE[0]
        assert told == [f"{single} bad pixels, 3 dead columns: interpolated from their neighbours"]


def test_a_blank_view_a_decaying_beam_and_excluded_views(clra, write, tmp_path):
    scan, motion = write("decay", decay=0.3, blank=[20]), tmp_path / "m.h5"
    code, _, err = clra(
        "align", scan, "-o", motion, "--schedule", "1QR", "--exclude", "3,40-42", "--rings"
    )
    assert code == 0, err
    found = read_alignment(motion)
    assert found.flagged == (3, 20, 40, 41, 42)
    reasons = [f.measured["views"] for f in found.warnings if f.code == "rejected-views"]
    assert sorted(reasons) == ["20", "3 40 41 42"]
    assert "intensity" in {finding.code for finding in found.warnings}
    kept = json.loads(found.about["corrections"])
    assert kept["rings"] and kept["excluded"] == [3, 40, 41, 42] and kept["intensity"]
    assert found.command.endswith("--exclude 3,40-42 --rings")
    code, _, err = clra(
        "correct", scan, "--motion", motion, "-o", tmp_path / "c.nxs", "--exclude", "7"
    )
    assert code == 0, err
    with h5py.File(tmp_path / "c.nxs") as file:
        key = file["entry/instrument/detector/image_key"][()]
    assert np.flatnonzero(key == 3).tolist() == [3, 7, 20, 40, 41, 42]


def test_options_that_are_wrong_are_refused(clra, clean, tmp_path):
    out = tmp_path / "m.h5"
    code, _, err = clra("align", clean, "-o", out, "--exclude", "5-3")
    assert code == 2 and "--exclude: found '5-3'" in err
    code, _, err = clra("align", clean, "-o", out, "--exclude", "72")
    assert code == 2 and "exclude: found view 72, expected some of 72 views" in err
    code, _, err = clra("reconstruct", clean, "-o", tmp_path / "v.h5", "--beam-hardening", "x")
    assert code == 2 and "--beam-hardening: found 'x'" in err
