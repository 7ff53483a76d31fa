"""A verdict and error bars from views that are held out, where the truth is known."""

import json
from dataclasses import replace

import numpy as np
import pytest

import clra
from clra.app.simulation import paper_like, sample, simulated_scan
from clra.methods.alignment.result import AlignmentResult
from clra.methods.assessment.assess import assess
from clra.methods.assessment.quality import Quality, judged
from clra.ops.streaming.stream import Stream

VIEWS, SHAPE = 72, (48, 64)
STILL = clra.Motion.identity(VIEWS)


@pytest.fixture(scope="module")
def truth():
    u, v = np.random.default_rng(1).uniform(-3, 3, (2, VIEWS))
    return clra.Motion(shift_u=u, shift_v=v)


@pytest.fixture(scope="module")
def scan(truth):
    geometry = paper_like("circular", VIEWS, SHAPE)
    moved = simulated_scan(geometry, sample("porous", geometry, 1), truth, noise=1e4)
    return clra.Scan(moved.read(0, VIEWS), geometry, truth=truth)


def result_of(motion):
    found = AlignmentResult.from_motion(motion)
    return replace(found, sigma=np.zeros((VIEWS, 3)))


def test_the_true_motion_is_good(scan, truth):
    found = assess(Stream(), scan, result_of(truth), STILL, scale=False)
    quality = found.quality
    assert (quality.verdict, quality.reasons, quality.kept_start) == ("good", (), False)
    assert quality.residual_after < 0.3 * quality.residual_before
    assert quality.error < 0.1
    assert found.motion == truth


def test_error_bars_are_as_long_as_the_errors(scan, truth):
    wrong = np.random.default_rng(2).normal(0, 0.5, (2, VIEWS))
    # Every view of the second half is three times as far off.
    wrong[:, VIEWS // 2 :] *= 3
    motion = clra.Motion(shift_u=truth.shift_u + wrong[0], shift_v=truth.shift_v + wrong[1])
    found = assess(Stream(), scan, result_of(motion), STILL, scale=False)
    for half in (slice(0, VIEWS // 2), slice(VIEWS // 2, VIEWS)):
        ratio = np.sqrt(np.mean(wrong[:, half] ** 2) / np.mean(found.sigma[half, :2] ** 2))
        assert 0.5 < ratio < 2
    assert found.quality.verdict == "doubtful"
    assert found.quality.reasons[0].code == "held-out-shift"


def test_a_motion_that_predicts_nothing_better_is_not_returned(scan, truth):
    geometry = scan.geometry
    still = simulated_scan(geometry, sample("porous", geometry, 1), STILL, noise=1e4)
    found = assess(Stream(), still, result_of(truth), STILL, scale=False)
    assert found.motion == STILL
    assert found.quality.kept_start and found.quality.verdict == "good"
    assert [reason.code for reason in found.quality.reasons] == ["no-motion"]


@pytest.mark.parametrize(
    ("error", "residual", "views", "verdict"),
    [
        (0.1, 0.1, 100, "good"),
        (0.5, 0.1, 100, "doubtful"),
        (5.0, 0.1, 100, "failed"),
        (0.1, 0.3, 100, "doubtful"),
        (0.1, 0.7, 100, "failed"),
        (0.1, 0.4, 9, "good"),  # nine views hardly predict each other
    ],
)
def test_verdicts(error, residual, views, verdict):
    found = judged(Quality("good", residual_after=residual, error=error), views)
    assert found.verdict == verdict
    assert bool(found.reasons) == (verdict != "good")


def test_a_slow_error_of_the_magnification_is_doubtful():
    found = judged(Quality("good", slow_magnification=0.02, distortion=0.5), 100)
    assert found.verdict == "doubtful" and found.reasons[0].code == "magnification"
    # Of a large detector the coarse level cannot tell it, on a small one it displaces little.
    for slow, distortion in ((0.005, 0.5), (0.02, 0.2)):
        few = Quality("good", slow_magnification=slow, distortion=distortion)
        assert judged(few, 100).verdict == "good"
    # Nine views hardly tell.
    assert judged(Quality("good", slow_magnification=0.02, distortion=0.5), 9).verdict == "good"


def test_plain_values_and_back(scan, truth):
    quality = judged(
        Quality("good", residual_after=0.4, error=0.5, residual=(0.25, float("nan"))), 100
    )
    plain = json.loads(json.dumps(quality.as_dict(), allow_nan=False))
    quality = replace(quality, regions=(((0.1, 0.2), (0.3, 0.4)),))
    plain = json.loads(json.dumps(quality.as_dict(), allow_nan=False))
    assert Quality.from_dict(plain).regions == quality.regions
    again = Quality.from_dict({**plain, "of a later version": 1})
    assert again.reasons == quality.reasons and again.shift_after == quality.shift_after
    np.testing.assert_array_equal(again.residual, quality.residual)


def test_align_tells_its_verdict(scan):
    found = clra.align(scan, schedule="3HR")
    assert found.quality.verdict == "good"
    assert clra.align(scan, schedule="1HR", quality=False).quality is None
