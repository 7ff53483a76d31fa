"""Volumes between levels of resolution, and their correction by what their radiographs lack."""

from collections.abc import Sequence

import pyopencl as cl
from numpy.typing import ArrayLike
from pyopencl.array import Array

from clra.model.grid import VolumeGrid
from clra.ops.images.pyramid import Prolong3D, Restrict3D
from clra.ops.runtime.buffers import check_array, check_images, check_queue, to_device
from clra.ops.runtime.kernel import Step
from clra.ops.streaming.slab_projector import writable
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import Volume

_FILE = "multigrid.cl"


def prolongate(
    stream: Stream,
    coarse: Volume,
    grid: VolumeGrid,
    *,
    volumes: int = 1,
    planes: slice | None = None,
) -> Volume:
    """Interpolate a volume on a grid of voxels half as large.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    coarse : Volume
        On ``grid.binned(2)``.
    grid : VolumeGrid
        Of the result.
    volumes : int
        As for :class:`~clra.ops.streaming.volume.Volume`.
    planes : slice, optional
        Planes of the grid that are wanted, all by default; the volume is then on their grid.

    Returns
    -------
    Volume
        Trilinear between the centres of coarse voxels, constant beyond the last.
    """
    step, copy = Prolong3D(stream.context), _PlaneCopy(stream)
    last = coarse.grid.shape[0]
    fine, begin = _wanted(stream, grid, planes, volumes)
    for index, part in enumerate(fine.planes):
        start, stop = begin + part.start, begin + part.stop
        # A fine plane lies between its coarse one and a neighbour.
        low = max(0, min(start // 2, last - 1) - 1)
        high = min(last, (stop - 1) // 2 + 2)
        end = grid.shape[0] if high == last else 2 * high
        wide = stream.empty((*grid.shape[1:], end - 2 * low))
        step(stream.queue, wide, copy.gather(coarse, slice(low, high)))
        fine.put(index, copy.cut(wide, slice(start - 2 * low, stop - 2 * low)))
    return fine


def restrict(
    stream: Stream, fine: Volume, *, volumes: int = 1, planes: slice | None = None
) -> Volume:
    """Average a volume over blocks of 2 x 2 x 2 voxels.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    fine : Volume
        To average; at the upper ends, voxels that fill no block are dropped.
    volumes : int
        As for :class:`~clra.ops.streaming.volume.Volume`.
    planes : slice, optional
        Planes of the result that are wanted, all by default; it is then on their grid.

    Returns
    -------
    Volume
        On ``fine.grid.binned(2)``.
    """
    step, copy = Restrict3D(stream.context), _PlaneCopy(stream)
    coarse, begin = _wanted(stream, fine.grid.binned(2), planes, volumes)
    for index, part in enumerate(coarse.planes):
        start, stop = begin + part.start, begin + part.stop
        block = stream.empty((*coarse.grid.shape[1:], stop - start))
        step(stream.queue, block, copy.gather(fine, slice(2 * start, 2 * stop)))
        coarse.put(index, block)
    return coarse


def _wanted(
    stream: Stream, grid: VolumeGrid, planes: slice | None, volumes: int
) -> tuple[Volume, int]:
    """Return a volume for some planes of a grid, or all, and the first of them."""
    if planes is None:
        return Volume(stream, grid, volumes=volumes), 0
    return Volume(stream, grid.slab(planes.start, planes.stop), volumes=volumes), planes.start


def cropped(
    stream: Stream, volume: Volume, first: int, grid: VolumeGrid, *, volumes: int = 1
) -> Volume:
    """Return some planes of a volume.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    volume : Volume
        To take them of.
    first : int
        Plane with which to begin.
    grid : VolumeGrid
        Of the planes.
    volumes : int
        As for :class:`~clra.ops.streaming.volume.Volume`.
    """
    copy = _PlaneCopy(stream)
    part = Volume(stream, grid, volumes=volumes)
    for index, planes in enumerate(part.planes):
        part.put(index, copy.gather(volume, slice(first + planes.start, first + planes.stop)))
    return part


class _PlaneCopy:
    """Planes of a volume, whichever slabs they lie in."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._copy = Step(stream.context, _FILE, "copy_planes", (64, 1))

    def gather(self, volume: Volume, planes: slice) -> Array:
        """Collect planes of all slabs, (ny, nx, n)."""
        slabs = [(i, s) for i, s in enumerate(volume.planes) if _overlap(s, planes)]
        if len(slabs) == 1:
            index, slab = slabs[0]
            inside = slice(planes.start - slab.start, planes.stop - slab.start)
            return self.cut(volume.get(index), inside)
        gathered = self._stream.empty((*volume.grid.shape[1:], planes.stop - planes.start))
        for index, slab in slabs:
            start, stop = max(slab.start, planes.start), min(slab.stop, planes.stop)
            part = volume.get(index)
            self._run(gathered, start - planes.start, part, start - slab.start, stop - start)
            # The part may be let go before the queue comes to it, and with it what it is made of.
            self._stream.queue.finish()
        return gathered

    def cut(self, part: Array, planes: slice) -> Array:
        """Take some planes of an array (ny, nx, n); all of them without a copy."""
        count = planes.stop - planes.start
        if count == part.shape[2]:
            return part
        cut = self._stream.empty((*part.shape[:2], count))
        self._run(cut, 0, part, planes.start, count)
        self._stream.queue.finish()
        return cut

    def _run(self, target: Array, first: int, source: Array, start: int, count: int) -> None:
        columns = target.shape[0] * target.shape[1]
        self._copy(
            self._stream.queue,
            (count, columns),
            *(target, source, target.shape[2], first, source.shape[2], start, count, columns),
        )


def _overlap(one: slice, other: slice) -> bool:
    return bool(one.start < other.stop and other.start < one.stop)


def add_update(stream: Stream, volume: Volume, update: Volume, step: float = 1.0) -> None:
    """Do ``volume <- max(0, volume + step update)``.

    Parameters
    ----------
    stream : Stream
        Device.
    volume : Volume
        Attenuation [1/mm]; changed.
    update : Volume
        On the same grid and in the same slabs.
    step : float
        Factor of the update.
    """
    for index in range(len(volume.planes)):
        add_to_slab(stream, volume, index, update.get(index), step)
        stream.queue.finish()


def add_to_slab(
    stream: Stream, volume: Volume, index: int, change: Array, step: float = 1.0
) -> None:
    """Do what :func:`add_update` does with one slab, (ny, nx, planes) on the device."""
    part = writable(stream, volume, index)
    sizes = (part.shape[2], part.shape[0] * part.shape[1])
    correct = Step(stream.context, _FILE, "correct", (64, 1))
    correct(stream.queue, sizes, part, change, float(step), *sizes)
    volume.put(index, part)


class Residual:
    """What measured radiographs hold beyond simulated ones.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    used : array_like of bool, (rows, columns)
        Pixels that count; the residual is 0 elsewhere.
    """

    def __init__(self, context: cl.Context, used: ArrayLike) -> None:
        self._context = context
        self._used = to_device(context, used)
        self._step = Step(context, _FILE, "residual", (64, 1, 1))

    def __call__(
        self,
        queue: cl.CommandQueue,
        residual_out: Array,
        measured: Array,
        simulated: Array,
        motion: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Subtract.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        residual_out : cl.array.Array
            float32 (n, rows, columns), overwritten; may be `simulated`.
        measured, simulated : cl.array.Array
            float32 (n, rows, columns), line integrals.
        motion : cl.array.Array
            float32 (n, 3), as `Warp` takes it: that by which `simulated` was
            moved. What had to be read beyond its border is left out.
        wait_for : sequence of cl.Event, optional
            What has to be done before.

        Returns
        -------
        cl.Event

        Raises
        ------
        TypeError, InputError
            If an array is none of the above.
        """
        check_queue(queue, self._context)
        n = check_images("measured", measured, self._used.shape, self._context)
        for name, array in (("residual_out", residual_out), ("simulated", simulated)):
            check_array(name, array, (n, *self._used.shape), context=self._context)
        check_array("motion", motion, (n, 3), context=self._context)
        rows, columns = self._used.shape
        return self._step(
            queue,
            (columns, rows, n),
            *(residual_out, measured, simulated, self._used, motion, rows, columns, n),
            wait_for=wait_for,
        )
