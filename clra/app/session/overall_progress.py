"""How far a whole command is, and how long the rest of it will take."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING

from clra.model.schedule import Stage, level_name

if TYPE_CHECKING:
    from clra.progress import Progress

# Time of a pass of all radiographs through the volume falls by this power of the binning: by 3 for
# voxels, by 2 for pixels.
_POWER = 2.8
# Iterations that "until converged" is expected to take.
_EXPECTED = 4
# Passes of an iteration: reconstruct, simulate, correct, register.
_ITERATION = 4
# Judging an alignment at a quarter of the resolution; slices and re-projections of a report.
_JUDGING, _REPORT = 0.5, 12.0
# Passes that the iterative methods take, by custom.
_ITERATIVE = 12.0
# Seconds, and part of the work, before which a time would be guessed from next to nothing.
_EARLY, _LITTLE = 3.0, 0.01
# Marks of the past are kept when this factor more is done.
_APART = 1.02


@dataclass(frozen=True)
class Part:
    """Work that a command does in one go.

    Attributes
    ----------
    stages : str
        Regular expression for the names of its stages, as progress reports have them.
    work : float
        How much it is, in passes of all radiographs through the volume at full resolution.
    count : int
        Stages that it is expected to have, of about the same length.
    """

    stages: str
    work: float
    count: int = 1


def align_parts(method: str, stages: Sequence[Stage]) -> list[Part]:
    """Return the parts of an alignment, by a schedule if it is by re-projection."""
    if method != "ra":
        return [Part(".*", _ITERATIVE, int(_ITERATIVE))]
    parts = []
    for stage in stages:
        name, work = level_name(stage.level), _ITERATION * stage.level**-_POWER
        last = stage.iterations or min(stage.limit, _EXPECTED)
        parts += [Part(rf"{name} {k}/.*", work, _ITERATION) for k in range(1, last)]
        parts.append(Part(rf"{name} \d+/.*", work, _ITERATION))
    return [*parts, Part("held-out.*|back-projecting", _JUDGING, 15)]


def reconstruction_parts(method: str) -> list[Part]:
    """Return the parts of a reconstruction."""
    if method in ("fbp", "katsevich"):
        return [Part("back-projecting", 1.0)]
    return [Part(".*", _ITERATIVE, int(_ITERATIVE))]


def report_parts(with_scan: bool) -> list[Part]:
    """Return the parts of a report."""
    return [Part("report.*", _REPORT, 11)] if with_scan else []


STEPS: dict[str, float] = {
    "import": 0.3,
    "align": sum(part.work for part in align_parts("ra", [Stage(8, 4, 4), Stage(2, None, 3)])),
    "reconstruct": 1.0,
    "report": _REPORT,
}
"""Work that the steps of ``clra run`` are taken for until they begin and know better."""


class Overall:
    """Part of a command that is done, and the time that is left.

    Parameters
    ----------
    steps : mapping of str to float
        Steps in order, and how much work each is expected to be; a command alone is one step.
    clock : callable
        Seconds that have passed.
    """

    def __init__(
        self, steps: Mapping[str, float], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._steps = dict(steps)
        self._clock = clock
        self._performed = 0.0  # without what was passed over
        self._marks = [(clock(), 0.0)]  # of it
        self.begin(next(iter(self._steps)))

    def begin(self, step: str) -> None:
        """Go on with a step, and take those before it for done."""
        self._step = step
        self._parts: list[Part] = []
        self._index, self._stage, self._stages, self._fraction = 0, "", 0, 0.0

    def split(self, parts: Iterable[Part]) -> None:
        """Tell the parts of the step that has begun."""
        self._parts = list(parts)
        if self._parts:
            self._steps[self._step] = sum(part.work for part in self._parts)

    def update(self, progress: Progress) -> None:
        """Take note of how far a stage is."""
        for index in range(self._index, len(self._parts)):
            if re.fullmatch(self._parts[index].stages, progress.stage):
                break
        else:
            return  # preparations
        if index != self._index:
            self._index, self._stage, self._stages, self._fraction = index, "", 0, 0.0
        if progress.stage != self._stage:
            self._stage, self._stages = progress.stage, self._stages + 1
        part = self._parts[index]
        share = (self._stages - 1 + progress.done / max(progress.total, 1)) / part.count
        more = max(min(share, 1.0) - self._fraction, 0.0)
        self._fraction += more
        self._performed += more * part.work
        if self._performed > self._marks[-1][1] * _APART:
            self._marks.append((self._clock(), self._performed))

    @property
    def part(self) -> float:
        """What is done of all work, 0 to 1."""
        total = sum(self._steps.values())
        return 1 - self._remaining / total if total else 0.0

    @property
    def left(self) -> float:
        """Seconds that are left; NaN while they cannot be told.

        By the speed of the later half of what was done: coarse levels are slow for their work.
        """
        now = self._clock()
        least = _LITTLE * sum(self._steps.values())
        if now - self._marks[0][0] < _EARLY or self._performed <= least:
            return math.nan
        half = 0.5 * self._performed
        since, done = next(mark for mark in reversed(self._marks) if mark[1] <= half)
        return self._remaining * (now - since) / (self._performed - done)

    @property
    def _remaining(self) -> float:
        names = list(self._steps)
        rest = sum(self._steps[name] for name in names[names.index(self._step) + 1 :])
        if not self._parts:
            return rest + self._steps[self._step]
        here = self._parts[self._index].work * (1 - self._fraction)
        return rest + here + sum(part.work for part in self._parts[self._index + 1 :])


_OVERALL: ContextVar[Overall | None] = ContextVar("overall", default=None)


@contextmanager
def several_steps(steps: Mapping[str, float]) -> Iterator[Overall]:
    """Let the commands within a block be steps of a longer one."""
    overall = Overall(steps)
    token = _OVERALL.set(overall)
    try:
        yield overall
    finally:
        _OVERALL.reset(token)


def overall_of(parts: Sequence[Part]) -> Overall | None:
    """Return what keeps account of a command with these parts: None if it is of one alone."""
    overall = _OVERALL.get()
    if overall is None and len(parts) > 1:
        overall = Overall({"": 0.0})
    if overall is not None:
        overall.split(parts)
    return overall
