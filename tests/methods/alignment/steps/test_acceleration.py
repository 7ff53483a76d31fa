"""Anderson acceleration against linear iterations whose limit is known."""

import numpy as np
import pytest

from clra.methods.alignment.steps.acceleration import Anderson


def _iterate(memory, steps, gains, start):
    """Errors of x <- x + f(x) with f = -gain x: the limit is zero."""
    anderson, x = Anderson(memory), start
    for _ in range(steps):
        x = anderson.next(x, -gains * x)
    return np.abs(x).max()


def test_slow_modes_converge_that_a_plain_iteration_leaves():
    gains = np.repeat([0.95, 0.5, 0.05], [40, 10, 3])
    start = np.random.default_rng(0).uniform(-1, 1, gains.size)
    plain, accelerated = (_iterate(memory, 7, gains, start) for memory in (0, 3))
    assert plain > 0.69 * np.abs(start[-3:]).max()  # (1 - 0.05)^7 = 0.698
    assert accelerated < 0.1 * plain


def test_memory_zero_is_the_plain_iteration():
    gains, start = np.array([0.9, 0.3]), np.array([2.0, -1.0])
    assert _iterate(0, 4, gains, start) == pytest.approx(np.abs((1 - gains) ** 4 * start).max())


def test_a_wild_extrapolation_is_replaced_by_the_plain_step():
    anderson = Anderson(3)
    x = anderson.next(np.array([1.0, 1.0]), np.array([1.0, 0.9]))
    # The step hardly changed although the point moved: the secant points far away.
    step = np.array([0.99, 0.9])
    assert np.array_equal(anderson.next(x, step), x + step)


def test_shape_of_the_unknowns_is_kept():
    anderson = Anderson(2)
    x = np.zeros((3, 5))
    for _ in range(3):
        x = anderson.next(x, 1.0 - x)
    assert x.shape == (3, 5)
    assert x == pytest.approx(np.ones((3, 5)), abs=1e-2)
