"""Numbers that need no truth, where the truth is known."""

import numpy as np
import pytest

import clra
from clra.app.simulation import paper_like, sample, simulated_motion, simulated_scan
from clra.methods.assessment.agreement import agreement
from clra.ops.streaming.stream import Stream

VIEWS, SHAPE = 120, (96, 96)


@pytest.fixture(scope="module")
def moved():
    geometry = paper_like("space-filling", VIEWS, SHAPE)
    truth = simulated_motion("both", geometry, shift=(-6, 6), magnification=0.001, seed=3)
    scan = simulated_scan(geometry, sample("porous", geometry, 1), truth, noise=1e4)
    # Read once: radiographs of a simulation are computed whenever they are asked for.
    return clra.Scan(scan.read(0, VIEWS), geometry, truth=truth)


def test_the_true_motion_is_told_from_none_and_from_a_worse_one(moved):
    random = np.random.default_rng(0)
    truth = moved.truth
    worse = clra.Motion(
        shift_u=truth.shift_u + random.normal(0, 0.5, VIEWS),
        shift_v=truth.shift_v + random.normal(0, 0.5, VIEWS),
        magnification=truth.magnification,
    )
    good, bad = (agreement(Stream(), moved, motion, 1) for motion in (truth, worse))
    assert good.level == 1
    assert good.unexplained_before == pytest.approx(bad.unexplained_before)
    assert good.unexplained_after < 0.5 * good.unexplained_before
    assert good.unexplained_after < bad.unexplained_after < bad.unexplained_before
    assert good.half_u < 0.6 * bad.half_u and good.half_v < 0.9 * bad.half_v
    assert good.sharpness > bad.sharpness > 1


def test_without_motion_nothing_changes(moved):
    none = agreement(Stream(), moved, clra.Motion.identity(VIEWS), 2)
    assert none.unexplained_after == pytest.approx(none.unexplained_before)
    assert none.sharpness == pytest.approx(1)


def test_every_second_view_may_be_bad(moved):
    valid_views = np.arange(VIEWS) % 2 == 0
    found = agreement(Stream(), moved, moved.truth, 2, valid_views)
    whole = agreement(Stream(), moved, moved.truth, 2)
    assert 0 < found.half_u < 4 * whole.half_u
