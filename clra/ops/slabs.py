"""Projection of volumes that may lie in slabs."""

import pyopencl as cl
from pyopencl.array import Array

from clra.model.geometry import ConeBeamGeometry
from clra.model.visibility import views_that_see
from clra.ops.memory import Reused
from clra.ops.projector import ForwardProjector
from clra.ops.streaming import Stream, Volume


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
        scratch = Reused(stream.memory)
        slabs = volume.slabs
        self._seeing = [views_that_see(geometry, slab) for slab in slabs]
        self._projectors = [
            ForwardProjector(
                stream.context,
                geometry,
                slab,
                volume_order="yxz",
                allocator=scratch,
                scratch_limit=stream.scratch_limit,
            )
            for slab in slabs
        ]

    def __call__(self, projections_out: Array, views: slice) -> cl.Event:
        """Project some views, on the stream's queue.

        Parameters
        ----------
        projections_out : cl.array.Array
            float32 (n, rows, columns), overwritten.
        views : slice
            The n successive views of the geometry. Slabs that none of them sees are not fetched.
        """
        seen = [
            index for index, views_seeing in enumerate(self._seeing) if views_seeing[views].any()
        ]
        if not seen:
            projections_out.fill(0.0, queue=self._queue)
            return cl.enqueue_marker(self._queue)
        for index in seen:
            event = self._projectors[index](
                self._queue,
                projections_out,
                self._volume.get(index),
                views=views,
                accumulate=index != seen[0],
            )
            if len(seen) > 1:
                event.wait()  # the slab is let go
        return event
