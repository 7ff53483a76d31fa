"""Schedules as text, and the stop rule."""

import numpy as np
import pytest

from clra.model.schedule import Stage, converged, level_name, parse_schedule, update_size


@pytest.mark.parametrize(
    ("text", "stages"),
    [
        ("1QR-1HR", [(4, 1, 1), (2, 1, 1)]),
        ("2qr-12hr", [(4, 2, 2), (2, 12, 12)]),
        ("4FR", [(1, 4, 4)]),
        ("3SR-2ER", [(16, 3, 3), (8, 2, 2)]),
        ("2ER-1QR-1HR-3FR", [(8, 2, 2), (4, 1, 1), (2, 1, 1), (1, 3, 3)]),
        ("auto", [(8, 4, 4), (4, None, 20, 0.02, 0.003), (2, None, 6, 0.05, 0.003)]),
    ],
)
def test_text_becomes_stages(text, stages):
    assert parse_schedule(text) == tuple(Stage(*stage) for stage in stages)


def test_auto_begins_at_an_eighth_where_that_leaves_something():
    assert [str(stage) for stage in parse_schedule("auto", (928, 512))] == ["6ER", "3QR", "HR"]
    assert parse_schedule("auto", (928, 300)) == parse_schedule("auto")
    assert parse_schedule("1QR", (928, 512)) == parse_schedule("1QR")


def test_auto_leaves_out_levels_too_small_to_be_registered():
    for shape, stages in (
        ((128, 130), ["4ER", "QR", "HR"]),
        ((127, 500), ["QR", "HR"]),
        ((63, 64), ["HR"]),
        ((20, 31), ["FR"]),
    ):
        assert [str(stage) for stage in parse_schedule("auto", shape)] == stages


@pytest.mark.parametrize(
    "text",
    ["", "QR", "0QR", "1XR", "1QR-", "-1QR", "1QR 1HR", "1QR,1HR", "1.5QR", "100FR", "Auto?"],
)
def test_bad_text_says_what_a_schedule_looks_like(text):
    with pytest.raises(ValueError, match=r"schedule: found .* such as '1QR-1HR'"):
        parse_schedule(text)


def test_stages_print_as_they_are_written():
    assert "-".join(str(stage) for stage in parse_schedule("2ER-1QR-3FR")) == "2ER-1QR-3FR"
    assert [str(stage) for stage in parse_schedule("auto")] == ["4ER", "QR", "HR"]
    assert [level_name(level) for level in (1, 2, 4, 8, 16)] == ["FR", "HR", "QR", "ER", "SR"]
    with pytest.raises(ValueError, match="level: found 3"):
        level_name(3)


def test_small_updates_have_converged():
    small = np.full(9, -0.09)
    assert converged(small, small)
    assert not converged(np.full(9, 0.11), 0 * small)
    assert not converged(0 * small, np.full(9, 0.11))
    one_large = small.copy()
    one_large[4] = -0.51
    assert not converged(small, one_large)


def test_updates_that_no_longer_shrink_have_converged():
    u, v = np.full(5, 0.3), np.full(5, -0.4)
    median, largest = update_size(u, v)
    assert (median, largest) == pytest.approx((0.4, 0.4))
    assert converged(u, v, median)
    assert converged(u, v, 0.3)
    assert not converged(u, v, 0.41)


def test_slow_modes_are_waited_for():
    slow = np.full(5, 0.03)
    assert converged(slow, 0 * slow, 0.03)
    assert not converged(slow, 0 * slow, 0.03, tolerance=0.02)
    assert converged(0.5 * slow, 0 * slow, 0.03, tolerance=0.02)
    far = np.array([0.03, 0.03, 0.03, 0.03, 0.6])
    assert converged(far, 0 * far, 0.03, tolerance=0.02)  # one wanders
    assert not converged(far, 0 * far, 0.04, tolerance=0.02)
