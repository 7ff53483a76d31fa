"""Composition of motions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clra.model.motion import Motion

# Rounding of a few operations on numbers up to 100.
ROUNDING = 1e-12

seeds = st.integers(0, 2**32 - 1)


def any_motion(seed, views=7):
    random = np.random.default_rng(seed)
    return Motion(
        shift_u=random.uniform(-20, 20, views),
        shift_v=random.uniform(-20, 20, views),
        magnification=random.uniform(0.8, 1.2, views),
    )


def moved(motion, pixel):
    """Where the motion puts pixels counted from the detector's centre, (views, 2)."""
    shift = np.stack([motion.shift_u, motion.shift_v], axis=1)
    return motion.magnification[:, None] * pixel + shift


@given(seeds, seeds)
@settings(max_examples=20, deadline=None)
def test_then_moves_twice(first, second):
    one, two = any_motion(first), any_motion(second)
    pixel = np.array([11.0, -7.0])
    np.testing.assert_allclose(
        moved(one.then(two), pixel), moved(two, moved(one, pixel)), atol=ROUNDING
    )


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_inverse_undoes(seed):
    motion = any_motion(seed)
    for none in (motion.then(motion.inverse()), motion.inverse().then(motion)):
        np.testing.assert_allclose(none.shift_u, 0, atol=ROUNDING * 100)
        np.testing.assert_allclose(none.shift_v, 0, atol=ROUNDING * 100)
        np.testing.assert_allclose(none.magnification, 1, atol=ROUNDING)


def test_what_moved_goes_along():
    motion = any_motion(3).caused_by("source")
    for other in (
        motion.then(any_motion(4)),
        motion.inverse(),
        motion.normalised(),
        motion.subset([2, 4]),
    ):
        assert other.cause == "source"
    assert motion != any_motion(3)
    assert Motion.identity(2, "source").cause == "source"
    with pytest.raises(ValueError, match="cause: found 'stage', expected one of"):
        motion.caused_by("stage")


def test_identity_changes_nothing():
    motion = any_motion(1)
    assert motion.then(Motion.identity(7)) == motion
    assert Motion.identity(7).then(motion) == motion


def test_magnification_is_one_unless_given():
    motion = Motion(shift_u=[1, 2], shift_v=[3, 4])
    np.testing.assert_array_equal(motion.magnification, [1, 1])
    assert motion.shift_u.dtype == np.float64
    assert motion.views == len(motion) == 2


def test_normalised_has_mean_log_magnification_zero():
    normalised = any_motion(2).normalised()
    assert np.mean(np.log(normalised.magnification)) == pytest.approx(0, abs=ROUNDING)
    ratio = normalised.magnification / any_motion(2).magnification
    np.testing.assert_allclose(ratio, ratio[0])
    np.testing.assert_array_equal(normalised.shift_u, any_motion(2).shift_u)


def test_subset_keeps_the_chosen_views():
    motion = any_motion(3)
    mask = np.array([True, False, True, False, True, False, False])
    for index in (slice(0, 6, 2), [0, 2, 4], mask):
        chosen = motion.subset(index)
        np.testing.assert_array_equal(chosen.shift_v, motion.shift_v[[0, 2, 4]])
    assert motion.subset(5).views == 1


def test_values_are_immutable():
    with pytest.raises(ValueError, match="read-only"):
        any_motion(0).shift_u[0] = 1


def test_equality_and_repr():
    assert any_motion(0) == any_motion(0)
    assert any_motion(0) != any_motion(1)
    assert any_motion(0) != any_motion(0, views=6)
    assert any_motion(0) != 3
    assert "2 views, shift_u -1 to 1 pixel" in repr(Motion(shift_u=[-1, 1], shift_v=[0, 0]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shift_u": [[1.0]]}, r"shift_u: found shape \(1, 1\), expected \(views,\)"),
        ({"shift_u": []}, r"shift_u: found shape \(0,\)"),
        ({"shift_v": [0.0]}, "shift_v: found 1 views, expected 2 as in shift_u"),
        ({"shift_v": [0.0, np.nan]}, "shift_v: found nan at 1 of the views"),
        ({"magnification": [1.0, 0.0]}, "magnification: found 0.0, expected positive"),
        ({"magnification": [1.0]}, "magnification: found 1 views"),
    ],
)
def test_wrong_values_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Motion(**({"shift_u": [0.0, 0.0], "shift_v": [0.0, 0.0]} | change))


def test_motions_of_other_lengths_do_not_compose():
    with pytest.raises(ValueError, match="residual: found 2 views, expected 7"):
        any_motion(0).then(Motion.identity(2))
    with pytest.raises(ValueError, match="views: found 0"):
        Motion.identity(0)
