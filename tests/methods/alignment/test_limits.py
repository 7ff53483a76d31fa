"""Motions out of reach and features that a level loses are said."""

import warnings

import numpy as np
import pytest

import clra
from clra.app.simulation import counted, paper_like, sample, simulated_motion
from clra.methods.alignment.level import Level
from clra.methods.alignment.limits import (
    false_shifts,
    far_motion,
    lost_features,
    surviving_contrast,
    warned,
)
from clra.methods.alignment.reprojection import Registered
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import Ellipsoids


def test_noise_is_lost_and_structure_is_not():
    geometry = paper_like("circular", 12, (128, 128))
    noise = np.random.default_rng(0).normal(size=(12, 128, 128)).astype(np.float32)
    assert surviving_contrast(clra.Scan(noise, geometry), 4) == pytest.approx(1 / 16, rel=0.1)
    rock = sample("spheres", geometry).line_integrals(geometry)
    assert surviving_contrast(clra.Scan(rock, geometry), 4) > 0.9


@pytest.fixture(scope="module")
def noise():
    geometry = paper_like("space-filling", 60, (96, 96))
    pixels = np.random.default_rng(0).normal(size=(60, 96, 96)).astype(np.float32)
    return clra.Scan(pixels, geometry)


def test_a_scan_of_noise_is_said(noise):
    with pytest.warns(UserWarning) as said:
        result = clra.align(noise, "imgr")
    notes = [str(warning.message) for warning in said]
    assert any("hardly agree at HR" in n and "alone would leave 25.0 %" in n for n in notes)
    assert [note for step in result.history for note in step.note.splitlines()] == notes


@pytest.mark.filterwarnings("ignore::clra.errors.ClraWarning")
def test_the_alignment_of_noise_fails(noise):
    assert clra.align(noise, "ra", "2QR").quality.verdict == "failed"


def test_motions_out_of_reach_are_said_and_a_few_are_not():
    far = np.zeros(100)
    far[:30] = 60.0
    note = far_motion(clra.Motion(shift_u=0 * far, shift_v=-far), 4)
    assert note.startswith("30 of 100 views moved by 51 pixels or more: registration at QR looks")
    assert "no farther than 64; start" in note
    assert far_motion(clra.Motion(shift_u=0 * far, shift_v=0.5 * far), 4) == ""
    few = np.where(np.arange(100) < 4, 60.0, 0.0)
    assert far_motion(clra.Motion(shift_u=few, shift_v=few), 4) == ""


def test_what_agrees_is_not_mentioned():
    geometry = paper_like("circular", 12, (32, 32))
    scan = clra.Scan(np.zeros((12, 32, 32), np.float32), geometry)
    assert lost_features(scan, np.full(12, 0.9), 4) == ""
    assert lost_features(scan, np.full(12, 0.2), 1).endswith(
        "at FR, their median correlation is 0.20"
    )


def test_each_note_is_a_warning_and_none_is_no_note():
    with pytest.warns(UserWarning) as said:
        assert warned(a="", b="one", c="", d="other") == "one\nother"
    assert [str(warning.message) for warning in said] == ["one", "other"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert warned(a="", b="") == ""


def _grains(geometry, spacing):
    """Spheres on a jittered lattice, `spacing` pixels apart as seen at the axis."""
    grid = default_grid(geometry)
    height, width, _ = grid.shape
    step, radius = spacing * grid.voxel_size, 0.45 * width * grid.voxel_size
    halves = (int(length / spacing) // 2 for length in (0.9 * width, 0.9 * width, height))
    places = np.stack(np.meshgrid(*(np.arange(-n, n + 1) for n in halves), indexing="ij"), axis=-1)
    places = places.reshape(-1, 3)
    jitter = np.random.default_rng(0).uniform(-0.5, 0.5, places.shape)
    centres = step * (places + jitter)
    centres = centres[np.hypot(*centres[:, :2].T) < radius - 0.35 * step]
    filled = 4 / 3 * np.pi * 0.35**3
    return Ellipsoids(
        centres,
        np.full(len(centres), 0.35 * step),
        np.full(len(centres), 2.5 / (filled * 2 * radius)),
    )


def _moved(spacing, shift):
    geometry = paper_like("circular", 60, (64, 64))
    truth = simulated_motion("random", geometry, shift=shift, seed=1)
    images = _grains(geometry, spacing).line_integrals(geometry.with_motion(truth))
    return clra.Scan(images, geometry, truth=truth)


def test_grains_that_a_quarter_loses_are_said_and_half_finds_them():
    scan = _moved(4.0, (-6.25, 5.0))
    with pytest.warns(UserWarning, match=r"^HR moved \d+ of 60 views by 1 pixel or more, .* at QR"):
        result = clra.align(scan, schedule="5QR-3HR", estimate="shift", quality=False)
    at_quarter = [step.mae_v for step in result.history if step.level == "QR"]
    assert min(at_quarter) > 0.5  # of 2.8 pixels on average, with a correlation of 0.98
    assert np.abs(result.motion.shift_v - scan.truth.shift_v).mean() < 0.3
    assert np.abs(result.motion.shift_u - scan.truth.shift_u).mean() < 0.3


@pytest.mark.parametrize("photons", [None, 100])
def test_grains_that_a_quarter_keeps_are_not_mentioned(photons):
    scan = _moved(12.0, (-2.5, 2.0))
    images = scan.read(0, scan.views)
    if photons is not None:
        images = np.stack([counted(image, photons, seed=k) for k, image in enumerate(images)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        clra.align(clra.Scan(images, scan.geometry), estimate="shift")


def test_a_level_is_contradicted_by_what_the_next_one_adds():
    still, some, many = np.zeros((2, 100)), np.zeros((2, 100)), np.zeros((2, 100))
    some[0, :5] = many[1, :6] = 1.0
    assert false_shifts(4, still, 2, some) == ""  # a twentieth of the views
    assert false_shifts(4, still, 2, 0.99 * many) == ""
    assert false_shifts(4, many, 2, many) == ""  # it had not settled
    assert false_shifts(2, still, 2, many) == ""  # "2HR-2HR"
    note = false_shifts(4, some, 2, many)
    assert note.startswith("HR moved 6 of 100 views by 1 pixel or more, the last iteration at QR 5")
    assert note.endswith("with 4HR")
    assert false_shifts(8, still, 4, 2 * many).startswith("QR moved 6 of 100 views by 2 pixels")


@pytest.mark.filterwarnings("ignore:HR moved 20 of 20")
@pytest.mark.parametrize("size", [0.5, 2.0])
def test_each_level_begins_with_a_plain_step(size, monkeypatch):
    geometry = paper_like("circular", 20, (64, 64))
    scan = clra.Scan(np.ones((20, 64, 64), np.float32), geometry)
    waves = np.stack([np.cos(k * np.arange(20)) for k in (1, 2, 3)])
    steps = [*waves, size * np.sign(waves[0])]

    def moved(iterations, schedule):
        found = iter(steps[:iterations])

        def registered(*_, **__):
            motion = clra.Motion(shift_u=next(found), shift_v=np.zeros(20))
            return Registered(motion, np.ones(20), np.zeros(20), np.zeros((20, 3)))

        monkeypatch.setattr(Level, "residual_motion", registered)
        aligned = clra.align(scan, schedule=schedule, estimate="shift", gauge="free", quality=False)
        return aligned.motion.shift_u

    at_quarter = moved(3, "3QR")
    assert np.abs(at_quarter - sum(waves)).max() > 0.05  # extrapolated
    assert moved(4, "3QR-1HR") - at_quarter == pytest.approx(steps[3], abs=1e-9)
