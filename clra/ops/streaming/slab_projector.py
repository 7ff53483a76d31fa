"""Volumes that may lie in slabs: how they are filled, changed, projected and back-projected."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.view_selection import runs, views_that_see
from clra.ops.projection.moment_projector import MomentProjector
from clra.ops.projection.projector import BackProjector, ForwardProjector
from clra.ops.streaming.memory import Reused, Store
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import Volume


def constant_volume(
    stream: Stream, grid: VolumeGrid, value: float = 0.0, *, volumes: int = 1
) -> Volume:
    """Return a volume of one value.

    Parameters
    ----------
    stream : Stream
        Where it lives.
    grid : VolumeGrid
        Of the volume.
    value : float
        Of every voxel.
    volumes : int
        As for :class:`~clra.ops.streaming.volume.Volume`.
    """
    volume = Volume(stream, grid, volumes=volumes)
    for index, slab in enumerate(volume.slabs):
        nz, ny, nx = slab.shape
        part = stream.empty((ny, nx, nz))
        part.fill(np.float32(value), queue=stream.queue)
        volume.put(index, part)
    return volume


class ConstantVolume(Volume):
    """A volume of one value, whose slabs are made when they are asked for; not to be changed.

    Parameters
    ----------
    stream, grid, value, volumes
        As for :func:`constant_volume`.
    """

    def __init__(self, stream: Stream, grid: VolumeGrid, value: float, *, volumes: int = 1) -> None:
        super().__init__(stream, grid, volumes=volumes)
        self._value = np.float32(value)
        self._last: tuple[int, Array] | None = None

    def get(self, index: int) -> Array:
        """Slab `index` (ny, nx, planes) on the device."""
        if self._last is None or self._last[0] != index:
            self._last = None  # before the next one is made
            nz, ny, nx = self.slabs[index].shape
            part = self._stream.empty((ny, nx, nz))
            part.fill(self._value, queue=self._stream.queue)
            self._last = index, part
        return self._last[1]


def volume_from(stream: Stream, grid: VolumeGrid, values: Any, *, volumes: int = 1) -> Volume:
    """Return the volume that an array (z, y, x) holds.

    Parameters
    ----------
    stream : Stream
        Where it lives.
    grid : VolumeGrid
        Of the volume.
    values : array-like object, (nz, ny, nx)
        Sliced along z.
    volumes : int
        As for :class:`~clra.ops.streaming.volume.Volume`.

    Raises
    ------
    InputError
        If the shapes differ.
    """
    if tuple(values.shape) != grid.shape:
        raise InputError(f"volume: found shape {tuple(values.shape)}, expected {grid.shape}")
    volume = Volume(stream, grid, volumes=volumes)
    for index, planes in enumerate(volume.planes):
        host = np.moveaxis(np.asarray(values[planes], np.float32), 0, 2)
        part = stream.empty(host.shape)
        part.set(np.ascontiguousarray(host), queue=stream.queue)
        volume.put(index, part)
    return volume


def writable(stream: Stream, volume: Volume, index: int) -> Array:
    """Return slab `index` to be changed and put back: the volume's own, or a copy of a kept one."""
    part = volume.get(index)
    if len(volume.planes) == 1:
        return part
    own = stream.empty(part.shape)
    source: Any = part.base_data
    target: Any = own.base_data
    cl.enqueue_copy(stream.queue, target, source, byte_count=part.nbytes).wait()
    return own


