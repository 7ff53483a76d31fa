"""How far long work is, and how callers are told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """How far a piece of work is: `done` of `total` steps of the stage named `stage`."""

    stage: str
    done: int
    total: int


ProgressCallback = Callable[[Progress], None]
"""May raise :class:`clra.errors.Cancelled` to end a long call early."""


def tell(progress: ProgressCallback | None, stage: str, done: int, total: int) -> None:
    """Call `progress`, if there is one."""
    if progress is not None:
        progress(Progress(stage, done, total))
