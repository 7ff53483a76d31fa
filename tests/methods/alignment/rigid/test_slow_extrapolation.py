"""An iteration whose slow modes shrink by a known factor is taken to its end."""

import numpy as np
import pytest

from clra.methods.alignment.rigid.slow_extrapolation import SlowExtrapolation

VIEWS = 120
VALID = np.ones(VIEWS, np.bool_)


def steps(contraction, count):
    """Steps toward a drift of amplitude 1, of which each finds 1 - contraction, and of jitter."""
    drift = np.cos(2 * 2 * np.pi * np.arange(VIEWS) / VIEWS)
    jitter = np.random.default_rng(1).normal(size=VIEWS)
    for number in range(count):
        fast = jitter if number == 0 else 0.0
        yield np.stack([(1 - contraction) * contraction**number * drift + fast], axis=1)


@pytest.mark.parametrize("contraction", [0.3, 0.75])
def test_what_is_left_of_a_drift_is_added(contraction):
    slow, found = SlowExtrapolation(), 0.0
    for step in steps(contraction, 4):
        slow.add(step, VALID)
        found = found + step
    assert np.abs(slow.left()[:, 0]).max() == pytest.approx(contraction**4, rel=0.02)
    assert slow.contraction == pytest.approx([contraction], rel=0.02)


def test_one_step_or_steps_that_disagree_tell_nothing():
    slow = SlowExtrapolation()
    assert not slow.left().any() and slow.growth(VIEWS) == pytest.approx(1)
    step = next(steps(0.5, 1))
    slow.add(step, VALID)
    assert not slow.left().any()
    slow.add(-step, VALID)
    assert not slow.left().any() and slow.growth(VIEWS) == pytest.approx(1)


def test_rejected_views_do_not_count():
    slow, wild = SlowExtrapolation(), np.arange(VIEWS) == 40
    for step in steps(0.75, 3):
        slow.add(step + 50 * wild[:, None], ~wild)
    assert slow.contraction == pytest.approx([0.75], rel=0.05)


def test_errors_of_each_step_add_up_in_slow_modes():
    """White errors of each step, of which 16 of 120 modes add up to 1 / (1 - r)."""
    slow = SlowExtrapolation()
    for step in steps(0.75, 3):
        slow.add(step, VALID)
    random, basis = np.random.default_rng(2), np.arange(16)
    angle = np.pi * (np.arange(VIEWS) + 0.5) / VIEWS
    waves = np.linalg.qr(np.cos(np.multiply.outer(angle, basis)))[0]
    sums = []
    for _ in range(200):
        white = random.normal(size=VIEWS)
        part = waves @ (waves.T @ white)
        sums.append(white - part + part / (1 - 0.75))
    assert slow.growth(VIEWS) == pytest.approx(np.std(sums), rel=0.05)
