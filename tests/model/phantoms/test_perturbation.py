"""Simulated motions keep to their range and their seed."""

import numpy as np
import pytest

from clra.model.phantoms.perturbation import random_motion, smooth_motion

BOTH = pytest.mark.parametrize("make", [random_motion, smooth_motion])


@BOTH
def test_range_and_seed(make):
    motion = make(500, seed=3, shift=(-2, 5), magnification=1e-3)
    for shift in (motion.shift_u, motion.shift_v):
        assert -2 <= shift.min() < -1.9
        assert 4.9 < shift.max() <= 5
    assert 9e-4 < np.abs(motion.magnification - 1).max() <= 1e-3 * (1 + 1e-9)
    assert motion == make(500, seed=3, shift=(-2, 5), magnification=1e-3)
    assert motion != make(500, seed=4, shift=(-2, 5), magnification=1e-3)
    assert np.abs(np.corrcoef(motion.shift_u, motion.shift_v)[0, 1]) < 0.9


@BOTH
def test_default_is_the_papers_range_without_magnification(make):
    motion = make(2000, seed=0)
    assert motion.shift_u.min() == pytest.approx(-10, abs=0.1)
    assert motion.shift_v.max() == pytest.approx(8, abs=0.1)
    np.testing.assert_array_equal(motion.magnification, 1)


def test_random_motion_is_white_and_smooth_motion_is_not():
    jitter = np.diff(random_motion(1000, seed=1, shift=(0, 1)).shift_u)
    drift = np.diff(smooth_motion(1000, seed=1, shift=(0, 1)).shift_u)
    assert jitter.std() == pytest.approx(np.sqrt(2 / 12), rel=0.1)
    assert np.abs(drift).max() < 0.05


@BOTH
def test_one_view_has_a_motion(make):
    assert make(1, seed=0).views == 1


@BOTH
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shift": (2, 1)}, r"shift: found \(2, 1\), expected \(lowest, highest\)"),
        ({"magnification": -0.1}, "magnification: found -0.1"),
        ({"views": 0}, "views: found 0"),
    ],
)
def test_wrong_ranges_are_refused(make, change, message):
    with pytest.raises(ValueError, match=message):
        make(**({"views": 5, "seed": 0} | change))
