"""Views that are rejected, and what they are given instead."""

import numpy as np
import pytest

import clra
from clra.methods.alignment.rejected_views import (
    Rejections,
    from_neighbours,
    neighbour_weights,
    outliers,
    unusable_radiographs,
)
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream


def test_views_far_below_the_others_are_found():
    correlation = np.random.default_rng(0).normal(0.95, 0.01, 200)
    correlation[[7, 120]] = 0.0, 0.5
    assert np.flatnonzero(outliers(correlation)).tolist() == [7, 120]


def test_views_that_are_equally_good_are_all_valid_views():
    assert not outliers(np.full(50, 0.99)).any()
    assert not outliers(np.linspace(0.91, 0.99, 50)).any()


def test_where_all_fit_perfectly_little_is_already_far():
    correlation = np.random.default_rng(0).normal(0.997, 0.0005, 200)
    correlation[7] = 0.91
    assert np.flatnonzero(outliers(correlation)).tolist() == [7]


@pytest.mark.parametrize("order", [slice(None), slice(None, None, -1)])
def test_the_last_views_of_a_scan_may_all_fit_worse(order):
    correlation = np.full(180, 0.999)
    correlation[150:] = np.linspace(0.999, 0.8, 30)
    assert not outliers(correlation[order]).any()
    # A wrong one among them, or at the very end of a scan whose others fit, is found.
    correlation[165] = 0.4
    assert np.flatnonzero(outliers(correlation[order])[order]).tolist() == [165]
    correlation[150:] = 0.999
    correlation[178] = 0.9
    assert np.flatnonzero(outliers(correlation[order])[order]).tolist() == [178]


def _odd(images):
    geometry = clra.circular(
        len(images),
        source_to_axis=5.0,
        source_to_detector=50.0,
        pixel_size=0.1,
        shape=images.shape[1:],
    )
    stream = Stream()
    return unusable_radiographs(stream, Radiographs(stream, clra.Scan(images, geometry), 1))


def test_blank_dark_and_clipped_radiographs_are_odd_by_themselves():
    rows = np.random.default_rng(1).normal(1.0, 0.3, (60, 17, 19)).astype(np.float32)
    rows *= 1 + 0.2 * np.sin(2 * np.arange(60))[:, None, None]  # a sample that is not round
    assert _odd(rows) == {}
    rows[3], rows[17], rows[40] = 0.0, 12.0, np.minimum(rows[40], 0.3)
    found = _odd(rows)
    assert sorted(found) == [3, 17, 40]
    assert "blank" in found[3] and "dark" in found[17] and "blank or saturated" in found[40]


def test_a_view_that_was_accepted_before_stays_where_it_was():
    rejections = Rejections(5)
    before = clra.Motion(shift_u=[0, 4, -5, 3, 0], shift_v=[0] * 5)
    after = clra.Motion(shift_u=[1, 4, 9, 3, 9], shift_v=[0] * 5)
    rejected = np.arange(5) == 2
    # Rejected from the first on it lies between its neighbours, ...
    settled = rejections.settled(before, after, rejected, first=True)
    assert settled.shift_u.tolist() == [1, 4, 3.5, 3, 9]
    rejections.settled(before, before, rejected & False, first=False)
    # ... accepted in between it keeps what that gave.
    settled = rejections.settled(before, after, rejected, first=False)
    assert settled.shift_u.tolist() == [1, 4, -5, 3, 9]


def test_each_rejected_view_has_its_reason():
    rejections = Rejections(6, [4])
    rejections.reasons = {1: "blank"}
    found = rejections.of(np.array([0.99, 0.99, 0.1, 0.99, 0.99, 0.99]))
    assert np.flatnonzero(found).tolist() == [2, 4]
    texts = [str(finding) for finding in rejections.findings(np.arange(6) % 4 != 0)]
    assert texts[0] == "view 1 rejected: blank"
    assert texts[1].startswith("views 2, 3, 5 rejected: no fit")
    (excluded,) = rejections.findings(np.arange(6) == 4)
    assert excluded.measured == {"views": "4", "reason": "excluded by the user"}


def test_ends_of_a_scan_that_look_past_the_sample_are_not_odd():
    fading = np.clip(np.minimum(np.arange(80), np.arange(80)[::-1]) / 8, 0.05, 1.0)
    rows = np.random.default_rng(2).normal(1.0, 0.3, (80, 17, 19)) * fading[:, None, None]
    assert _odd(rows.astype(np.float32)) == {}


def _around(views):
    angle = 2 * np.pi * np.arange(views) / views
    return np.stack([5 * np.sin(angle), -5 * np.cos(angle), 0 * angle], axis=1)


def test_the_weight_of_a_view_left_out_goes_to_those_beside_it():
    valid_views = np.arange(72) != 0
    weights = neighbour_weights(_around(72), valid_views)
    assert weights.sum() == pytest.approx(72)
    # By the inverse squared distance, 1 : 2 : 3 but for a little: the sources stand on a circle.
    shares = np.array([1, 1 / 4, 1 / 9]) / (2 * (1 + 1 / 4 + 1 / 9))
    assert weights[1:4] == pytest.approx(1 + shares, rel=1e-3)
    assert weights[:-4:-1] == pytest.approx(1 + shares, rel=1e-3)
    assert (weights[4:69] == 1).all() and weights[0] == 0


def test_beside_means_where_the_source_was_and_not_when():
    order = np.random.default_rng(0).permutation(72)
    valid_views = np.arange(72) != 0
    weights = neighbour_weights(_around(72)[order], valid_views[order])
    assert np.allclose(weights, neighbour_weights(_around(72), valid_views)[order], rtol=1e-12)


def test_a_long_gap_stays_a_gap():
    valid_views = np.arange(72) >= 20
    weights = neighbour_weights(_around(72), valid_views)
    # The six nearest at either end at most double.
    assert weights.max() == 2 and 52 < weights.sum() <= 64


def test_weights_without_a_choice():
    assert (neighbour_weights(_around(9), np.ones(9, np.bool_)) == 1).all()
    assert neighbour_weights(_around(9), np.arange(9) == 4).tolist() == [0, 0, 0, 0, 2, 0, 0, 0, 0]
    # Views from one and the same place.
    assert neighbour_weights(np.ones((4, 3)), np.arange(4) > 0)[1:].tolist() == pytest.approx(
        [4 / 3] * 3
    )


def test_weak_views_get_what_lies_between_their_neighbours():
    views = np.arange(6.0)
    motion = clra.Motion(shift_u=views, shift_v=-2 * views, magnification=1 + 0.001 * views)
    spoilt = clra.Motion(
        shift_u=np.where(views == 3, 99, views),
        shift_v=np.where(views == 3, 99, -2 * views),
        magnification=np.where(views == 3, 1.5, 1 + 0.001 * views),
        cause="source",
    )
    mended = from_neighbours(spoilt, views == 3)
    for name in ("shift_u", "shift_v", "magnification"):
        assert np.allclose(getattr(mended, name), getattr(motion, name), rtol=1e-12)
    assert mended.cause == "source"
    assert from_neighbours(spoilt, views < 0) is spoilt


def test_weak_views_at_an_end_get_the_nearest():
    motion = clra.Motion(shift_u=[9.0, 1.0, 2.0], shift_v=[9.0, 3.0, 4.0])
    mended = from_neighbours(motion, np.array([True, False, False]))
    assert mended.shift_u.tolist() == [1.0, 1.0, 2.0]
