"""Slow modes: drifts are let go by the prior, and waited for."""

import numpy as np
import pytest

from clra.methods.alignment.steps.slow_modes import SlowSteps, held, slow_part

VIEWS = 240
TIME = (np.arange(VIEWS) + 0.5) / VIEWS
DRIFT = np.cos(np.pi * 6 * TIME)


def test_the_slow_part_is_the_drift():
    jitter = np.cos(np.pi * 80 * TIME)
    found = slow_part(DRIFT + jitter, np.ones(VIEWS))
    assert np.abs(found - DRIFT).max() < 1e-9


def test_views_of_no_weight_do_not_count():
    weight = np.ones(VIEWS)
    weight[50:60] = 0
    wrong = DRIFT.copy()
    wrong[50:60] = 100
    assert np.abs(slow_part(wrong, weight) - DRIFT).max() < 1e-9


def test_the_prior_holds_jitter_and_lets_a_drift_go():
    jitter = np.cos(np.pi * 80 * TIME)
    found = held(1e-3 * (DRIFT + jitter), np.full(VIEWS, 3e-3), 1e-3)
    assert np.abs(found - 1e-3 * (DRIFT + 0.1 * jitter)).max() < 1e-9


@pytest.mark.parametrize("contraction", [0.2, 0.8])
def test_what_is_left_of_a_geometric_series_is_its_sum(contraction):
    steps = SlowSteps()
    whole = np.sqrt(np.mean(DRIFT**2))
    assert steps.left(np.stack([DRIFT, 0 * DRIFT])) == pytest.approx(whole)
    rest = contraction**2 / (1 - contraction)
    assert steps.left(contraction * np.stack([DRIFT, 0 * DRIFT])) == pytest.approx(rest * whole)
