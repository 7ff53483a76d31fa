"""Shifts along the axis against profiles that are closed forms."""

import numpy as np
import pytest

from clra.methods.alignment.prealignment.row_profiles import profile_shifts
from clra.methods.alignment.steps.slow_modes import slow_part

VIEWS, ROWS = 50, 72
ROW = np.arange(float(ROWS))
# Tolerances [pixel]: linear interpolation between rows, and photon noise of 0.3 % of the mass.
EXACT, NOISY = 0.05, 0.05


def _profile(z):
    """Mass at heights z from the middle: a body with bumps that ends at 25 rows."""
    body = np.sqrt(np.maximum(1 - (z / 25.0) ** 2, 0))
    return 40 * body + sum(
        a * np.exp(-0.5 * ((z - m) / s) ** 2)
        for a, m, s in ((12, -14, 2.5), (9, -3, 3.0), (-8, 6, 2.0), (14, 15, 3.0))
    )


def _measured(shift, axis_row, stretch=0.0):
    place = ROW - (ROWS - 1) / 2
    middle = axis_row - (ROWS - 1) / 2 + shift
    return _profile((place - middle[:, None]) / (1 + np.reshape(stretch, (-1, 1))))


@pytest.fixture
def walk():
    steps = np.random.default_rng(3).normal(0, 2.0, VIEWS).cumsum()
    return steps - steps.mean()


def test_a_walk_is_found_past_the_border(walk):
    # Farther than the 10 rows of air: the sample leaves the detector at either end.
    walk *= 18 / np.abs(walk).max()
    row = np.full(VIEWS, (ROWS - 1) / 2)
    found = profile_shifts(_measured(walk, row), row, np.ones(VIEWS, bool))
    assert np.abs(found.shift - walk).max() < EXACT
    assert np.abs(found.difference).max() < 4 * EXACT
    assert found.after < 0.04 * found.before


def test_each_view_may_have_an_intensity_of_its_own(walk):
    row = np.full(VIEWS, (ROWS - 1) / 2)
    gain = 1 + 0.1 * np.sin(np.arange(VIEWS) / 7.0)
    found = profile_shifts(gain[:, None] * _measured(walk, row), row, np.ones(VIEWS, bool))
    assert np.abs(found.shift - walk).max() < EXACT


def test_noise_is_told_by_halves_of_the_sample(walk):
    row = np.full(VIEWS, (ROWS - 1) / 2)
    noise = np.random.default_rng(5).normal(0, 0.15, (VIEWS, ROWS))
    found = profile_shifts(_measured(walk, row) + noise, row, np.ones(VIEWS, bool))
    error = np.std(found.shift - walk)
    assert error < NOISY
    assert 0.5 < 0.5 * np.std(found.difference) / error < 2


def test_a_lifted_sample_is_followed(walk):
    row = np.linspace(20.0, 50.0, VIEWS)
    jitter = 0.3 * walk[np.random.default_rng(1).permutation(VIEWS)]
    found = profile_shifts(_measured(jitter, row), row, np.ones(VIEWS, bool))
    assert np.abs(found.shift - (jitter - jitter.mean())).max() < EXACT


def test_stretches_are_found_with_the_shifts(walk):
    row = np.full(VIEWS, (ROWS - 1) / 2)
    stretch = 3e-3 * np.cos(np.arange(VIEWS) / 9.0)
    found = profile_shifts(_measured(walk, row, stretch), row, np.ones(VIEWS, bool))
    slow = slow_part(found.stretch - stretch, np.ones(VIEWS))
    assert np.std(slow) < 1e-3
