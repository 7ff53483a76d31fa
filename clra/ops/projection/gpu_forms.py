"""The projectors' kernels for GPUs, which take projections in the caller's order."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from clra.ops.projection.layout import Layout
from clra.ops.projection.view_table import ALIGNED
from clra.ops.runtime.kernel import Step

_GROUP = (32, 8, 1)
# Rays, and voxels along z, that a work-item treats where v is parallel to z, and voxels otherwise.
# More share more, and take registers: see tools/check_gpu.py.
_RAYS, _VOXELS = 4, 16
# Of the adjoint's kernels: axial, leaning and for any pose.
_ADJOINT_VOXELS = {"adjoint_axial": 16, "adjoint_leaning": 8, "adjoint_voxels": 1}
# Voxel-views of one launch: about a second on a slow GPU, whose display must not freeze.
_MOST_WORK = 8e9
# Views of one launch where together they see more than this many times the height that one does,
# as along a helix: enough to read and write the volume seldom.
_RUN, _SPREAD = 48, 1.25
_WIDE = 1 << 31  # elements that 32 bits can no longer count


def runs(layout: Layout, views: slice) -> Iterator[slice]:
    """Cut views into runs that one launch treats."""
    voxels = float(np.prod(layout.sizes))
    most = max(1, int(_MOST_WORK // voxels))
    count = views.stop - views.start
    yield from equal_parts(views, -(-count // most))


def equal_parts(views: slice, pieces: int) -> Iterator[slice]:
    """Cut views into parts whose numbers differ by at most 1."""
    count = views.stop - views.start
    ends = [views.start + count * k // pieces for k in range(pieces + 1)]
    yield from (slice(a, b) for a, b in pairwise(ends))


def size_constants(layout: Layout, *, volume: bool = False) -> dict[str, object]:
    """Sizes that addresses step by, as constants of a build; none where the profile says so."""
    defines: dict[str, object] = {}
    nx, ny, nz = layout.sizes
    if layout.profile.constant_sizes:
        defines["COLUMNS"] = layout.detector[0]
        if volume:
            defines |= {"NX": nx, "NZ": nz}
    if volume and nx * ny * nz >= _WIDE:
        defines["WIDE"] = 1
    return defines


class GpuForward:
    """Forward projection."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._steps: dict[str, Step] = {}
        self._step()

    def _step(self) -> Step:
        """Build what is needed, when it is."""
        layout = self._layout
        kernel = "forward_axial" if layout.columnar else "forward_rays"
        if kernel not in self._steps:
            defines = {**size_constants(layout, volume=True), "RAYS": _RAYS}
            self._steps[kernel] = Step(layout.context, "forwardproject.cl", kernel, _GROUP, defines)
        return self._steps[kernel]

    def __call__(
        self,
        queue: cl.CommandQueue,
        projections: Array,
        volume: Array,
        views: slice,
        accumulate: bool,
        wait_for: Sequence[cl.Event],
    ) -> cl.Event:
        """Project; what is launched waits for what was before it."""
        layout = self._layout
        columns, rows, _ = layout.detector
        span = -(-rows // (32 * _RAYS)) * 32 if layout.columnar else rows
        for part in runs(layout, views):
            event = self._step()(
                queue,
                (span, columns, part.stop - part.start),
                projections[part.start - views.start : part.stop - views.start],
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


class GpuBack:
    """Back-projection of the FDK type."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._steps: dict[str, Step] = {}
        self._step()

    def _step(self) -> Step:
        """Build what is needed, when it is."""
        layout = self._layout
        kernel = "backproject_axial" if layout.columnar else "backproject_voxels"
        if kernel not in self._steps:
            defines = {**size_constants(layout), "VOXELS": _VOXELS}
            self._steps[kernel] = Step(layout.context, "backproject.cl", kernel, _GROUP, defines)
        return self._steps[kernel]

    def __call__(
        self,
        queue: cl.CommandQueue,
        volume: Array,
        projections: Array,
        views: slice,
        accumulate: bool,
        wait_for: Sequence[cl.Event],
    ) -> cl.Event:
        """Back-project; what is launched waits for what was before it."""
        layout = self._layout
        nx, ny, nz = layout.sizes
        launches = list(self._launches(views))
        if not accumulate and any(bottom > 0 or top < nz for _, bottom, top in launches):
            zero = np.zeros(1, np.float32)
            memory: Any = volume.base_data
            event = cl.enqueue_fill(
                queue, memory, zero, volume.nbytes, offset=volume.offset, wait_for=wait_for
            )
            wait_for = layout.last = [event]
            accumulate = True
        for part, bottom, top in launches:
            event = self._step()(
                queue,
                (nx, ny, -(-(top - bottom) // _VOXELS)),
                volume,
                projections[part.start - views.start : part.stop - views.start],
                layout.table[part],
                *layout.sizes,
                *layout.detector[:2],
                part.stop - part.start,
                bottom,
                top,
                int(accumulate),
                wait_for=wait_for,
            )
            wait_for = layout.last = [event]
            accumulate = True
        return event

    def _launches(self, views: slice) -> Iterator[tuple[slice, int, int]]:
        """Yield views and the voxels along z that they see: the first, and one past the last.

        The first is a multiple of `ALIGNED` in the whole grid, for one beyond it may be negative.
        """
        layout = self._layout
        for part in runs(layout, views):
            heights = layout.heights[part]
            low, high = int(heights[:, 0].min()), int(heights[:, 1].max())
            count = part.stop - part.start
            pieces = -(-count // _RUN)
            if high - low <= _SPREAD * np.ptp(heights, axis=1).mean():
                pieces = 1
            for run in equal_parts(part, pieces):
                seen = layout.heights[run]
                bottom = min(int(seen[:, 0].min()), layout.sizes[2] - 1)
                top = max(int(seen[:, 1].max()), bottom + 1)
                yield run, bottom - (layout.before + bottom) % ALIGNED, top


class GpuAdjoint:
    """The exact adjoint of forward projection."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._steps: dict[str, Step] = {}
        self._weigh = self._built("weigh_rays")
        self._built(self._kernel)

    def _built(self, kernel: str) -> Step:
        """Build what is needed, when it is."""
        if kernel not in self._steps:
            voxels = _ADJOINT_VOXELS.get(kernel, 1)
            defines = {**size_constants(self._layout), "VOXELS": voxels}
            context = self._layout.context
            file = "adjoint_leaning.cl" if kernel == "adjoint_leaning" else "adjoint.cl"
            self._steps[kernel] = Step(context, file, kernel, _GROUP, defines)
        return self._steps[kernel]

    @property
    def _kernel(self) -> str:
        layout = self._layout
        if layout.columnar:
            return "adjoint_axial"
        return "adjoint_leaning" if layout.leaning else "adjoint_voxels"

    def __call__(
        self,
        queue: cl.CommandQueue,
        volume: Array,
        projections: Array,
        views: slice,
        accumulate: bool,
        wait_for: Sequence[cl.Event],
    ) -> cl.Event:
        """Weigh and gather, as many views at a time as the scratch holds."""
        layout = self._layout
        nx, ny, nz = layout.sizes
        columns, rows, _ = layout.detector
        gather, voxels = self._built(self._kernel), _ADJOINT_VOXELS[self._kernel]
        for first, last in layout.batches(views.stop - views.start):
            part = slice(views.start + first, views.start + last)
            weighed = layout.scratch_projections(last - first)
            event = self._weigh(
                queue,
                (columns, rows, last - first),
                weighed,
                projections[first:last],
                layout.table[part],
                columns,
                rows,
                last - first,
                layout.grid.voxel_size,
                wait_for=wait_for,
            )
            for run in runs(layout, part):
                event = gather(
                    queue,
                    (nx, ny, -(-nz // voxels)),
                    volume,
                    weighed[run.start - part.start : run.stop - part.start],
                    layout.table[run],
                    *layout.sizes,
                    columns,
                    rows,
                    run.stop - run.start,
                    int(accumulate),
                    wait_for=[event],
                )
                accumulate = True
            wait_for = layout.last = [event]
        return event