class SlabProjector:
    """Forward projection of a volume, slab by slab.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    volume : Volume
        To be projected; its slabs are fetched at each call.
    geometry : ConeBeamGeometry
        Of the projections.
    """

    def __init__(self, stream: Stream, volume: Volume, geometry: ConeBeamGeometry) -> None:
        self._queue = stream.queue
        self._volume = volume
        self._shape = geometry.shape
        scratch = Reused(stream.memory)
        slabs = volume.slabs
        self._seeing = [views_that_see(geometry, slab) for slab in slabs]
        self._projectors: list[Any] = [
            self._PROJECTOR(
                stream.context,
                geometry,
                slab,
                volume_order="yxz",
                allocator=scratch,
                scratch_limit=stream.scratch_limit,
            )
            for slab in slabs
        ]

    _PROJECTOR: type[ForwardProjector | MomentProjector] = ForwardProjector

    def __call__(self, projections_out: Array, views: slice) -> cl.Event:
        """Project some views, on the stream's queue.

        Parameters
        ----------
        projections_out : cl.array.Array
            float32 (n, rows, columns), overwritten.
        views : slice
            The n successive views of the geometry. Slabs that none of them sees are not fetched.
        """
        return self._over_slabs((projections_out,), views)

    def in_chunks(self, stream: Stream, chunks: Sequence[slice]) -> Iterator[tuple[slice, Array]]:
        """Yield projections of all views of the geometry, a chunk of successive views at a time.

        Parameters
        ----------
        stream : Stream
            As before.
        chunks : sequence of slice
            Of the views, in order.

        Yields
        ------
        views : slice
            A chunk.
        projections : cl.array.Array
            float32 (n, rows, columns), which may be changed.
        """
        kept: Store | None = None
        if self._volume.far and len(self._projectors) > 1 and len(chunks) > 1:
            kept = Store((chunks[-1].stop, *self._shape), stream.room)
            self.project_all(stream, kept)
        for views in chunks:
            part = stream.empty((views.stop - views.start, *self._shape))
            if kept is None:
                self(part, views)
            else:
                part.set(kept.read(views.start, views.stop), queue=self._queue)
            yield views, part
            del part  # before the next is made

    def project_all(self, stream: Stream, projections_out: Store) -> None:
        """Project all views of the geometry, slab by slab: of a volume in files each is read once.

        Parameters
        ----------
        stream : Stream
            As before.
        projections_out : Store
            (views, rows, columns), overwritten.
        """
        shape = projections_out.shape[1:]
        begun = np.zeros(projections_out.shape[0], np.bool_)
        for index, seeing in enumerate(self._seeing):
            slab = self._volume.get(index) if seeing.any() else None
            for run in runs(seeing):
                for chunk in stream.chunks(run.stop - run.start, 4 * math.prod(shape)):
                    views = slice(run.start + chunk.start, run.start + chunk.stop)
                    host = np.array(projections_out.read(views.start, views.stop))
                    host[~begun[views]] = 0
                    part = stream.empty(host.shape)
                    part.set(host, queue=self._queue)
                    project = self._projectors[index]
                    project(self._queue, part, slab, views=views, accumulate=True)
                    projections_out.write(views.start, stream.download(part))
                    begun[views] = True
        for view in np.flatnonzero(~begun).tolist():
            projections_out.write(view, np.zeros((1, *shape), np.float32))

    def _project(
        self, index: int, outputs: tuple[Array, ...], views: slice, accumulate: bool
    ) -> cl.Event:
        """Project a slab."""
        volume, projector = self._volume.get(index), self._projectors[index]
        event: cl.Event = projector(
            self._queue, *outputs, volume, views=views, accumulate=accumulate
        )
        return event

    def _over_slabs(self, outputs: tuple[Array, ...], views: slice) -> cl.Event:
        """Add up what the slabs give."""
        seen = [
            index for index, views_seeing in enumerate(self._seeing) if views_seeing[views].any()
        ]
        if not seen:
            for out in outputs:
                out.fill(0.0, queue=self._queue)
            return cl.enqueue_marker(self._queue)
        for index in seen:
            event = self._project(index, outputs, views, index != seen[0])
            if len(seen) > 1:
                event.wait()  # the slab is let go
        return event


class SlabMoments(SlabProjector):
    """Integrals of a volume and of the volume over the depth, slab by slab.

    As :class:`SlabProjector`, with :class:`~clra.ops.projection.moment_projector.MomentProjector`.
    """

    _PROJECTOR = MomentProjector

    def moments(self, projections_out: Array, over_depth_out: Array, views: slice) -> cl.Event:
        """Project some views; arrays as for `MomentProjector`."""
        return self._over_slabs((projections_out, over_depth_out), views)


class SlabAdjoint:
    """Exact adjoint of :class:`SlabProjector`, added to a volume slab by slab.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    volume : Volume
        Whose grid and slabs are meant.
    geometry : ConeBeamGeometry
        Of the projections.
    """

    def __init__(self, stream: Stream, volume: Volume, geometry: ConeBeamGeometry) -> None:
        self._stream = stream
        scratch = Reused(stream.memory)
        slabs = volume.slabs
        self._seeing = [views_that_see(geometry, slab) for slab in slabs]
        self._projectors = [
            BackProjector(
                stream.context,
                geometry,
                slab,
                matched=True,
                volume_order="yxz",
                allocator=scratch,
                scratch_limit=stream.scratch_limit,
            )
            for slab in slabs
        ]

    def __call__(self, volume: Volume, projections: Array, views: slice) -> None:
        """Add the adjoint of some views, on the stream's queue.

        Parameters
        ----------
        volume : Volume
            In the slabs given before; its unit is that of the projections times mm.
        projections : cl.array.Array
            float32 (n, rows, columns).
        views : slice
            The n successive views of the geometry. Slabs that none of them sees are not fetched.
        """
        for index, back in enumerate(self._projectors):
            seen = list(runs(self._seeing[index][views]))
            if not seen:
                continue
            part = writable(self._stream, volume, index)
            for run in seen:
                back(
                    self._stream.queue,
                    part,
                    projections[run],
                    views=slice(views.start + run.start, views.start + run.stop),
                    accumulate=True,
                )
            volume.put(index, part)
