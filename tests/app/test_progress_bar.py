import io

import pytest

from clra.app.progress_bar import Lines, duration, shown
from clra.progress import Progress


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.44, "0.4 s"),
        (9.96, "10 s"),
        (59.4, "59 s"),
        (59.6, "1 min 00 s"),
        (125, "2 min 05 s"),
        (12e3, "3 h 20 min"),
        (float("nan"), "?"),
    ],
)
def test_durations_read_like_speech(seconds, text):
    assert duration(seconds) == text


def test_lines_come_at_intervals_and_tell_the_time_left():
    now = [100.0]
    stream = io.StringIO()
    lines = Lines(stream, clock=lambda: now[0])
    for second in range(31):
        now[0] = 100.0 + second
        lines(Progress("aligning", second, 60))
    written = stream.getvalue().splitlines()
    assert written == [
        "aligning: 0 of 60",
        "aligning: 10 of 60, about 50 s left",
        "aligning: 20 of 60, about 40 s left",
        "aligning: 30 of 60, about 30 s left",
    ]


def test_a_new_stage_is_told_at_once_unless_they_pass_quickly():
    now = [0.0]
    stream = io.StringIO()
    lines = Lines(stream, clock=lambda: now[0])
    for time, stage in ((0.0, "a"), (0.1, "b"), (0.2, "c"), (5.0, "d")):
        now[0] = time
        lines(Progress(stage, 0, 1))
    assert stream.getvalue().splitlines() == ["a: 0 of 1", "d: 0 of 1"]


def test_quiet_shows_nothing_and_nothing_goes_to_stdout(capsys):
    with shown(quiet=True) as report:
        report(Progress("a", 0, 1))
    assert capsys.readouterr() == ("", "")
    with shown(quiet=False) as report:
        report(Progress("a", 0, 1))
    out, err = capsys.readouterr()
    assert out == "" and err == "a: 0 of 1\n"


def test_a_terminal_gets_a_bar(capsys, monkeypatch):
    import sys

    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    with shown(quiet=False) as report:
        report(Progress("reading", 1, 4))
        report(Progress("aligning", 2, 4))
    assert capsys.readouterr().out == ""
