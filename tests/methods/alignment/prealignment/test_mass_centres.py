"""Shifts across the axis against sums of layers that are points of mass."""

import numpy as np
import pytest

from clra.methods.alignment.prealignment.mass_centres import centre_shifts
from clra.methods.alignment.prealignment.projection_sums import ProjectionSums

VIEWS, ROWS, COLUMNS = 40, 48, 64
ANGLE = np.linspace(-1.3, 1.3, VIEWS)
SLOPE = np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=1)
SOURCE = np.column_stack([np.sin(ANGLE), -np.cos(ANGLE), np.zeros(VIEWS)])
AXIS = np.full(VIEWS, (COLUMNS - 1) / 2)


def _sums(shift, axis_row, whole=None):
    """Rows of which each is the image of its layer's centre; layers lie on a curve."""
    z = np.arange(ROWS) - axis_row[:, None]
    mass = np.where(np.abs(z) < 18, 5 + np.cos(z / 5.0), 0.0)
    x, y = 4 * np.sin(z / 9.0), 3 * np.cos(z / 6.0)
    place = AXIS[:, None] + shift[:, None] + x * SLOPE[:, :1] + y * SLOPE[:, 1:]
    centre = (mass * place).sum(axis=1) / mass.sum(axis=1)
    moment = mass * (place - centre[:, None])
    profiles = np.exp(-0.5 * ((np.arange(COLUMNS) - centre[:, None]) / 5.0) ** 2)
    whole = np.ones(VIEWS, bool) if whole is None else whole
    return ProjectionSums(profiles, mass, moment, centre, 12.0, whole)


def _without_translation(values):
    return values - SLOPE @ np.linalg.lstsq(SLOPE, values, rcond=None)[0]


@pytest.mark.parametrize("climb", [0.0, 12.0])
def test_shifts_are_found_but_for_a_translation_of_the_sample(climb):
    # With a climb each view sees other layers: their centres have to be told apart.
    shift = np.random.default_rng(2).normal(0, 3, VIEWS)
    row = (ROWS - 1) / 2 + climb * np.linspace(-1, 1, VIEWS)
    found = centre_shifts(_sums(shift, row), AXIS, SLOPE, row, SOURCE)
    error = _without_translation(found.shift - shift)
    assert np.abs(error).max() < 0.05
    assert np.abs(found.difference).max() < 0.1


def test_the_column_of_the_axis_is_found():
    row = np.full(VIEWS, (ROWS - 1) / 2)
    found = centre_shifts(_sums(np.full(VIEWS, 2.5), row), AXIS, SLOPE, row, SOURCE)
    np.testing.assert_allclose(_without_translation(found.shift - 2.5), 0, atol=0.02)


def test_a_view_that_lacks_a_part_follows_its_neighbour():
    shift = np.random.default_rng(4).normal(0, 3, VIEWS)
    whole = np.ones(VIEWS, bool)
    whole[[7, 30]] = False
    row = np.full(VIEWS, (ROWS - 1) / 2)
    sums = _sums(shift, row, whole)
    sums.moment[7] += 40.0  # as if its centre of mass were aside
    found = centre_shifts(sums, AXIS, SLOPE, row, SOURCE)
    error = _without_translation(found.shift - shift)
    assert np.abs(error[whole]).max() < 0.05 and np.abs(error).max() < 0.5


def test_lost_mass_is_told():
    row = np.full(VIEWS, (ROWS - 1) / 2)
    sums = _sums(np.zeros(VIEWS), row)
    sums.mass[5] *= 0.97
    found = centre_shifts(sums, AXIS, SLOPE, row, SOURCE)
    assert found.loss[5] == pytest.approx(-0.03, abs=0.002)
    assert np.abs(np.delete(found.loss, 5)).max() < 0.002
