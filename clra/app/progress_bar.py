"""How far long work is: a bar on a terminal, lines elsewhere, always on stderr."""

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

from clra.app.session.overall_progress import Overall, Part, overall_of

if TYPE_CHECKING:
    from clra.progress import Progress, ProgressCallback

# Seconds between lines where there is no terminal: a log of a night's run stays readable, and
# nobody takes a silent run for a dead one.
_INTERVAL = 10.0
_INTERVAL_OF_NEW_STAGES = 1.0


def duration(seconds: float) -> str:
    """Write a duration as a person would: "0.8 s", "2 min 05 s", "3 h 20 min"; "?" for NaN."""
    if math.isnan(seconds):
        return "?"
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02} min"


class Lines:
    """Progress as lines of text.

    Parameters
    ----------
    stream : text file
        Where to write.
    clock : callable
        Seconds that have passed.
    overall : Overall, optional
        Keeps account of the whole command: then it is this whose remaining time is told.
    """

    def __init__(
        self,
        stream: TextIO,
        clock: Callable[[], float] = time.monotonic,
        overall: Overall | None = None,
    ) -> None:
        self._stream = stream
        self._clock = clock
        self._overall = overall
        self._stage = ""
        self._started = self._last = clock() - _INTERVAL_OF_NEW_STAGES

    def __call__(self, progress: "Progress") -> None:
        """Write a line if it is time for one."""
        now = self._clock()
        if self._overall is not None:
            self._overall.update(progress)
        new = progress.stage != self._stage
        if new:
            self._stage, self._started = progress.stage, now
        if now - self._last < (_INTERVAL_OF_NEW_STAGES if new else _INTERVAL):
            return
        if progress.done == progress.total:
            return  # what comes next tells it
        self._last = now
        line = f"{progress.stage}: {progress.done} of {progress.total}"
        if self._overall is not None:
            line += f"; {all_told(self._overall)}"
        elif progress.done and not new:
            left = (now - self._started) * (progress.total - progress.done) / progress.done
            line += f", about {duration(left)} left"
        print(line, file=self._stream, flush=True)


def all_told(overall: Overall) -> str:
    """Say how far a command is: "35 % of all, about 2 min 05 s left"."""
    left = overall.left
    rest = "" if math.isnan(left) else f", about {duration(left)} left"
    return f"{math.floor(100 * overall.part)} % of all{rest}"


@contextmanager
def shown(quiet: bool, parts: Sequence[Part] = ()) -> Iterator["ProgressCallback"]:
    """Show progress while the block runs.

    Parameters
    ----------
    quiet : bool
        Show nothing.
    parts : sequence of Part
        Of the work in the block: with several, and within
        :func:`clra.app.session.overall_progress.several_steps`, progress is that of it all.

    Yields
    ------
    callable
        To be called with every :class:`~clra.progress.Progress`.
    """
    if quiet:
        yield lambda progress: None
    elif sys.stderr.isatty():
        with _bar(overall_of(parts)) as report:
            yield report
    else:
        yield Lines(sys.stderr, overall=overall_of(parts))


@contextmanager
def _bar(overall: Overall | None) -> Iterator["ProgressCallback"]:
    from rich import progress as bars
    from rich.console import Console

    columns = (
        bars.TextColumn("{task.description}"),
        bars.BarColumn(),
        bars.TaskProgressColumn(),
        bars.TimeElapsedColumn(),
        *(
            [bars.TextColumn("left"), bars.TimeRemainingColumn()]
            if overall is None
            else [bars.TextColumn("{task.fields[told]}")]
        ),
    )
    with bars.Progress(*columns, console=Console(stderr=True), transient=True) as display:
        task = display.add_task("", total=None, told="")
        stage = None

        def report(progress: "Progress") -> None:
            nonlocal stage
            if overall is not None:
                overall.update(progress)
                told = all_told(overall)
                display.update(
                    task, description=progress.stage, completed=overall.part, total=1.0, told=told
                )
                return
            if progress.stage != stage:
                stage = progress.stage
                display.reset(task, description=stage, total=progress.total)
            display.update(task, completed=progress.done, total=progress.total)

        yield report
