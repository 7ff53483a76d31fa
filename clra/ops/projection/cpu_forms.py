"""The projectors' kernels for CPUs: padded lines, of which work-items make blocks, in vectors."""

from collections.abc import Mapping, Sequence

import pyopencl as cl
from pyopencl.array import Array

from clra.ops.projection.layout import Layout
from clra.ops.runtime.kernel import Step

# The most that a work-item makes: rows or voxels of a line, and for the adjoint columns beside each
# other, whose sums have to fit the first cache. Of 448 voxels, blocks of 256 cost a sixth of the
# speed, of 128 a third.
_LINE = 1024
_ADJOINT_LINE, _WIDTH = 512, 16
_ROUND = 64  # whole vectors, and few enough sizes to compile for
# Columns of voxels that are back-projected for all y before others are, as in the kernels.
_STRIP = 32

# Part of the volume that is projected for all views of a launch before the next one: at twice the
# size it begins to fall out of the caches, the whole of 256^3 voxels takes twice as long.
_PART_BYTES = 2 << 20
_LEAST_PLANES = 4


class Blocks:
    """The kernels of one operation, for v parallel to z and for any pose.

    Parameters
    ----------
    layout : Layout
        Says which applies, and holds views and sizes.
    stem : str
        Of the kernel files, which end in "_columns" and "_tilted".
    kernels : tuple of str
        Their kernels.
    length : int
        Elements of a line.
    most : int
        Elements of a block.
    defines : mapping, optional
        Further preprocessor definitions.
    """

    def __init__(
        self,
        layout: Layout,
        stem: str,
        kernels: tuple[str, str],
        length: int,
        most: int,
        defines: Mapping[str, object] | None = None,
    ) -> None:
        self._layout = layout
        self._names = ((f"{stem}_tilted.cl", kernels[1]), (f"{stem}_columns.cl", kernels[0]))
        blocks = -(-length // most)
        block = _ROUND * -(-length // (blocks * _ROUND))
        self._blocks = -(-length // block)
        self._defines = {"LANES": layout.lanes, "BLOCK": block, **(defines or {})}
        self._steps: dict[bool, Step] = {}
        self._step()

    def _step(self) -> Step:
        """Build what is needed, when it is."""
        form = self._layout.columnar
        if form not in self._steps:
            self._steps[form] = Step(
                self._layout.context, *self._names[form], (1, 1, 1), self._defines
            )
        return self._steps[form]

    def __call__(
        self,
        queue: cl.CommandQueue,
        shape: tuple[int, int],
        target: Array,
        source: Array,
        views: slice,
        *more: float,
        wait_for: Sequence[cl.Event],
    ) -> cl.Event:
        """Launch for `views` over blocks and `shape`; `more` are the kernel's last arguments."""
        layout = self._layout
        return self._step()(
            queue,
            (self._blocks, *shape),
            target,
            source,
            layout.table[views],
            *layout.sizes,
            *layout.detector,
            views.stop - views.start,
            *more,
            wait_for=wait_for,
        )


class CpuForward:
    """Forward projection, or with MOMENT among the definitions the two integrals of each ray."""

    def __init__(self, layout: Layout, defines: Mapping[str, object] | None = None) -> None:
        self._layout = layout
        kernels = ("forward_columns", "forward_tilted")
        rows = layout.detector[1]
        self._project = Blocks(layout, "forwardproject", kernels, rows, _LINE, defines)
        nx, ny, nz = layout.sizes
        planes = max(layout.sizes)
        thick = max(_LEAST_PLANES, _PART_BYTES // (4 * nz * max(nx, ny)))
        self._parts = [(a, min(a + thick, planes)) for a in range(0, planes, thick)]

    def __call__(
        self,
        queue: cl.CommandQueue,
        projections: Array,
        volume: Array,
        views: slice,
        accumulate: bool,
        wait_for: Sequence[cl.Event],
    ) -> cl.Event:
        """Project into lines, part of the volume after part, and transpose these."""
        return self.integrals(queue, (projections,), volume, views, accumulate, wait_for)

    def integrals(
        self,
        queue: cl.CommandQueue,
        outputs: Sequence[Array],
        volume: Array,
        views: slice,
        accumulate: bool,
        wait_for: Sequence[cl.Event],
    ) -> cl.Event:
        """Do so with one image a view, or two; lines of the second follow all of the first."""
        layout = self._layout
        for first, last in layout.batches(views.stop - views.start):
            lines = layout.scratch_projections(len(outputs) * (last - first))
            for planes in self._parts:
                event = self._project(
                    queue,
                    (layout.detector[0], last - first),
                    lines,
                    volume,
                    slice(views.start + first, views.start + last),
                    *planes,
                    layout.grid.voxel_size,
                    wait_for=wait_for,
                )
                wait_for = [event]
            for index, out in enumerate(outputs):
                event = layout.scatter_projections(
                    queue, out[first:last], accumulate, wait_for, index * (last - first)
                )
                wait_for = layout.last = [event]
        return event


class CpuBack:
    """Back-projection of the FDK type."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        kernels = ("backproject_columns", "backproject_tilted")
        strip = {"STRIP": _STRIP}
        length = layout.before + layout.sizes[2]
        self._project = Blocks(layout, "backproject", kernels, length, _LINE, strip)

    def __call__(
        self,
        queue: cl.CommandQueue,
        volume: Array,
        projections: Array,
        views: slice,
        accumulate: bool,
        wait_for: Sequence[cl.Event],
    ) -> cl.Event:
        """Back-project, as many views at a time as the scratch holds."""
        layout = self._layout
        nx, ny, _ = layout.sizes
        for first, last in layout.batches(views.stop - views.start):
            lines, event = layout.gather_projections(queue, projections[first:last], wait_for)
            event = self._project(
                queue,
                (_STRIP, ny * -(-nx // _STRIP)),
                volume,
                lines,
                slice(views.start + first, views.start + last),
                int(first > 0 or accumulate),
                wait_for=[event],
            )
            wait_for = layout.last = [event]
        return event


class CpuAdjoint:
    """The exact adjoint of forward projection."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        kernels = ("adjoint_columns", "adjoint_tilted")
        width = {"WIDTH": _WIDTH}
        nz = layout.sizes[2]
        self._project = Blocks(layout, "adjoint", kernels, nz, _ADJOINT_LINE, width)
        lanes = {"LANES": layout.lanes}
        file = "adjoint_steep.cl"
        self._weigh = Step(layout.context, file, "weigh_lines", (64, 1, 1), lanes)
        self._steep = Step(layout.context, file, "adjoint_steep", (1, 1, 1), lanes)

    def __call__(
        self,
        queue: cl.CommandQueue,
        volume: Array,
        projections: Array,
        views: slice,
        accumulate: bool,
        wait_for: Sequence[cl.Event],
    ) -> cl.Event:
        """Weigh the projections in scratch and gather them."""
        layout = self._layout
        nx, ny, nz = layout.sizes
        columns, rows, _ = layout.detector
        for first, last in layout.batches(views.stop - views.start):
            lines, event = layout.gather_projections(queue, projections[first:last], wait_for)
            part = slice(views.start + first, views.start + last)
            event = self._weigh(
                queue,
                (-(-rows // layout.lanes), columns, last - first),
                lines,
                layout.table[part],
                *layout.detector,
                last - first,
                int(not layout.columnar),
                layout.grid.voxel_size,
                wait_for=[event],
            )
            adds = int(first > 0 or accumulate)
            for axis, size in enumerate([(nx, -(-ny // _WIDTH)), (ny, -(-nx // _WIDTH))]):
                event = self._project(
                    queue, size, volume, lines, part, axis, max(adds, axis), wait_for=[event]
                )
            if layout.steep:
                event = self._steep(
                    queue,
                    (nz, nx, ny),
                    volume,
                    lines,
                    layout.table[part],
                    *layout.sizes,
                    *layout.detector,
                    last - first,
                    wait_for=[event],
                )
            wait_for = layout.last = [event]
        return event
