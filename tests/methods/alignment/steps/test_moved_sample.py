"""The sample's place across the axis, by magnifications in closed form."""

import numpy as np
import pytest

import clra
from clra.methods.alignment.steps.moved_sample import MovedSample
from clra.model.gauge.gauge import sample_points
from clra.model.gauge.modes import apparent_shift, gauge_columns
from clra.model.grid import default_grid

VIEWS, SPREAD = 90, 3e-3
GEOMETRY = clra.circular(
    VIEWS, source_to_axis=30.0, source_to_detector=90.0, pixel_size=0.3, shape=(48, 64)
)
GRID = default_grid(GEOMETRY)
ANGLE = 2 * np.pi * np.arange(VIEWS) / VIEWS
PLACE = np.array([0.9, 0.5, 0.0])


def _magnified():
    """Logarithms of SOD / (SOD - depth) for a sample at PLACE."""
    depth = GEOMETRY.source[:, :2] @ PLACE[:2] / 30.0
    return np.log(30.0 / (30.0 - depth))


def _aside(logarithm, sigma=1e-3):
    sigmas = np.broadcast_to(sigma, VIEWS)
    return MovedSample(GEOMETRY, GRID).aside(logarithm, sigmas, SPREAD)


def test_a_long_movement_shows_as_the_points_do():
    # A single point on the axis is seen at the shift; two about it give the magnification.
    points = np.array([[0.0, 0.0, -1e-3], [0.0, 0.0, 1e-3]])
    motion = apparent_shift(GEOMETRY, points, tuple(PLACE))
    depth = GEOMETRY.source[:, :2] @ PLACE[:2] / 30.0
    across = GEOMETRY.u[:, :2] @ PLACE[:2] / 0.3
    there = 90.0 * across / (30.0 - depth) / 0.3
    m = (30.0 - depth) / 30.0
    assert motion.magnification == pytest.approx(m, abs=1e-7)
    assert motion.shift_u == pytest.approx(-m * there, abs=1e-6)
    assert motion.shift_v == pytest.approx(np.zeros(VIEWS), abs=1e-6)


def test_a_short_movement_shows_as_the_gauge_does():
    points = sample_points(GRID, 300)
    motion = apparent_shift(GEOMETRY, points, (1e-4, 0.0, 0.0))
    du, _, dm = gauge_columns(GEOMETRY, points, ("translation x",)).reshape(3, VIEWS)
    assert motion.shift_u == pytest.approx(-1e-4 * du, abs=1e-5)
    assert motion.magnification - 1 == pytest.approx(-1e-4 * dm, abs=1e-7)


@pytest.mark.parametrize("trend", [0.0, 0.01])
def test_a_sample_beside_the_axis_is_put_back(trend):
    found = _aside(_magnified() + trend * np.linspace(-1, 1, VIEWS))
    expected = apparent_shift(GEOMETRY, sample_points(GRID), tuple(PLACE))
    assert np.abs(expected.shift_u).max() > 9
    assert found.shift_u == pytest.approx(expected.shift_u, abs=0.4)
    # What was magnified no longer is.
    left = np.log(found.magnification) + _magnified()
    assert np.abs(left).max() < 0.05 * np.abs(_magnified()).max()


def test_views_that_do_not_count_do_not():
    right = _aside(_magnified())
    spoilt, sigma = _magnified(), np.full(VIEWS, 1e-3)
    spoilt[10:15] += 0.5
    sigma[10:15] = np.inf
    assert _aside(spoilt, sigma).shift_u == pytest.approx(right.shift_u, abs=0.1)


def test_the_doubt_is_the_magnification_of_a_sample_as_far_aside_as_it_drifts():
    drift = 5 * np.sqrt(2) * np.sin(ANGLE)
    expected = np.hypot(1, 1) * 5 * GRID.voxel_size / 30.0 / np.sqrt(2)
    assert MovedSample(GEOMETRY, GRID).doubt(drift) == pytest.approx(expected, rel=0.05)


def test_what_is_expected_is_left():
    assert _aside(SPREAD * np.cos(ANGLE)) is None
    assert _aside(0.02 * np.linspace(-1, 1, VIEWS)) is None
    assert _aside(np.full(VIEWS, 0.05)) is None
    jitter = 0.01 * np.random.default_rng(0).choice([-1, 1], VIEWS)
    assert _aside(jitter) is None
    # A place beyond the field of view is none.
    assert _aside(0.5 * np.cos(ANGLE)) is None
