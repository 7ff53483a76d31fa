"""Tasks on several devices of this machine: each takes the next one when it has done with one."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import pyopencl as cl

from clra.methods.execution.executor import PARTS, Item, Result, Task
from clra.ops.streaming.memory import host_memory
from clra.ops.streaming.stream import Stream, equal_runs
from clra.progress import Progress, ProgressCallback

# Steps of the progress that all devices make together.
_STEPS = 1000


class _StoppedError(Exception):
    """Another device's work failed."""


class SeveralDevices:
    """Tasks in one thread a device; see :class:`clra.methods.execution.executor.Executor`.

    Parameters
    ----------
    devices : sequence of cl.Device
        One or more.
    progress : callable, optional
        Called with a :class:`clra.progress.Progress` as work goes on, from one thread at a time.
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used: on each device, and on the host by all.
    """

    folder: Path | None = None

    def __init__(
        self,
        devices: Sequence[cl.Device],
        *,
        progress: ProgressCallback | None = None,
        max_device_memory: int | None = None,
        max_host_memory: int | None = None,
    ) -> None:
        self.places = len(devices)
        self._devices, self._progress = devices, progress
        self._device_memory = max_device_memory
        self._host_memory = (max_host_memory or host_memory() // 2) // len(devices)

    def parts(self, shape: tuple[int, int, int]) -> list[slice]:
        """Cut the planes of a volume (nz, ny, nx) into tasks, some for each device."""
        return equal_runs(shape[0], min(shape[0], PARTS * self.places))

    def map(
        self,
        task: Task[Item, Result],
        items: Sequence[Item],
        *,
        stage: str,
        done: Callable[[int], None] | None = None,
    ) -> list[Result]:
        """Do a task with each of some items; progress has the names of the tasks' own stages.

        Raises
        ------
        Exception
            What a task raised first; the other devices stop.
        """
        share = _Share(task, items, self._progress, done)
        limits = {
            "max_device_memory": self._device_memory,
            "max_host_memory": self._host_memory,
        }
        workers = [_Worker(share, device, limits) for device in self._devices]
        with ThreadPoolExecutor(len(workers)) as pool:
            futures = [pool.submit(worker.run) for worker in workers]
            try:
                errors = [error for future in futures if (error := future.exception())]
            except BaseException:  # Ctrl-C
                share.stopped = True
                raise
        for error in errors:
            if not isinstance(error, _StoppedError):
                raise error
        return [share.results[number] for number in range(len(items))]


class _Share:
    """What the devices have in common."""

    def __init__(
        self,
        task: Task[Any, Any],
        items: Sequence[Any],
        progress: ProgressCallback | None,
        done: Callable[[int], None] | None,
    ) -> None:
        self.task, self.progress, self.told = task, progress, done
        self.count = len(items)
        self.items: SimpleQueue[tuple[int, Any]] = SimpleQueue()
        for number, item in enumerate(items):
            self.items.put((number, item))
        self.results: dict[int, Any] = {}
        self.lock = threading.Lock()
        self.stopped = False
        self.done = 0.0  # items, and the begun parts of items


class _Worker:
    """A device that takes one item after the other."""

    def __init__(self, share: _Share, device: cl.Device, limits: dict[str, Any]) -> None:
        self._share = share
        self._stream = Stream(device, report=self._report, **limits)
        self._done = 0.0

    def run(self) -> None:
        """Work as long as there are items."""
        share = self._share
        try:
            while True:
                number, item = share.items.get_nowait()
                self._done = 0.0
                result = share.task(self._stream, item)
                with share.lock:
                    share.results[number] = result
                    if share.told is not None:
                        share.told(number)
        except Empty:
            return
        except BaseException:
            share.stopped = True
            raise

    def _report(self, progress: Progress) -> None:
        """Hand on how far all devices are; or stop."""
        share = self._share
        with share.lock:
            if share.stopped:
                raise _StoppedError
            done = progress.done / max(1, progress.total)
            share.done += max(0.0, done - self._done)
            self._done = max(done, self._done)
            if share.progress is not None:
                steps = round(_STEPS * share.done / share.count)
                share.progress(Progress(progress.stage, steps, _STEPS))
