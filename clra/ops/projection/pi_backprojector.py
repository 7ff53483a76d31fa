"""Back-projection over pi-intervals, for exact reconstruction from one helix or several."""

import math
from collections.abc import Sequence

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from clra.model.grid import VolumeGrid
from clra.model.helix.helix import Helix
from clra.model.helix.pi_intervals import pi_reach, pi_spans
from clra.ops.projection.gpu_forms import size_constants
from clra.ops.projection.layout import Layout
from clra.ops.projection.view_table import ALIGNED
from clra.ops.runtime.buffers import Allocator, to_device
from clra.ops.runtime.kernel import Step

# Voxels along z that a work-item of a CPU sums. A view sees a short part of the volume: of longer
# blocks much is idle.
_VOXELS = 256
_GPU_VOXELS = 8

# Columns of voxels along x that a CPU treats for all y before it goes on, so that what they see of
# the projections stays in the cache. All 320 of a volume take a third longer.
_STRIP = 32


class PiBackProjector:
    """Sum filtered radiographs over each voxel's pi-interval.

    A voxel sums p(column, row) / g over the views in which its projection lies in the
    Tam-Danielsson window, where p is interpolated bilinearly and g is the voxel's depth as a
    fraction of the detector's. The window's borders are softened by half a row and by half of what
    the projection moves from view to view. Where several helices hold the whole pi-interval of a
    voxel, the voxel is the mean of what they give; where none does, it is 0.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    helices : sequence of Helix
        All helices of the scan, as filtered, see `KatsevichFilter`.
    helix : int
        Which of them the views are of.
    grid : VolumeGrid
        Of the volume.
    radius : float
        Of the field of view about the axis, outside of which voxels are 0 [mm].
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
        If the grid reaches behind a source.
    """

    def __init__(
        self,
        context: cl.Context,
        helices: Sequence[Helix],
        helix: int,
        grid: VolumeGrid,
        radius: float,
        *,
        allocator: Allocator | None = None,
        scratch_limit: int | None = None,
    ) -> None:
        own = helices[helix]
        self._helix, self._helices, self._radius = helix, helices, radius
        self._layout = Layout(
            context,
            own.geometry(),
            grid,
            "yxz",
            allocator=allocator,
            scratch_limit=scratch_limit,
        )
        self.scratch_bytes = self._layout.scratch_bytes
        if self._layout.profile.on_cpu:
            defines = {"LANES": self._layout.lanes, "BLOCK": _VOXELS}
            file, kernel = "pi_backprojector_columns.cl", "pi_columns"
            self._step = Step(context, file, kernel, (1, 1, 1), defines)
        else:
            constants = {**size_constants(self._layout), "VOXELS": _GPU_VOXELS}
            file, kernel = "pi_backprojector.cl", "pi_backproject"
            self._step = Step(context, file, kernel, (32, 8, 1), constants)
        columns = np.arange(own.shape[1] + 1)
        borders = np.sort(own.row(np.stack(own.window(own.tangent_u(columns)), axis=1)), axis=1)
        self._window = to_device(context, borders)
        spans = [pi_spans(one, grid.whole, radius) for one in helices]
        self._spans = to_device(context, np.stack(spans))

    def __call__(
        self,
        queue: cl.CommandQueue,
        volume_out: Array,
        projections: Array,
        *,
        views: slice | None = None,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Back-project, adding to the volume.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        volume_out : cl.array.Array
            float32 (ny, nx, nz), added to; attenuation [1/mm].
        projections : cl.array.Array
            float32 (n, rows, columns), filtered.
        views : slice, optional
            The n successive views of the helix that these are; all by default.
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
        nx, ny, nz = layout.sizes
        own = self._helices[self._helix]
        names = ("volume_out", "projections")
        start, stop = layout.check(queue, names, volume_out, projections, views)
        events: Sequence[cl.Event] = [*(wait_for or ()), *layout.last]
        event = cl.enqueue_marker(queue, events)
        for first, last in layout.batches(stop - start):
            bottom, top = self._seen(start + first, start + last)
            if top <= bottom:
                continue
            bottom -= (layout.before + bottom) % ALIGNED
            part = projections[first:last]
            if layout.profile.on_cpu:
                part, event = layout.gather_projections(queue, part, events)
                events = [event]
                size = -(-(top - bottom) // _VOXELS), _STRIP, ny * -(-nx // _STRIP)
                pitch, strip = [layout.detector[2]], [_STRIP]
            else:
                size = nx, ny, -(-(top - bottom) // _GPU_VOXELS)
                pitch, strip = [], []
            event = self._step(
                queue,
                size,
                volume_out,
                part,
                layout.table[start + first : start + last],
                self._window,
                self._spans,
                nx,
                ny,
                nz,
                *layout.detector[:2],
                *pitch,
                last - first,
                len(self._helices),
                self._helix,
                layout.grid.first,
                bottom,
                top,
                *strip,
                abs(own.z_step) / layout.grid.voxel_size,
                wait_for=events,
            )
            events = [event]
        layout.last = [event]
        return event

    def _seen(self, first: int, last: int) -> tuple[int, int]:
        """First voxel along z that is in the window of some of the views, and past the last."""
        grid = self._layout.grid
        own = self._helices[self._helix]
        ends = [pi_reach(own, view, self._radius) for view in (first, last - 1)]
        low = (min(end[0] for end in ends) - grid.index_to_world()[2, 3]) / grid.voxel_size
        high = (max(end[1] for end in ends) - grid.index_to_world()[2, 3]) / grid.voxel_size
        return max(0, math.floor(low)), min(grid.shape[0], math.ceil(high) + 1)
