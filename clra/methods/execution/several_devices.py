"""One reconstruction on several devices: each takes some planes of the volume at a time."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from queue import Empty, SimpleQueue

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clra.ops.streaming.memory import host_memory
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import PlaneWriter
from clra.progress import Progress, ProgressCallback

Work = Callable[[Stream, slice, PlaneWriter], None]

# Parts a device: with more, a slow device holds the others up less, but radiographs are filtered
# anew for each part that they see.
_PARTS = 3
# Steps of the progress that all devices make together.
_STEPS = 1000


class _StoppedError(Exception):
    """Another device's work failed."""


def on_devices(
    devices: Sequence[cl.Device],
    work: Work,
    planes: int,
    target: PlaneWriter,
    *,
    progress: ProgressCallback | None = None,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
) -> None:
    """Reconstruct a volume on several devices.

    Parameters
    ----------
    devices : sequence of cl.Device
        One or more.
    work : callable
        Reconstructs some planes of the grid on the device of a stream, into what takes them.
    planes : int
        Of the whole volume.
    target : PlaneWriter
        Takes the planes of the whole, from one device at a time.
    progress : callable, optional
        Called with a :class:`clra.progress.Progress` as work goes on, likewise.
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used: on each device, and on the host by all.

    Raises
    ------
    Exception
        What the work raised first; the other devices stop.
    """
    count = min(planes, _PARTS * len(devices))
    parts: SimpleQueue[slice] = SimpleQueue()
    for start, stop in pairwise([planes * k // count for k in range(count + 1)]):
        parts.put(slice(start, stop))
    share = _Share(target, progress, count)
    host = (max_host_memory or host_memory() // 2) // len(devices)
    workers = [_Worker(share, device, max_device_memory, host) for device in devices]
    with ThreadPoolExecutor(len(workers)) as pool:
        futures = [pool.submit(worker.run, work, parts) for worker in workers]
        try:
            errors = [error for future in futures if (error := future.exception())]
        except BaseException:  # Ctrl-C
            share.stopped = True
            raise
    for error in errors:
        if not isinstance(error, _StoppedError):
            raise error


class _Share:
    """What the devices have in common."""

    def __init__(self, target: PlaneWriter, progress: ProgressCallback | None, parts: int) -> None:
        self.target, self.progress, self.parts = target, progress, parts
        self.lock = threading.Lock()
        self.stopped = False
        self.done = 0.0  # parts, and the begun parts of parts


class _Worker:
    """A device that takes one part after the other."""

    def __init__(
        self, share: _Share, device: cl.Device, device_memory: int | None, host_memory: int
    ) -> None:
        self._share = share
        self._stream = Stream(
            device,
            max_device_memory=device_memory,
            max_host_memory=host_memory,
            report=self._report,
        )
        self._start = 0
        self._done = 0.0

    def run(self, work: Work, parts: SimpleQueue[slice]) -> None:
        """Work as long as there are parts."""
        try:
            while True:
                part = parts.get_nowait()
                self._start, self._done = part.start, 0.0
                work(self._stream, part, self)
        except Empty:
            return
        except BaseException:
            self._share.stopped = True
            raise

    def write(self, start: int, planes: NDArray[np.float32], /) -> None:
        """Hand planes of the present part on."""
        with self._share.lock:
            self._share.target.write(self._start + start, planes)

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
                steps = round(_STEPS * share.done / share.parts)
                share.progress(Progress(progress.stage, steps, _STEPS))
