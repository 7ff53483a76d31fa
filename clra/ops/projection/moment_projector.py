"""Line integrals of a volume and of the volume over its depth, in one pass."""

from collections.abc import Sequence
from types import MappingProxyType

import pyopencl as cl
from pyopencl.array import Array

from clra.ops.projection.projector import ForwardProjector


class MomentProjector(ForwardProjector):
    r"""Integrals :math:`\int f\,dl` and :math:`\int f / g\,dl` along each ray, by Joseph's method.

    g is the depth of a point as a fraction of the detector's, 0 at the source. From the image
    gradients of the two follows what any small rigid motion of the sample does to a radiograph, see
    :class:`clra.ops.registration.rigid.RigidRegistration`. The first integral is that of
    :class:`ForwardProjector` to the last bit.

    Parameters
    ----------
    context, geometry, grid, volume_order, allocator, scratch_limit
        As for :class:`ForwardProjector`.
    """

    _DEFINES = MappingProxyType({"MOMENT": 1})

    def moments(
        self,
        queue: cl.CommandQueue,
        projections_out: Array,
        over_depth_out: Array,
        volume: Array,
        *,
        views: slice | None = None,
        accumulate: bool = False,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Project.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        projections_out, over_depth_out : cl.array.Array
            float32 (n, rows, columns), overwritten: integrals of the volume, and of the volume over
            the depth; the volume's unit times mm.
        volume, views, accumulate, wait_for
            As for :class:`ForwardProjector`.

        Returns
        -------
        cl.Event

        Raises
        ------
        TypeError, InputError
            If an argument is none of the above.
        """
        names = ("volume", "over_depth_out")
        self._layout.check(queue, names, volume, over_depth_out, views)
        return self.integrals(
            queue,
            (projections_out, over_depth_out),
            volume,
            views=views,
            accumulate=accumulate,
            wait_for=wait_for,
        )
