"""Tasks on several devices of this machine: each takes the next one when it has done with one."""

import shutil
import threading
import uuid
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import pyopencl as cl

from clra.findings import Finding, collected
from clra.methods.execution.executor import PARTS, Item, Result, Task
from clra.ops.streaming.memory import host_memory
from clra.ops.streaming.stream import Stream, equal_runs
from clra.progress import Progress, ProgressCallback

# Steps of the progress that all devices make together.
_STEPS = 1000


class _StoppedError(Exception):
    """Another device's work failed."""


class SeveralDevices:
    """Tasks in one thread a device; see :class:`clra.methods.execution.executor.WorkerGroup`.

    Parameters
    ----------
    devices : sequence of cl.Device
        One or more.
    folder : Path
        For files that tasks leave for each other; made when it is needed, and what it holds is
        lost.
    progress : callable, optional
        Called with a :class:`clra.progress.Progress` as work goes on, from one thread at a time.
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used: on each device, and on the host by all.
    """

    folder: Path | None = None

    def __init__(
        self,
        devices: Sequence[cl.Device],
        folder: Path,
        *,
        progress: ProgressCallback | None = None,
        max_device_memory: int | None = None,
        max_host_memory: int | None = None,
    ) -> None:
        self.places = len(devices)
        self._progress, self._files = progress, folder.absolute()
        self._session, self._number = uuid.uuid4().hex[:8], 0
        limits = {
            "max_device_memory": max_device_memory,
            "max_host_memory": (max_host_memory or host_memory() // 2) // len(devices),
        }
        self._workers = [_Worker(device, limits) for device in devices]
        self.slab_bytes = min(worker.stream.budgets.slab for worker in self._workers)

    def close(self) -> None:
        """Remove the files that tasks left."""
        shutil.rmtree(self._files, ignore_errors=True)

    def parts(self, shape: tuple[int, int, int]) -> list[slice]:
        """Cut the planes of a volume (nz, ny, nx) into tasks, some for each device."""
        return equal_runs(shape[0], min(shape[0], PARTS * self.places))

    def share(self, value: Any) -> "InMemory":
        """Give all tasks a value, once."""
        return InMemory(value)

    def new_folder(self, name: str) -> Path:
        """Make a folder that no task has written to."""
        self._number += 1
        folder = self._files / f"{name}-{self._session}-{self._number:05}"
        folder.mkdir(parents=True)
        return folder

    def map(
        self,
        task: Task[Item, Result],
        items: Sequence[Item],
        *,
        stage: str,
        part: tuple[int, int] | None = (0, 1),
        done: Callable[[int], None] | None = None,
    ) -> list[Result]:
        """Do a task with each of some items; see :class:`clra.methods.execution.executor.Executor`.

        Raises
        ------
        Exception
            What a task raised first; the other devices stop.
        """
        share = _Share(task, items, stage, part, self._progress, done)
        with ThreadPoolExecutor(self.places) as pool:
            futures = [pool.submit(worker.run, share) for worker in self._workers]
            try:
                errors = [error for future in futures if (error := future.exception())]
            except BaseException:  # Ctrl-C
                share.stopped = True
                raise
        for finding in share.findings:
            finding.warn()
        for error in errors:
            if not isinstance(error, _StoppedError):
                raise error
        return [share.results[number] for number in range(len(items))]


@dataclass(frozen=True)
class InMemory:
    """A value that tasks of this process have in common."""

    value: Any

    def get(self) -> Any:
        """Return the value."""
        return self.value


class _Share:
    """What the devices have in common in one call."""

    def __init__(
        self,
        task: Task[Any, Any],
        items: Sequence[Any],
        stage: str,
        part: tuple[int, int] | None,
        progress: ProgressCallback | None,
        done: Callable[[int], None] | None,
    ) -> None:
        self.task, self.stage, self.told = task, stage, done
        self.progress, (self.first, self.parts) = (progress, part) if part else (None, (0, 1))
        self.count = len(items)
        self.items: SimpleQueue[tuple[int, Any]] = SimpleQueue()
        for number, item in enumerate(items):
            self.items.put((number, item))
        self.results: dict[int, Any] = {}
        self.findings: list[Finding] = []
        self.lock = threading.Lock()
        self.stopped = False
        self.done = 0.0  # items, and the begun parts of items


class _Worker:
    """A device that takes one item after the other."""

    def __init__(self, device: cl.Device, limits: dict[str, Any]) -> None:
        self.stream = Stream(device, report=self._report, **limits)
        self._share: _Share | None = None
        self._done = 0.0

    def run(self, share: _Share) -> None:
        """Work as long as there are items."""
        self._share = share
        try:
            while True:
                number, item = share.items.get_nowait()
                self._done = 0.0
                with collected(silent=True) as findings:  # issued by the caller's thread
                    result = share.task(self.stream, item)
                self._report(Progress(share.stage, 1, 1))
                with share.lock:
                    share.results[number] = result
                    share.findings += findings
                    if share.told is not None:
                        share.told(number)
        except Empty:
            return
        except BaseException:
            share.stopped = True
            raise
        finally:
            self._share = None

    def _report(self, progress: Progress) -> None:
        """Hand on how far all devices are; or stop."""
        share = self._share
        if share is None:  # the device is being tested
            return
        with share.lock:
            if share.stopped:
                raise _StoppedError
            done = progress.done / max(1, progress.total)
            share.done += max(0.0, done - self._done)
            self._done = max(done, self._done)
            if share.progress is not None:
                made = share.first + min(1.0, share.done / share.count)
                steps = round(_STEPS * made / share.parts)
                share.progress(Progress(share.stage, steps, _STEPS))
