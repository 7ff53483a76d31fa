"""Radiographs, tables and volumes in files that several processes share, each file written by one.

A file appears whole or not at all. It is written under a name of its own and renamed, so that work
that is done twice, because one worker seemed lost, writes the same file twice and does no harm.
"""

import math
import os
import uuid
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clra.model.grid import VolumeGrid
from clra.ops.projection.transpose import Transpose
from clra.ops.streaming.stream import Stream, equal_runs
from clra.ops.streaming.volume import PlaneWriter, Volume

Floats = NDArray[np.float32]

# Bytes that are on the host at a time when planes or radiographs are handed on.
_PIECE_BYTES = 32 << 20


@contextmanager
def whole_file(path: Path) -> Iterator[IO[bytes]]:
    """Yield a file to write that takes the place of `path` at the end of the block."""
    part = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with open(part, "xb") as file:
            yield file
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


@dataclass(frozen=True)
class RadiographParts:
    """Radiographs (views, rows, columns), some consecutive ones in each file.

    Parameters
    ----------
    folder : Path
        Of the files.
    shape : (int, int, int)
        Of all radiographs together.
    parts : tuple of slice
        Views in each file, in their order.
    """

    folder: Path
    shape: tuple[int, int, int]
    parts: tuple[slice, ...]

    def write(self, views: slice, images: Floats) -> None:
        """Write one of the parts."""
        with self.writing(views) as write:
            write(images)

    @contextmanager
    def writing(self, views: slice) -> Iterator[Callable[[Floats], None]]:
        """Yield what takes the images of one of the parts, some at a time."""
        with whole_file(self._path(views)) as file:
            yield lambda images: _write_to(file, images)

    def read(self, start: int, stop: int, rows: slice | None = None) -> Floats:
        """Return the views `start` to `stop - 1`, or rows of them, of one file or several."""
        _, height, columns = self.shape
        wanted = rows or slice(0, height)
        out = np.empty((stop - start, wanted.stop - wanted.start, columns), np.float32)
        for part in self.parts:
            first, last = max(start, part.start), min(stop, part.stop)
            if first >= last:
                continue
            with open(self._path(part), "rb", buffering=0) as file:
                pieces = [slice(first, last)]
                if rows is not None:
                    pieces = [slice(view, view + 1) for view in range(first, last)]
                for views in pieces:
                    row = (views.start - part.start) * height + wanted.start
                    file.seek(4 * row * columns)
                    _read_into(file, out[views.start - start : views.stop - start])
        return out

    def hand_on(self, views: slice, take: Callable[[int, Floats], None]) -> None:
        """Give one of the parts to what takes all radiographs, some at a time; remove the file."""
        step = max(1, _PIECE_BYTES // (4 * self.shape[1] * self.shape[2]))
        for start, stop in pairwise([*range(views.start, views.stop, step), views.stop]):
            take(start, self.read(start, stop))
        self._path(views).unlink()

    def some(self, views: slice) -> "SomeParts":
        """Return consecutive views as radiographs of their own."""
        return SomeParts(self, views)

    def _path(self, views: slice) -> Path:
        return self.folder / f"views-{views.start:06}"


@dataclass(frozen=True)
class SomeParts:
    """Consecutive views of `RadiographParts`."""

    whole: RadiographParts
    views: slice

    @property
    def shape(self) -> tuple[int, int, int]:
        """Views, rows, columns."""
        return (self.views.stop - self.views.start, *self.whole.shape[1:])

    def read(self, start: int, stop: int, rows: slice | None = None) -> Floats:
        """Return the views `start` to `stop - 1` of these, or rows of them."""
        return self.whole.read(self.views.start + start, self.views.start + stop, rows)


@dataclass(frozen=True)
class TableParts:
    """Numbers of each view, (views, ...), those of some consecutive views in each file.

    Parameters
    ----------
    folder : Path
        Of the files.
    """

    folder: Path

    def write(self, views: slice, rows: NDArray[np.float64]) -> None:
        """Write what is known of some views."""
        with whole_file(self._path(views)) as file:
            np.save(file, rows)

    def read(self, parts: Iterable[slice]) -> NDArray[np.float64]:
        """Return what is known of all views, given those of each file in order."""
        return np.concatenate([np.load(self._path(views)) for views in parts])

    def _path(self, views: slice) -> Path:
        return self.folder / f"rows-{views.start:06}"


@dataclass(frozen=True)
class VolumeParts:
    """A volume, a z-slab in each file, in the order (y, x, z) of devices.

    Parameters
    ----------
    folder : Path
        Of the files.
    grid : VolumeGrid
        Of the whole volume.
    planes : tuple of slice
        Planes of each slab, bottom to top.
    """

    folder: Path
    grid: VolumeGrid
    planes: tuple[slice, ...]

    def shape(self, index: int) -> tuple[int, int, int]:
        """Return the shape of a slab, (ny, nx, planes)."""
        _, ny, nx = self.grid.shape
        return ny, nx, self.planes[index].stop - self.planes[index].start

    def write(self, stream: Stream, index: int, slab: cl.array.Array) -> None:
        """Write a slab (ny, nx, planes) of a device."""
        with whole_file(self._path(index)) as file:
            source: Any = slab.base_data
            step = max(1, stream.budgets.piece // 4)
            for start in range(0, slab.size, step):
                host = np.empty(min(step, slab.size - start), np.float32)
                offset = slab.offset + 4 * start
                cl.enqueue_copy(stream.queue, host, source, src_offset=offset)
                file.write(_bytes(host))

    def write_planes(self, index: int, values: Floats) -> None:
        """Write a slab of an array (z, y, x), which may be mapped; what is negative becomes 0."""
        (ny, nx, nz), planes = self.shape(index), self.planes[index]
        with whole_file(self._path(index)) as file:
            for rows in equal_runs(ny, -(-4 * ny * nx * nz // _PIECE_BYTES)):
                block = np.maximum(np.asarray(values[planes, rows], np.float32), 0)
                _write_to(file, np.moveaxis(block, 0, 2))

    def read(self, stream: Stream, index: int) -> cl.array.Array:
        """Return a slab on a device, where it may be changed."""
        slab = stream.empty(self.shape(index))
        target: Any = slab.base_data
        step = max(1, stream.budgets.piece // 4)
        with open(self._path(index), "rb", buffering=0) as file:
            for start in range(0, slab.size, step):
                host = np.empty(min(step, slab.size - start), np.float32)
                _read_into(file, host)
                cl.enqueue_copy(stream.queue, target, host, dst_offset=slab.offset + 4 * start)
        return slab

    def volume(self, stream: Stream) -> Volume:
        """Return the whole volume, whose slabs are read when they are asked for."""
        return _FiledVolume(stream, self)

    def _path(self, index: int) -> Path:
        return self.folder / f"slab-{index:04}"


class _FiledVolume(Volume):
    """A volume in files; as many of its slabs stay on the device as one slab may take of it."""

    far = True

    def __init__(self, stream: Stream, parts: VolumeParts) -> None:
        self.grid = parts.grid
        self._stream, self._parts = stream, parts
        self._planes = list(parts.planes)
        self._transpose = Transpose(stream.context)
        self._slabs: OrderedDict[int, cl.array.Array] = OrderedDict()

    def get(self, index: int) -> cl.array.Array:
        """Slab `index` (ny, nx, planes) on the device."""
        if index in self._slabs:
            self._slabs.move_to_end(index)
            return self._slabs[index]
        size = 4 * math.prod(self._parts.shape(index))
        kept = sum(slab.nbytes for slab in self._slabs.values())
        while self._slabs and kept + size > self._stream.budgets.slab:
            kept -= self._slabs.popitem(last=False)[1].nbytes
        self._slabs[index] = self._parts.read(self._stream, index)
        return self._slabs[index]


@dataclass(frozen=True)
class PlaneParts:
    """The planes (z, y, x) of a volume on their way to where it is put together.

    Parameters
    ----------
    folder : Path
        Of the files.
    shape : (int, int, int)
        Of the whole volume.
    """

    folder: Path
    shape: tuple[int, int, int]

    @contextmanager
    def writing(self, planes: slice) -> Iterator[PlaneWriter]:
        """Yield what takes some planes of the volume, counted from the first of these."""
        with whole_file(self._path(planes)) as file:
            stride = 4 * self.shape[1] * self.shape[2]
            file.truncate((planes.stop - planes.start) * stride)
            yield _PlanesOfFile(file, stride)

    def hand_on(self, planes: slice, target: PlaneWriter) -> None:
        """Give planes that :meth:`writing` took to what takes the whole volume; remove the file."""
        step = max(1, _PIECE_BYTES // (4 * self.shape[1] * self.shape[2]))
        path = self._path(planes)
        with open(path, "rb", buffering=0) as file:
            ends = [*range(planes.start, planes.stop, step), planes.stop]
            for start, stop in pairwise(ends):
                piece = np.empty((stop - start, *self.shape[1:]), np.float32)
                _read_into(file, piece)
                target.write(start, piece)
        path.unlink()

    def _path(self, planes: slice) -> Path:
        return self.folder / f"planes-{planes.start:06}"


class _PlanesOfFile:
    """Takes planes into a file."""

    def __init__(self, file: IO[bytes], stride: int) -> None:
        self._file, self._stride = file, stride

    def write(self, start: int, part: Floats, /) -> None:
        self._file.seek(start * self._stride)
        _write_to(self._file, part)


def _write_to(file: IO[bytes], array: Floats) -> None:
    file.write(_bytes(np.ascontiguousarray(array, np.float32)))


def _read_into(file: Any, array: Floats) -> None:
    """Fill an array from a file that is long enough."""
    view = _bytes(array)
    while view:
        count = file.readinto(view)
        if not count:
            raise OSError(f"{file.name}: ended early")
        view = view[count:]


def _bytes(array: Floats) -> memoryview:
    return array.reshape(-1).view(np.uint8).data
