"""The seam between methods and who executes: tasks over items, wherever they run."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from clra.errors import ClusterError
from clra.ops.streaming.part_files import PlaneParts
from clra.ops.streaming.stream import Stream, equal_runs
from clra.ops.streaming.volume import PlaneWriter

Item = TypeVar("Item")
Result = TypeVar("Result")

Task = Callable[[Stream, Item], Result]
"""Does some work on the device of a stream; the same whenever it is done with the same item."""

Work = Callable[[Stream, slice, PlaneWriter], None]
"""Reconstructs some planes, counted from the first of these, into what takes them."""

# Parts of a volume for each place: with more, a slow device holds the others up less, but
# radiographs are filtered anew for each part that they see.
PARTS = 3


class Executor(Protocol):
    """Who executes.

    Attributes
    ----------
    places : int
        Tasks that are worked on at a time.
    folder : Path or None
        Where tasks leave files for each other and for the caller; None where they share its memory.
    """

    places: int

    @property
    def folder(self) -> Path | None:
        """Where tasks leave files; see above."""
        ...

    def parts(self, shape: tuple[int, int, int]) -> list[slice]:
        """Cut the planes of a volume (nz, ny, nx) into tasks."""
        ...

    def map(
        self,
        task: Task[Any, Any],
        items: Sequence[Any],
        *,
        stage: str,
        part: tuple[int, int] | None = (0, 1),
        done: Callable[[int], None] | None = None,
    ) -> list[Any]:
        """Do a task with each of some items.

        Parameters
        ----------
        task : callable
            Called with a stream and an item. For other processes it has to be picklable, and what
            it returns small.
        items : sequence
            In the order in which they are begun.
        stage : str
            What progress reports call it.
        part : (int, int) or None
            Number of this call, and how many calls the stage consists of; with None there are no
            progress reports.
        done : callable, optional
            Called with the number of each item that is done, one call at a time.

        Returns
        -------
        list
            What the task returned for each item.
        """
        ...


class Held(Protocol):
    """A value that tasks have in common."""

    def get(self) -> Any:
        """Return the value."""
        ...


class WorkerGroup(Executor, Protocol):
    """Several that execute at a time, and leave files for each other.

    Attributes
    ----------
    slab_bytes : int
        That the smallest device takes of a volume at a time.
    """

    @property
    def slab_bytes(self) -> int:
        """Most bytes of a slab; see above."""
        ...

    def share(self, value: Any) -> Held:
        """Give all tasks a value, once."""
        ...

    def new_folder(self, name: str) -> Path:
        """Make a folder that no task has written to."""
        ...


class InProcess:
    """Tasks one after the other on the device of a stream, which reports progress itself.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    """

    places = 1
    folder: Path | None = None

    def __init__(self, stream: Stream) -> None:
        self._stream = stream

    def parts(self, shape: tuple[int, int, int]) -> list[slice]:
        """Leave the planes of a volume together."""
        return [slice(0, shape[0])]

    def map(
        self,
        task: Task[Item, Result],
        items: Sequence[Item],
        *,
        stage: str,
        part: tuple[int, int] | None = (0, 1),
        done: Callable[[int], None] | None = None,
    ) -> list[Result]:
        """Do a task with each of some items; see :class:`Executor`."""
        results = []
        for number, item in enumerate(items):
            results.append(task(self._stream, item))
            if done is not None:
                done(number)
        return results


def reconstruct_planes(
    executor: Executor,
    work: Work,
    shape: tuple[int, int, int],
    target: PlaneWriter,
    *,
    stage: str,
    part: tuple[int, int] | None = (0, 1),
) -> None:
    """Reconstruct a volume, some planes a task.

    Parameters
    ----------
    executor : Executor
        Who does it.
    work : callable
        Reconstructs some planes; picklable for other processes.
    shape : (int, int, int)
        Of the whole volume.
    target : PlaneWriter
        Takes the planes of the whole, one call at a time.
    stage, part
        As :meth:`Executor.map` takes them.
    """
    parts = executor.parts(shape)
    if executor.folder is None:
        executor.map(_PlanesTask(work, target, threading.Lock()), parts, stage=stage, part=part)
        return
    files = PlaneParts(executor.folder, shape)
    executor.map(
        _FiledPlanesTask(work, files),
        parts,
        stage=stage,
        part=part,
        done=lambda number: files.hand_on(parts[number], target),
    )


def slabs_of(
    places: int, slab_bytes: float, shape: tuple[int, int, int], volumes: int = 1
) -> list[slice]:
    """Cut a volume into tasks: one slab a worker or more, none larger than its device takes.

    More slabs would be read for more: on a helix most views see most of them.

    Parameters
    ----------
    places : int
        WorkerGroup.
    slab_bytes : float
        That the smallest device takes.
    shape : (int, int, int)
        Voxels (nz, ny, nx).
    volumes : int
        Slabs that a device holds at a time.

    Raises
    ------
    ClusterError
        If one plane is larger than that.
    """
    nz, ny, nx = shape
    most = int(slab_bytes / volumes / (4 * ny * nx))
    if most < 1:
        raise ClusterError(
            f"one plane of {ny} x {nx} voxels is more than the workers' devices take at once, "
            f"{slab_bytes / volumes / 1024:.0f} KiB: use a coarser grid or raise the memory limits"
        )
    return equal_runs(nz, min(nz, max(places, -(-nz // most))))


@dataclass(frozen=True)
class _PlanesTask:
    """Hands planes on as they are made."""

    work: Work
    target: PlaneWriter
    lock: threading.Lock  # type: ignore[valid-type,unused-ignore]

    def __call__(self, stream: Stream, planes: slice) -> None:
        self.work(stream, planes, _From(planes.start, self.target, self.lock))


@dataclass(frozen=True)
class _FiledPlanesTask:
    """Leaves planes in a file."""

    work: Work
    files: PlaneParts

    def __call__(self, stream: Stream, planes: slice) -> None:
        with self.files.writing(planes) as target:
            self.work(stream, planes, target)


@dataclass(frozen=True)
class _From:
    """Takes planes that are counted from the first of a part."""

    start: int
    target: PlaneWriter
    lock: threading.Lock  # type: ignore[valid-type,unused-ignore]

    def write(self, start: int, part: NDArray[np.float32], /) -> None:
        with self.lock:
            self.target.write(self.start + start, part)
