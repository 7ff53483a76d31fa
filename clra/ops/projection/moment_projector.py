"""Line integrals of a volume and of the volume over its depth, in one pass."""

from collections.abc import Sequence

import pyopencl as cl
from pyopencl.array import Array

from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.ops.projection.cpu_forms import CpuForward
from clra.ops.projection.gpu_forms import runs
from clra.ops.projection.layout import Layout
from clra.ops.runtime.buffers import Allocator
from clra.ops.runtime.kernel import Step


class MomentProjector:
    r"""Integrals :math:`\int f\,dl` and :math:`\int f / g\,dl` along each ray, by Joseph's method.

    g is the depth of a point as a fraction of the detector's, 0 at the source. From the image
    gradients of the two follows what any small rigid motion of the sample does to a radiograph, see
    :class:`clra.ops.registration.rigid_registration.RigidRegistration`. The first integral is that
    of :class:`~clra.ops.projection.projector.ForwardProjector`.

    Parameters
    ----------
    context, geometry, grid, volume_order, allocator, scratch_limit
        As for :class:`~clra.ops.projection.projector.ForwardProjector`.

    Attributes
    ----------
    scratch_bytes : int
        Most bytes of scratch memory that it takes.

    Raises
    ------
    InputError
        If the grid reaches behind a source, or for another `volume_order`.
    """

    def __init__(
        self,
        context: cl.Context,
        geometry: ConeBeamGeometry,
        grid: VolumeGrid,
        *,
        volume_order: str = "zyx",
        allocator: Allocator | None = None,
        scratch_limit: int | None = None,
    ) -> None:
        self._layout = Layout(
            context, geometry, grid, volume_order, allocator, scratch_limit, images=2
        )
        self.scratch_bytes = self._layout.scratch_bytes
        on_cpu = self._layout.profile.on_cpu
        self._project = CpuForward(self._layout, {"MOMENT": 1}) if on_cpu else _Rays(self._layout)

    def set_geometry(self, geometry: ConeBeamGeometry) -> None:
        """Take other vectors for the same views and detector, for example another motion."""
        self._layout.set_geometry(geometry)

    def __call__(
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
            As for :class:`~clra.ops.projection.projector.ForwardProjector`.

        Returns
        -------
        cl.Event

        Raises
        ------
        TypeError, InputError
            If an argument is none of the above.
        """
        layout, outputs = self._layout, (projections_out, over_depth_out)
        for name, out in zip(("projections_out", "over_depth_out"), outputs, strict=True):
            start, stop = layout.check(queue, ("volume", name), volume, out, views)
        events: Sequence[cl.Event] = [*(wait_for or ()), *layout.last]
        columns, events = layout.gather_volume(queue, volume, events)
        part = slice(start, stop)
        return self._project.integrals(queue, outputs, columns, part, accumulate, events)


class _Rays:
    """The form for GPUs: a work-item traces one ray."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._step = Step(layout.context, "moments.cl", "moment_rays", (32, 8, 1), {})

    def integrals(
        self,
        queue: cl.CommandQueue,
        outputs: Sequence[Array],
        volume: Array,
        views: slice,
        accumulate: bool,
        wait_for: Sequence[cl.Event],
    ) -> cl.Event:
        """Project; what is launched waits for what was before it."""
        layout = self._layout
        columns, rows, _ = layout.detector
        for part in runs(layout, views):
            here = slice(part.start - views.start, part.stop - views.start)
            event = self._step(
                queue,
                (rows, columns, part.stop - part.start),
                *(out[here] for out in outputs),
                volume,
                layout.table[part],
                *layout.sizes,
                columns,
                rows,
                part.stop - part.start,
                layout.grid.voxel_size,
                int(accumulate),
                wait_for=wait_for,
            )
            wait_for = layout.last = [event]
        return event
