"""How far whole commands are, by a clock that the tests turn."""

import io
import math

import numpy as np
import pytest

import clra
from clra.app.progress_bar import Lines
from clra.app.session.overall_progress import (
    Overall,
    Part,
    align_parts,
    overall_of,
    several_steps,
)
from clra.model.schedule import Stage, parse_schedule
from clra.progress import Progress


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def work(overall, clock, stage, seconds):
    """Do a stage at even speed."""
    for done in range(11):
        overall.update(Progress(stage, done, 10))
        clock.now += seconds / 10 * (done < 10)


def test_time_left_is_exact_at_even_speed(clock):
    overall = Overall({"": 0.0}, clock)
    overall.split([Part("a", 1.0), Part("b .*", 3.0, 3)])
    assert overall.part == 0 and math.isnan(overall.left)
    work(overall, clock, "reading", 0.0)
    work(overall, clock, "a", 10.0)
    assert overall.part == 0.25 and overall.left == pytest.approx(30)
    work(overall, clock, "b 1", 10.0)
    work(overall, clock, "b 2", 10.0)
    assert overall.part == 0.75 and overall.left == pytest.approx(10)
    work(overall, clock, "b 3", 10.0)
    assert overall.part == 1 and overall.left == 0


def test_what_is_passed_over_is_no_speed(clock):
    overall = Overall({"": 0.0}, clock)
    overall.split(align_parts("ra", [Stage(1, None, 4)]))
    for iteration in (1, 2):
        for doing in ("reconstructing", "simulating", "correcting", "registering"):
            work(overall, clock, f"FR {iteration}/at most 4: {doing}", 8.0)
    before = overall.left
    assert before == pytest.approx(2 * 32 + 4, rel=0.01)
    work(overall, clock, "held-out views: pass", 0.0)  # it has converged
    assert overall.left < 4.5


def test_later_work_tells_the_speed(clock):
    """Small levels are slow for their work: they must not count for ever."""
    overall = Overall({"": 0.0}, clock)
    overall.split([Part("coarse", 1.0), Part("fine", 9.0)])
    work(overall, clock, "coarse", 100.0)
    for done in range(4):
        overall.update(Progress("fine", done, 9))
        clock.now += 10.0 * (done < 3)
    assert overall.left == pytest.approx(60, rel=0.02)


def test_steps_of_a_command_know_better_when_they_begin(clock):
    overall = Overall({"one": 5.0, "two": 5.0}, clock)
    overall.split([Part("a", 5.0)])
    work(overall, clock, "a", 20.0)
    assert overall.part == 0.5
    overall.begin("two")
    assert overall.part == 0.5
    overall.split([Part("b", 10.0), Part("c", 5.0)])
    assert overall.part == 0.25 and overall.left == pytest.approx(60)


def test_commands_within_a_longer_one_share_its_account():
    assert overall_of([Part("a", 1.0)]) is None and overall_of([]) is None
    assert overall_of([Part("a", 1.0), Part("b", 1.0)]) is not None
    with several_steps({"one": 1.0, "two": 3.0}) as overall:
        assert overall_of([Part("a", 1.0)]) is overall is overall_of([])


def test_lines_tell_how_far_it_all_is(clock):
    overall = Overall({"": 0.0}, clock)
    overall.split([Part("a", 1.0), Part("b", 1.0)])
    stream = io.StringIO()
    lines = Lines(stream, clock, overall)
    for second in range(31):
        lines(Progress("a", second, 30))
        clock.now += 1.0
    assert stream.getvalue().splitlines() == [
        "a: 0 of 30; 0 % of all",
        "a: 10 of 30; 16 % of all, about 50 s left",
        "a: 20 of 30; 33 % of all, about 40 s left",
    ]


def test_stages_of_an_alignment_are_those_that_are_expected(clock, scan):
    overall, seen = Overall({"": 0.0}, clock), []
    stages = parse_schedule("2FR")
    overall.split(align_parts("ra", stages))

    def progress(told):
        overall.update(told)
        seen.append(overall.part)

    clra.align(scan, schedule="2FR", progress=progress)
    assert (np.diff(seen) >= 0).all()
    assert 0.9 < seen[-1] <= 1 and sum(0.1 < part < 0.8 for part in seen) > 4
