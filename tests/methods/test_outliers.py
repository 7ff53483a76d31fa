"""Views that are not believed, and what they are given instead."""

import numpy as np

import clra
from clra.methods.outliers import from_neighbours, outliers


def test_views_far_below_the_others_are_found():
    correlation = np.random.default_rng(0).normal(0.95, 0.01, 200)
    correlation[[7, 120]] = 0.0, 0.5
    assert np.flatnonzero(outliers(correlation)).tolist() == [7, 120]


def test_views_that_are_equally_good_are_all_believed():
    assert not outliers(np.full(50, 0.99)).any()
    assert not outliers(np.linspace(0.91, 0.99, 50)).any()


def test_weak_views_get_what_lies_between_their_neighbours():
    views = np.arange(6.0)
    motion = clra.Motion(shift_u=views, shift_v=-2 * views, magnification=1 + 0.001 * views)
    spoilt = clra.Motion(
        shift_u=np.where(views == 3, 99, views),
        shift_v=np.where(views == 3, 99, -2 * views),
        magnification=np.where(views == 3, 1.5, 1 + 0.001 * views),
    )
    mended = from_neighbours(spoilt, views == 3)
    for name in ("shift_u", "shift_v", "magnification"):
        assert np.allclose(getattr(mended, name), getattr(motion, name), rtol=1e-12)
    assert from_neighbours(spoilt, views < 0) is spoilt


def test_weak_views_at_an_end_get_the_nearest():
    motion = clra.Motion(shift_u=[9.0, 1.0, 2.0], shift_v=[9.0, 3.0, 4.0])
    mended = from_neighbours(motion, np.array([True, False, False]))
    assert mended.shift_u.tolist() == [1.0, 1.0, 2.0]
