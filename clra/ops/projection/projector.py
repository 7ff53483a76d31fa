"""Forward projection, its adjoint, and back-projection of the FDK type.

Projections are (view, row, column) and volumes (z, y, x), or (y, x, z) for ``volume_order="yxz"``,
the order that the kernels work in.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import pyopencl as cl
from pyopencl.array import Array

from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.ops.projection.kernel_forms import Blocks
from clra.ops.projection.layout import Layout
from clra.ops.runtime.buffers import Allocator
from clra.ops.runtime.kernel import Step

# The most that a work-item of a CPU makes: rows or voxels of a line, and for the adjoint columns
# beside each other, whose sums have to fit the first cache. Of 448 voxels, blocks of 256 cost a
# sixth of the speed, of 128 a third.
_LINE = 1024
_ADJOINT_LINE, _WIDTH = 512, 16
# Columns of voxels that a CPU back-projects for all y before it goes on, as in the kernels.
_STRIP = 32

# Part of the volume that a CPU projects for all views of a launch before it goes on: at twice the
# size it begins to fall out of the caches, the whole of 256^3 voxels takes twice as long.
_PART_BYTES = 2 << 20
_LEAST_PLANES = 4


class ForwardProjector:
    """Line integrals through a volume, by Joseph's method [1]_.

    A ray is sampled once a plane of voxels across the axis along which it advances fastest,
    bilinearly within the plane. Outside the grid the volume is zero, towards which the
    interpolation runs over one voxel. A CPU is two to three times faster with geometries whose v is
    parallel to z than with others.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    geometry : ConeBeamGeometry
        Of the projections.
    grid : VolumeGrid
        Of the volume.
    volume_order : {"zyx", "yxz"}
        Axes of the volume. "yxz" is the kernels' own order and takes no second volume.
    allocator : callable, optional
        Gives the scratch memory, see :class:`clra.ops.runtime.buffers.Scratch`.
    scratch_limit : int, optional
        Bytes of scratch for projections: fewer views are treated at a time, at least one.

    Attributes
    ----------
    scratch_bytes : int
        Most bytes of scratch memory that it takes.

    Raises
    ------
    InputError
        If the grid reaches behind a source, or for another `volume_order`.

    References
    ----------
    .. [1] P. M. Joseph, "An improved algorithm for reprojecting rays through pixel images", IEEE
       Trans. Med. Imaging 1, 192 (1982).
    """

    _DEFINES: Mapping[str, object] = MappingProxyType({})  # of the kernels

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
        self._layout = Layout(context, geometry, grid, volume_order, allocator, scratch_limit)
        self.scratch_bytes = self._layout.scratch_bytes
        kernels = ("forward_rays", "forward_columns", "forward_tilted")
        self._project = Blocks(
            self._layout, "forwardproject", kernels, geometry.rows, _LINE, self._DEFINES
        )
        nz, ny, nx = grid.shape
        planes = max(nz, ny, nx)
        thick = planes
        if self._layout.lanes > 1:
            thick = max(_LEAST_PLANES, _PART_BYTES // (4 * nz * max(nx, ny)))
        self._parts = [(a, min(a + thick, planes)) for a in range(0, planes, thick)]

    def set_geometry(self, geometry: ConeBeamGeometry) -> None:
        """Take other vectors for the same views and detector, for example another motion.

        Raises
        ------
        InputError
            If views or detector differ, or the grid reaches behind a source.
        """
        self._layout.set_geometry(geometry)

    def __call__(
        self,
        queue: cl.CommandQueue,
        projections_out: Array,
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
        projections_out : cl.array.Array
            float32 (n, rows, columns), overwritten: the volume's unit times mm.
        volume : cl.array.Array
            float32 (nz, ny, nx), or (ny, nx, nz) if so constructed; attenuation [1/mm].
        views : slice, optional
            The n successive views of the geometry to project; all by default.
        accumulate : bool
            Whether to add to `projections_out` instead: the slabs of a volume add up to the whole.
        wait_for : sequence of cl.Event, optional
            What has to be done before.

        Returns
        -------
        cl.Event

        Raises
        ------
        TypeError, InputError
            If an argument is none of the above.
        """
        return self.integrals(
            queue,
            (projections_out,),
            volume,
            views=views,
            accumulate=accumulate,
            wait_for=wait_for,
        )

    def integrals(
        self,
        queue: cl.CommandQueue,
        outputs: tuple[Array, ...],
        volume: Array,
        *,
        views: slice | None = None,
        accumulate: bool = False,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Fill what the kernels make of each ray: one integral for this class, see `__call__`."""
        layout = self._layout
        names = ("volume", "projections_out")
        start, stop = layout.check(queue, names, volume, outputs[0], views)
        events: Sequence[cl.Event] = [*(wait_for or ()), *layout.last]
        columns, events = layout.gather_volume(queue, volume, events)
        for first, last in layout.batches(stop - start, len(outputs)):
            lines = layout.scratch_projections(len(outputs) * (last - first))
            for planes in self._parts:
                event = self._project(
                    queue,
                    (layout.detector[0], last - first),
                    lines,
                    columns,
                    slice(start + first, start + last),
                    *planes,
                    layout.grid.voxel_size,
                    wait_for=events,
                )
                events = [event]
            layout.last = [
                layout.scatter_projections(
                    queue, out[first:last], accumulate, events, k * (last - first)
                )
                for k, out in enumerate(outputs)
            ]
            events = layout.last
        return events[0] if len(events) == 1 else cl.enqueue_marker(queue, wait_for=events)


class BackProjector:
    """Back-projection of the FDK type, or the exact adjoint of :class:`ForwardProjector`.

    ``matched=False``: a voxel sums p(column, row) / g^2 over the views, where p is interpolated
    bilinearly at the voxel's projection and g is the voxel's depth as a fraction of the detector's;
    views on whose detector [0, columns - 1] x [0, rows - 1] the projection does not lie give
    nothing. Filtered projections so give FDK's volume, see :mod:`clra.ops.filtering.ramp`.

    ``matched=True``: the transpose of the forward projection's matrix, border rules included. It
    gathers: the same input gives the same bits.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    geometry : ConeBeamGeometry
        Of the projections.
    grid : VolumeGrid
        Of the volume.
    matched : bool
        Which of the two.
    volume_order : {"zyx", "yxz"}
        Axes of the volume. "yxz" is the kernels' own order and takes no second volume.
    allocator : callable, optional
        Gives the scratch memory, see :class:`clra.ops.runtime.buffers.Scratch`.
    scratch_limit : int, optional
        Bytes of scratch for projections: fewer views are treated at a time, at least one.

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
        matched: bool = False,
        volume_order: str = "zyx",
        allocator: Allocator | None = None,
        scratch_limit: int | None = None,
    ) -> None:
        self._layout = Layout(context, geometry, grid, volume_order, allocator, scratch_limit)
        self.scratch_bytes = self._layout.scratch_bytes
        nz = grid.shape[0]
        if matched:
            kernels = ("adjoint_voxels", "adjoint_columns", "adjoint_tilted")
            width = {"WIDTH": _WIDTH}
            self._project = Blocks(self._layout, "adjoint", kernels, nz, _ADJOINT_LINE, width)
            lanes = {"LANES": self._layout.lanes}
            self._weigh = Step(context, "adjoint.cl", "weigh_rays", (64, 1, 1), lanes)
        else:
            kernels = ("backproject_voxels", "backproject_columns", "backproject_tilted")
            strip = {"STRIP": _STRIP}
            self._project = Blocks(self._layout, "backproject", kernels, nz, _LINE, strip)
        self._matched = matched

    def set_geometry(self, geometry: ConeBeamGeometry) -> None:
        """Take other vectors for the same views and detector, for example another motion.

        Raises
        ------
        InputError
            If views or detector differ, or the grid reaches behind a source.
        """
        self._layout.set_geometry(geometry)

    def __call__(
        self,
        queue: cl.CommandQueue,
        volume_out: Array,
        projections: Array,
        *,
        views: slice | None = None,
        accumulate: bool = False,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Back-project.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        volume_out : cl.array.Array
            float32 (nz, ny, nx), or (ny, nx, nz) if so constructed, overwritten: the projections'
            unit, for ``matched=True`` times mm.
        projections : cl.array.Array
            float32 (n, rows, columns).
        views : slice, optional
            The n successive views of the geometry that these are; all by default.
        accumulate : bool
            Whether to add to `volume_out` instead.
        wait_for : sequence of cl.Event, optional
            What has to be done before.

        Returns
        -------
        cl.Event

        Raises
        ------
        TypeError, InputError
            If an argument is none of the above.
        """
        layout = self._layout
        names = ("volume_out", "projections")
        start, stop = layout.check(queue, names, volume_out, projections, views)
        events: Sequence[cl.Event] = [*(wait_for or ()), *layout.last]
        columns = layout.scratch_volume(volume_out)
        direct = columns is volume_out
        for first, last in layout.batches(stop - start):
            lines, event = layout.gather_projections(queue, projections[first:last], events)
            chosen = slice(start + first, start + last)
            adds = int(first > 0 or (accumulate and direct))
            if self._matched:
                event = self._adjoint(queue, columns, lines, chosen, adds, event)
            else:
                event = self._project(
                    queue, self._size(), columns, lines, chosen, adds, wait_for=[event]
                )
            layout.last = events = [event]
        if not direct:
            event = layout.scatter_volume(queue, volume_out, accumulate, events)
            layout.last = [event]
        return event

    def _size(self) -> tuple[int, int]:
        """Global size across the columns."""
        nx, ny, _ = self._layout.sizes
        return (_STRIP, ny * -(-nx // _STRIP)) if self._layout.lanes > 1 else (nx, ny)

    def _adjoint(
        self,
        queue: cl.CommandQueue,
        columns: Array,
        lines: Array,
        views: slice,
        adds: int,
        event: cl.Event,
    ) -> cl.Event:
        """Weigh the projections in place and gather them."""
        layout = self._layout
        event = self._weigh(
            queue,
            (-(-layout.detector[1] // layout.lanes), layout.detector[0], len(lines)),
            lines,
            layout.table[views],
            *layout.detector,
            len(lines),
            int(layout.columnar),
            int(layout.lanes > 1 and not layout.columnar),
            layout.grid.voxel_size,
            wait_for=[event],
        )
        nx, ny, _ = layout.sizes
        if layout.lanes == 1:
            return self._project(queue, (nx, ny), columns, lines, views, adds, wait_for=[event])
        for axis, size in enumerate([(nx, -(-ny // _WIDTH)), (ny, -(-nx // _WIDTH))]):
            event = self._project(
                queue, size, columns, lines, views, axis, max(adds, axis), wait_for=[event]
            )
        if layout.steep:
            event = self._project(
                queue, (nx, ny), columns, lines, views, 1, wait_for=[event], singly=True
            )
        return event
