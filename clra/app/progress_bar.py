"""How far long work is: a bar on a terminal, lines elsewhere, always on stderr."""

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

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
    """

    def __init__(self, stream: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        self._stream = stream
        self._clock = clock
        self._stage = ""
        self._started = self._last = clock() - _INTERVAL_OF_NEW_STAGES

    def __call__(self, progress: "Progress") -> None:
        """Write a line if it is time for one."""
        now = self._clock()
        new = progress.stage != self._stage
        if new:
            self._stage, self._started = progress.stage, now
        if now - self._last < (_INTERVAL_OF_NEW_STAGES if new else _INTERVAL):
            return
        if progress.done == progress.total:
            return  # what comes next tells it
        self._last = now
        line = f"{progress.stage}: {progress.done} of {progress.total}"
        if progress.done and not new:
            left = (now - self._started) * (progress.total - progress.done) / progress.done
            line += f", about {duration(left)} left"
        print(line, file=self._stream, flush=True)


@contextmanager
def shown(quiet: bool) -> Iterator["ProgressCallback"]:
    """Show progress while the block runs.

    Parameters
    ----------
    quiet : bool
        Show nothing.

    Yields
    ------
    callable
        To be called with every :class:`~clra.progress.Progress`.
    """
    if quiet:
        yield lambda progress: None
    elif sys.stderr.isatty():
        with _bar() as report:
            yield report
    else:
        yield Lines(sys.stderr)


@contextmanager
def _bar() -> Iterator["ProgressCallback"]:
    from rich import progress as bars
    from rich.console import Console

    columns = (
        bars.TextColumn("{task.description}"),
        bars.BarColumn(),
        bars.TaskProgressColumn(),
        bars.TimeElapsedColumn(),
        bars.TextColumn("left"),
        bars.TimeRemainingColumn(),
    )
    with bars.Progress(*columns, console=Console(stderr=True), transient=True) as display:
        task = display.add_task("", total=None)
        stage = None

        def report(progress: "Progress") -> None:
            nonlocal stage
            if progress.stage != stage:
                stage = progress.stage
                display.reset(task, description=stage, total=progress.total)
            display.update(task, completed=progress.done, total=progress.total)

        yield report
