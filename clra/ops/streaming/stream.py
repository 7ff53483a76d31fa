"""Work cut to fit the memory: views in chunks, volumes in z-slabs, host and device kept apart.

This is the one module that moves data between host and device. A CPU device works on the host's
own arrays: nothing is copied that can be shared.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
import pyopencl as cl
import pyopencl.array
from numpy.typing import NDArray

from clra.model.grid import VolumeGrid
from clra.model.scan import Scan
from clra.ops.images.pyramid import Restrict2D
from clra.ops.projection.transpose import Planes, Transpose
from clra.ops.runtime import build
from clra.ops.runtime.devices import choose_device
from clra.ops.streaming.memory import Budgets, DeviceMemory, DeviceMemoryError, HostRoom, Store

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Progress:
    """How far a piece of work is: `done` of `total` steps of the stage named `stage`."""

    stage: str
    done: int
    total: int


Report = Callable[[Progress], None]


class Stream:
    """One device with its queue, and how much memory may be used on it and on the host.

    On a CPU device buffers lie in the host's memory: the device's budget is then a part of the
    host's, at most half of it.

    Parameters
    ----------
    device : str or cl.Device, optional
        As :func:`clra.ops.runtime.devices.choose_device` takes it.
    max_device_memory, max_host_memory : int, optional
        Bytes; by default 3/4 of the device's memory and half of what the host has available. The
        host's counts what comes on top of the imported modules and built kernels.
    report : callable, optional
        Called with a :class:`Progress` as work goes on.

    Attributes
    ----------
    memory : DeviceMemory
        Allocator for arrays and operators; it stops at the budget.
    budgets : Budgets
        How they are shared out.
    scratch_limit : int
        Bytes of scratch memory that an operator should not exceed, for those that take a limit.

    Raises
    ------
    DeviceError
        If there is no such device.
    InputError
        If a budget is not positive.
    """

    def __init__(
        self,
        device: str | cl.Device | None = None,
        *,
        max_device_memory: int | None = None,
        max_host_memory: int | None = None,
        report: Report | None = None,
    ) -> None:
        self.device = choose_device(device)
        self.context = cl.Context([self.device])
        self.queue = cl.CommandQueue(self.context)
        self._builds = build.builds(self.context)  # held: operators come and go
        budgets = Budgets.of(self.device, max_device_memory, max_host_memory)
        self.budgets = budgets
        self.scratch_limit = budgets.scratch
        self.memory = DeviceMemory(self.context, budgets.device)
        self.room = HostRoom(budgets.kept)
        self._report = report
        self._shared = budgets.shared
        # Copies to the device have a queue of their own, to run beside the kernels.
        self._copies = self.queue if self._shared else cl.CommandQueue(self.context)

    def report(self, stage: str, done: int, total: int) -> None:
        """Tell the caller how far a stage is."""
        if self._report is not None:
            self._report(Progress(stage, done, total))

    def upload(self, host: Floats) -> cl.array.Array:
        """Give the device a C-ordered float32 array; a CPU reads it in place.

        What is enqueued on :attr:`queue` afterwards finds it there. The array has to be kept, and
        left as it is, until the device has done with it.
        """
        if self._shared:
            flags = cl.mem_flags.READ_ONLY | cl.mem_flags.USE_HOST_PTR
            shared = cl.Buffer(self.context, flags, hostbuf=host)
            return cl.array.Array(self.queue, host.shape, host.dtype, data=shared)
        array = self.empty(host.shape)
        buffer: Any = array.base_data
        copied = cl.enqueue_copy(self._copies, buffer, host, is_blocking=False)
        cl.enqueue_barrier(self.queue, wait_for=[copied])
        return array

    def empty(self, shape: tuple[int, ...]) -> cl.array.Array:
        """Device array of float32 with undefined contents."""
        return cl.array.empty(self.queue, shape, np.float32, allocator=self.memory)

    def download(self, array: cl.array.Array) -> Floats:
        """Copy of a device array on the host, when all that was enqueued is done."""
        return np.asarray(array.get(queue=self.queue))

    def chunks(self, views: int, bytes_per_view: int) -> list[slice]:
        """Cut views into runs whose radiographs fit the device and the host comfortably."""
        size = max(1, self.budgets.chunk(bytes_per_view) // bytes_per_view)
        # Runs of equal length: no last one of two or three views.
        return _equal_runs(views, -(-views // size))

    def slabs(self, grid: VolumeGrid, volumes: int = 1) -> list[slice]:
        """Cut a volume into runs of z planes that each fit one buffer and a third of the budget.

        Parameters
        ----------
        grid : VolumeGrid
            Of the volume.
        volumes : int
            How many of its kind the device has to hold at a time.

        Raises
        ------
        DeviceMemoryError
            If one plane is larger than that.
        """
        nz, ny, nx = grid.shape
        limit = self.budgets.slab // volumes
        planes = limit // (4 * nx * ny)
        if planes < 1:
            raise DeviceMemoryError(
                f"one plane of {ny} x {nx} voxels takes {4 * nx * ny >> 10} KiB, the device allows "
                f"{limit >> 10} KiB: use a coarser grid or raise the memory limit"
            )
        return _equal_runs(nz, -(-nz // planes))


def _equal_runs(total: int, count: int) -> list[slice]:
    ends = [total * k // count for k in range(count + 1)]
    return [slice(a, b) for a, b in pairwise(ends)]


class PlaneWriter(Protocol):
    """Where a volume goes plane by plane, such as `SlabWriter`."""

    def write(self, start: int, part: Floats, /) -> None:
        """Take planes (n, y, x), the first of them plane `start` of the volume."""


class Volume:
    """A volume in the order (y, x, z), on the device if it fits, else in slabs on the host.

    Parameters
    ----------
    stream : Stream
        Where it lives.
    grid : VolumeGrid
        Of the whole volume.
    volumes : int
        How many of its kind the device has to hold at a time.
    """

    def __init__(self, stream: Stream, grid: VolumeGrid, *, volumes: int = 1) -> None:
        self.grid = grid
        self._stream = stream
        self._planes = stream.slabs(grid, volumes)
        self._known = [False] * len(self._planes)
        self._whole: cl.array.Array | None = None
        self._store: Store | None = None
        self._transpose = Transpose(stream.context)

    @property
    def planes(self) -> list[slice]:
        """Planes of the grid in each slab, bottom to top."""
        return list(self._planes)

    @property
    def slabs(self) -> list[VolumeGrid]:
        """Grid of each slab."""
        return [self.grid.slab(planes.start, planes.stop) for planes in self._planes]

    def put(self, index: int, part: cl.array.Array) -> None:
        """Keep slab `index`: where it is if the volume is one slab, else on the host."""
        self._known[index] = True
        if len(self._planes) == 1:
            self._whole = part
            return
        if self._store is None:
            self._store = Store((math.prod(self.grid.shape),), self._stream.room)
        start = self._start(index)
        buffer: Any = part.base_data
        for piece in self._pieces(part.size):
            host = np.empty(piece.stop - piece.start, np.float32)
            cl.enqueue_copy(
                self._stream.queue, host, buffer, src_offset=part.offset + 4 * piece.start
            )
            self._store.write(start + piece.start, host)

    def get(self, index: int) -> cl.array.Array:
        """Slab `index` (ny, nx, planes) on the device."""
        if not self._known[index]:
            raise RuntimeError(f"slab {index} was not computed")
        if self._whole is not None:
            return self._whole
        _, ny, nx = self.grid.shape
        planes = self._planes[index]
        shape = (ny, nx, planes.stop - planes.start)
        start, store = self._start(index), self._store
        assert store is not None
        if store.in_memory:
            return self._stream.upload(store.read(start, start + math.prod(shape)).reshape(shape))
        slab = self._stream.empty(shape)
        buffer: Any = slab.base_data
        for piece in self._pieces(slab.size):
            part = store.read(start + piece.start, start + piece.stop)
            cl.enqueue_copy(self._stream.queue, buffer, part, dst_offset=4 * piece.start)
        return slab

    def write(self, target: PlaneWriter) -> None:
        """Hand the whole volume on, (z, y, x), some planes at a time."""
        for index in range(len(self._planes)):
            self.write_slab(index, self.get(index), target)

    def write_slab(self, index: int, part: cl.array.Array, target: PlaneWriter) -> None:
        """Hand slab `index` on, some planes at a time, whether it is kept or not."""
        ny, nx, nz = part.shape
        stream = self._stream
        count = min(nz, max(1, stream.budgets.piece // (4 * ny * nx)))
        for start in range(0, nz, count):
            n = min(count, nz - start)
            planes = stream.empty((n, ny, nx))
            self._transpose(
                stream.queue,
                Planes(planes, nx, nx * ny, n, nx),
                Planes(part[:, :, start:], nx * nz, nz, nx, n),
                ny,
            )
            target.write(self._planes[index].start + start, stream.download(planes))

    def to_host(self) -> Floats:
        """Return the whole volume as a numpy array (z, y, x)."""
        target = HostPlanes(self.grid)
        self.write(target)
        return target.volume

    def _start(self, index: int) -> int:
        """First element of a slab in the store."""
        return int(self._planes[index].start) * self.grid.shape[1] * self.grid.shape[2]

    def _pieces(self, size: int) -> list[slice]:
        return _equal_runs(size, -(-size // max(1, self._stream.budgets.piece // 4)))


class HostPlanes:
    """Takes the planes of a volume into a numpy array."""

    def __init__(self, grid: VolumeGrid) -> None:
        self.grid = grid
        self.volume: Floats = np.zeros(grid.shape, np.float32)

    def write(self, start: int, part: Floats) -> None:
        """Take planes (n, y, x) from plane `start` on."""
        self.volume[start : start + len(part)] = part


class Radiographs:
    """The line integrals of a scan, binned, read in chunks.

    Binned radiographs are read from the scan once and then kept, on the host or, beyond its budget,
    in an unnamed temporary file. Full resolution is read where needed.

    Parameters
    ----------
    stream : Stream
        Device that bins.
    scan : Scan
        At full resolution.
    level : int
        Binning factor: 1, 2, 4 or 8.
    """

    def __init__(self, stream: Stream, scan: Scan, level: int) -> None:
        self.shape = (scan.views, *scan.geometry.binned(level).shape)
        self.level = level
        self._stream, self._scan = stream, scan
        self._kept: Store | None = None if level == 1 else self._read_all()

    @classmethod
    def of(cls, kept: Store, level: int) -> "Radiographs":
        """Radiographs (views, rows, columns) of a level that are known already."""
        known = cls.__new__(cls)
        views, rows, columns = kept.shape
        known.shape, known.level, known._kept = (views, rows, columns), level, kept
        return known

    @property
    def view_bytes(self) -> int:
        """Bytes of one radiograph at this level."""
        return 4 * self.shape[1] * self.shape[2]

    def read(self, views: slice) -> Floats:
        """Radiographs `views`, float32 (n, rows, columns)."""
        if self._kept is None:
            return self._scan.read(views.start, views.stop)
        return self._kept.read(views.start, views.stop)

    def __getitem__(self, views: slice) -> Floats:
        """Radiographs as the projections of a scan."""
        start, stop, _ = views.indices(self.shape[0])
        return self.read(slice(start, stop))

    def _read_all(self) -> Store:
        stream = self._stream
        kept = Store(self.shape, stream.room)
        restrict = Restrict2D(stream.context)
        chunks = stream.chunks(self.shape[0], 4 * self._scan.shape[1] * self._scan.shape[2])
        name = f"reading radiographs, binned {self.level} x {self.level}"
        for views in chunks:
            stream.report(name, views.start, self.shape[0])
            measured = self._scan.read(views.start, views.stop)
            images = stream.upload(measured)
            for _ in range(self.level.bit_length() - 1):
                n, rows, columns = images.shape
                halved = stream.empty((n, rows // 2, columns // 2))
                restrict(stream.queue, halved, images)
                images = halved
            kept.write(views.start, stream.download(images))
        stream.report(name, self.shape[0], self.shape[0])
        return kept
