"""Kernels whose work-items make a line each, or a block of a long one."""

from collections.abc import Mapping, Sequence

import pyopencl as cl
from pyopencl.array import Array

from clra.ops.layout import Layout
from clra.ops.steps import Step

_ROUND = 64  # what geometry.clh's lanes ask for, and few enough sizes to compile for


class Blocks:
    """The kernel for columns and the general one of one operation, whichever applies.

    Parameters
    ----------
    layout : Layout
        Says which applies, and holds views and sizes.
    file : str
        Kernel file.
    columns, general : str
        Names of the two kernels.
    length : int
        Elements of a line.
    most : int
        Elements of a block on a CPU; on a GPU a block is one element.
    defines : mapping, optional
        Further preprocessor definitions.
    """

    def __init__(
        self,
        layout: Layout,
        file: str,
        columns: str,
        general: str,
        length: int,
        most: int,
        defines: Mapping[str, object] | None = None,
    ) -> None:
        self._layout = layout
        wide = layout.lanes > 1
        blocks = -(-length // most) if wide else length
        block = _ROUND * -(-length // (blocks * _ROUND)) if wide else 1
        self._blocks = -(-length // block)
        # On GPUs neighbours along a line read neighbours, and next columns share what they read.
        local = (1, 1, 1) if wide else (32, 8, 1)
        defines = {"LANES": layout.lanes, "BLOCK": block, **(defines or {})}
        names = (columns, general) if wide else (general,)
        self._steps = [Step(layout.context, file, name, local, defines) for name in names]

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
        step = self._steps[0 if layout.columnar else -1]
        return step(
            queue,
            (self._blocks, *shape),
            target,
            source,
            layout.table[views],
            *layout.sizes,
            *layout.panel,
            views.stop - views.start,
            *more,
            wait_for=wait_for,
        )
