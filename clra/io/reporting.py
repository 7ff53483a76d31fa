"""How the writers tell their progress."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from clra.ops.streaming.stream import Progress

Report = Callable[["Progress"], None]


def tell(report: Report | None, stage: str, done: int, total: int) -> None:
    """Call `report`, if there is one, with how far the work is."""
    if report is not None:
        # Only here: reading a scan needs no OpenCL.
        from clra.ops.streaming.stream import Progress

        report(Progress(stage, done, total))
