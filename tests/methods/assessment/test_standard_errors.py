"""Standard errors of registration and of what held-out views find, put together."""

from dataclasses import replace

import numpy as np
import pytest

import clra
from clra.methods.alignment.result import AlignmentResult, Iteration
from clra.methods.assessment.standard_errors import standard_errors

VIEWS = 200


def result(sigma=0.0, level="HR"):
    history = (Iteration(level, 1, 0, 0, 0, 1, 0, 0),)
    found = AlignmentResult.from_motion(clra.Motion.identity(VIEWS))
    return replace(found, sigma=np.full((VIEWS, 3), sigma), history=history)


def left(u=0.0, v=0.0, m=0.0):
    sign = np.random.default_rng(1).choice([-1.0, 1.0], VIEWS)
    slow = np.sqrt(2) * np.cos(2 * np.pi * (np.arange(VIEWS) + 0.5) / VIEWS)
    return np.stack([u * sign, v * sign, m * slow], axis=1)


def test_what_held_out_views_find_and_registrations_errors_add_in_squares():
    found = standard_errors(result(0.1), left(0.2, 0.0), 2, truncated=False, tilts=False)
    np.testing.assert_allclose(found[:, 0], np.hypot(0.1 * np.sqrt(0.65), 1.1 * 0.2), rtol=1e-6)
    np.testing.assert_allclose(found[:, 1], 0.1 * np.sqrt(0.65), rtol=1e-6)


def test_a_truncated_sample_is_less_certain_most_along_u():
    whole, cut = (
        standard_errors(result(), left(0.2, 0.2), 2, truncated=truncated, tilts=False)
        for truncated in (False, True)
    )
    assert cut[0, 0] == pytest.approx(1.8 / 1.1 * whole[0, 0])
    assert whole[0, 1] < cut[0, 1] < cut[0, 0]


def test_views_that_are_off_are_those_with_large_errors():
    wrong = left(0.05, 0.05)
    wrong[120:150, :2] *= 20
    found = standard_errors(result(0.02), wrong, 2, truncated=False, tilts=False)
    assert found[125:145, 0].min() > 10 * found[:110, 0].max()


def test_what_a_coarser_level_finds_by_mistake_does_not_count():
    for level, expected in ((2, 1.1 * 0.03), (8, 0.0)):
        found = standard_errors(result(), left(0.03), level, truncated=False, tilts=False)
        np.testing.assert_allclose(found[:, 0], expected, atol=1e-9)
    # But what is larger does.
    found = standard_errors(result(), left(0.5), 8, truncated=False, tilts=False)
    np.testing.assert_allclose(found[:, 0], 1.1 * 0.5, rtol=0.01)


def test_only_slow_magnifications_are_seen_beyond_registration():
    found = standard_errors(result(), left(m=1e-3), 2, truncated=False, tilts=False)
    np.testing.assert_allclose(found[:, 2], 1e-3, rtol=1e-6)
    fast = left()
    fast[:, 2] = 1e-3 * (-1.0) ** np.arange(VIEWS)
    found = standard_errors(result(1e-4), fast, 2, truncated=False, tilts=False)
    np.testing.assert_allclose(found[:, 2], 1e-4 * np.sqrt(0.5), rtol=0.05)


def test_rejected_views_are_as_uncertain_as_neighbours_differ():
    motion = clra.Motion(shift_u=np.where(np.arange(VIEWS) % 2, 1.0, -1.0), shift_v=np.zeros(VIEWS))
    valid = np.ones(VIEWS, np.bool_)
    valid[50] = False
    aligned = replace(result(0.01), motion=motion, valid_views=valid)
    unseen = left()
    unseen[50] = np.nan
    found = standard_errors(aligned, unseen, 2, truncated=False, tilts=False)
    assert found[50, 0] == pytest.approx(2.0, rel=0.05)
    assert found[49, 0] < 0.02 and found[50, 1] < 0.02
