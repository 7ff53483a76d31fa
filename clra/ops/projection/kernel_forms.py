"""Kernels whose work-items make a line each, or a block of a long one."""

from collections.abc import Mapping, Sequence

import pyopencl as cl
from pyopencl.array import Array

from clra.ops.projection.layout import Layout
from clra.ops.runtime.kernel import Step

_ROUND = 64  # what pieces.clh's lanes ask for, and few enough sizes to compile for

_FORMS = ("", "_columns", "_tilted")


class Blocks:
    """The kernels of one operation, of which one applies.

    Parameters
    ----------
    layout : Layout
        Says which applies, and holds views and sizes.
    stem : str
        Of the kernel files: a CPU runs those for columns, where v is parallel to z, and for tilted
        views, a GPU the plain one, which makes one element a work-item.
    kernels : tuple of str
        Kernels of the plain file, the one for columns and the one for tilted views.
    length : int
        Elements of a line.
    most : int
        Elements of a block on a CPU.
    defines : mapping, optional
        Further preprocessor definitions.
    """

    def __init__(
        self,
        layout: Layout,
        stem: str,
        kernels: tuple[str, str, str],
        length: int,
        most: int,
        defines: Mapping[str, object] | None = None,
    ) -> None:
        self._layout = layout
        self._names = [
            (f"{stem}{form}.cl", kernel) for form, kernel in zip(_FORMS, kernels, strict=True)
        ]
        self._length = length
        blocks = -(-length // most)
        block = _ROUND * -(-length // (blocks * _ROUND))
        self._blocks = -(-length // block)
        lanes = {"LANES": layout.lanes}
        self._defines = [{**lanes, **(defines or {})}] + 2 * [
            {**lanes, "BLOCK": block, **(defines or {})}
        ]
        self._steps: dict[int, Step] = {}
        self._step(self._form)

    @property
    def _form(self) -> int:
        """Which kernel applies."""
        return 0 if self._layout.lanes == 1 else 1 if self._layout.columnar else 2

    def _step(self, form: int) -> Step:
        """Build what is needed, when it is."""
        if form not in self._steps:
            # On GPUs neighbours along a line read neighbours, and next columns share what they
            # read.
            local = (1, 1, 1) if self._layout.lanes > 1 else (32, 8, 1)
            self._steps[form] = Step(
                self._layout.context, *self._names[form], local, self._defines[form]
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
        singly: bool = False,
    ) -> cl.Event:
        """Launch for `views` over blocks and `shape`; `more` are the kernel's last arguments.

        `singly` runs the plain kernel in any case.
        """
        layout = self._layout
        form = 0 if singly else self._form
        return self._step(form)(
            queue,
            (self._blocks if form else self._length, *shape),
            target,
            source,
            layout.table[views],
            *layout.sizes,
            *layout.detector,
            views.stop - views.start,
            *more,
            wait_for=wait_for,
        )
