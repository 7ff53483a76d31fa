"""Coarser and finer images and volumes, factor 2: means over blocks, trilinear between centres."""

from collections.abc import Sequence

import pyopencl as cl
from pyopencl.array import Array

from clra.errors import InputError
from clra.ops.runtime.buffers import check_array, check_queue
from clra.ops.runtime.kernel import Step
from clra.ops.runtime.profile import profile_of


class _Resampling:
    """One kernel of ``pyramid.cl``, launched over blocks of columns of its output."""

    _kernel: str

    def __init__(self, context: cl.Context) -> None:
        self._context = context
        # On a CPU 8 columns an item are 3 times faster than one.
        self._lanes = profile_of(context).image_lanes
        self._step = Step(context, "pyramid.cl", self._kernel, (32, 4, 1), {"LANES": self._lanes})

    def _launch(
        self,
        queue: cl.CommandQueue,
        out: Array,
        source: Array,
        sizes: Sequence[int],
        columns: int,
        wait_for: Sequence[cl.Event] | None,
    ) -> cl.Event:
        """Run over the rows and planes of `out` and blocks of `columns` coarse columns."""
        check_queue(queue, self._context)
        size = (-(-columns // self._lanes), out.shape[1], out.shape[0])
        return self._step(queue, size, out, source, *sizes, wait_for=wait_for)


class Restrict2D(_Resampling):
    """Means over 2 x 2 pixels of every image; the last row or column of an odd number is dropped.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    """

    _kernel = "restrict_2d"

    def __call__(
        self,
        queue: cl.CommandQueue,
        coarse_out: Array,
        fine: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Fill `coarse_out`.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        coarse_out : cl.array.Array
            float32 (n, rows // 2, columns // 2), overwritten.
        fine : cl.array.Array
            float32 (n, rows, columns).
        wait_for : sequence of cl.Event, optional
            What has to be done before.

        Returns
        -------
        cl.Event

        Raises
        ------
        TypeError, InputError
            If an array is none of the above.
        """
        n, rows, columns = _shape("fine", fine, (1, 2, 2))
        check_array("fine", fine, (n, rows, columns), context=self._context)
        half = (n, rows // 2, columns // 2)
        check_array("coarse_out", coarse_out, half, context=self._context)
        return self._launch(queue, coarse_out, fine, (*half, rows, columns), half[2], wait_for)


class Restrict3D(_Resampling):
    """Means over 2 x 2 x 2 voxels; the last plane, row or column of an odd number is dropped.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    """

    _kernel = "restrict_3d"

    def __call__(
        self,
        queue: cl.CommandQueue,
        coarse_out: Array,
        fine: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Fill `coarse_out`, float32 of half of `fine`'s shape, rounded down.

        The order of the axes does not matter. Other arguments, result and errors are as for
        :class:`Restrict2D`.
        """
        planes, rows, columns = _shape("fine", fine, (2, 2, 2))
        check_array("fine", fine, (planes, rows, columns), context=self._context)
        half = (planes // 2, rows // 2, columns // 2)
        check_array("coarse_out", coarse_out, half, context=self._context)
        return self._launch(queue, coarse_out, fine, (*half, rows, columns), half[2], wait_for)


class Prolong3D(_Resampling):
    """Trilinear interpolation between the centres of coarse voxels; constant beyond the last.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    """

    _kernel = "prolong_3d"

    def __call__(
        self,
        queue: cl.CommandQueue,
        fine_out: Array,
        coarse: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Fill `fine_out`, float32, whose shape halved and rounded down is that of `coarse`.

        The order of the axes does not matter. Other arguments, result and errors are as for
        :class:`Restrict2D`.
        """
        fine = _shape("fine_out", fine_out, (2, 2, 2))
        check_array("fine_out", fine_out, fine, context=self._context)
        half = (fine[0] // 2, fine[1] // 2, fine[2] // 2)
        check_array("coarse", coarse, half, context=self._context)
        # An odd last column has no coarse column of its own.
        columns = -(-fine[2] // 2)
        return self._launch(queue, fine_out, coarse, (*fine, *half), columns, wait_for)


def _shape(name: str, array: Array, least: tuple[int, int, int]) -> tuple[int, int, int]:
    """Shape of a device array with three axes of at least the given lengths."""
    if not isinstance(array, Array):
        raise TypeError(f"{name}: found {type(array).__name__}, expected a pyopencl.array.Array")
    shape = array.shape
    if len(shape) != 3 or any(n < m for n, m in zip(shape, least, strict=True)):
        raise InputError(f"{name}: found shape {shape}, expected three axes of at least {least}")
    return shape[0], shape[1], shape[2]
