"""Volumes that may lie in slabs on the host, and where their planes go."""

import math
from typing import Any, Protocol

import numpy as np
import pyopencl as cl
import pyopencl.array
from numpy.typing import NDArray

from clra.model.grid import VolumeGrid
from clra.ops.projection.transpose import Planes, Transpose
from clra.ops.streaming.memory import Store
from clra.ops.streaming.stream import Stream, equal_runs

Floats = NDArray[np.float32]


class PlaneWriter(Protocol):
    """Where a volume goes plane by plane, such as `SlabWriter`."""

    def write(self, start: int, part: Floats, /) -> None:
        """Take planes (n, y, x), the first of them plane `start` of the volume."""


class PlaneSource(Protocol):
    """A volume that can be handed on plane by plane, wherever it is.

    Attributes
    ----------
    grid : VolumeGrid
        Of the whole volume.
    """

    grid: VolumeGrid

    def write(self, target: PlaneWriter, planes: slice | None = None) -> None:
        """Hand planes on, counted from the first of them, some at a time; all by default."""
        ...

    def to_host(self) -> Floats:
        """Return the whole volume as a numpy array (z, y, x)."""
        target = HostPlanes(self.grid)
        self.write(target)
        return target.volume


class Volume(PlaneSource):
    """A volume in the order (y, x, z), on the device if it fits, else in slabs on the host.

    Parameters
    ----------
    stream : Stream
        Where it lives.
    grid : VolumeGrid
        Of the whole volume.
    volumes : int
        How many of its kind the device has to hold at a time.

    Attributes
    ----------
    far : bool
        Whether slabs that are not on the device come from files that others share.
    """

    far = False

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

    def write(self, target: PlaneWriter, planes: slice | None = None) -> None:
        """Hand planes on, see :class:`PlaneSource`."""
        wanted = planes or slice(0, self.grid.shape[0])
        for index, slab in enumerate(self._planes):
            first, last = max(wanted.start, slab.start), min(wanted.stop, slab.stop)
            if first < last:
                inside = slice(first - slab.start, last - slab.start)
                self._hand_on(self.get(index), inside, first - wanted.start, target)

    def write_slab(self, index: int, part: cl.array.Array, target: PlaneWriter) -> None:
        """Hand slab `index` on, some planes at a time, whether it is kept or not."""
        self._hand_on(part, slice(0, part.shape[2]), self._planes[index].start, target)

    def _hand_on(
        self, part: cl.array.Array, planes: slice, first: int, target: PlaneWriter
    ) -> None:
        """Hand planes of a slab (ny, nx, nz) on, as plane `first` and those that follow."""
        ny, nx, nz = part.shape
        stream = self._stream
        count = max(1, stream.budgets.piece // (4 * ny * nx))
        for start in range(planes.start, planes.stop, count):
            n = min(count, planes.stop - start)
            piece = stream.empty((n, ny, nx))
            self._transpose(
                stream.queue,
                Planes(piece, nx, nx * ny, n, nx),
                Planes(part[:, :, start:], nx * nz, nz, nx, n),
                ny,
            )
            target.write(first + start - planes.start, stream.download(piece))

    def _start(self, index: int) -> int:
        """First element of a slab in the store."""
        return int(self._planes[index].start) * self.grid.shape[1] * self.grid.shape[2]

    def _pieces(self, size: int) -> list[slice]:
        return equal_runs(size, -(-size // max(1, self._stream.budgets.piece // 4)))


class CroppedVolume(PlaneSource):
    """Planes of a volume, that are taken out of it when they are handed on.

    Parameters
    ----------
    source : PlaneSource
        The volume.
    first : int
        Plane with which to begin.
    grid : VolumeGrid
        Of the planes.
    """

    def __init__(self, source: PlaneSource, first: int, grid: VolumeGrid) -> None:
        self.grid = grid
        self._source, self._first = source, first

    def write(self, target: PlaneWriter, planes: slice | None = None) -> None:
        """Hand planes on, see :class:`PlaneSource`."""
        wanted = planes or slice(0, self.grid.shape[0])
        first = self._first
        self._source.write(target, slice(first + wanted.start, first + wanted.stop))


class HostPlanes:
    """Takes the planes of a volume into a numpy array."""

    def __init__(self, grid: VolumeGrid) -> None:
        self.grid = grid
        self.volume: Floats = np.zeros(grid.shape, np.float32)

    def write(self, start: int, part: Floats) -> None:
        """Take planes (n, y, x) from plane `start` on."""
        self.volume[start : start + len(part)] = part
