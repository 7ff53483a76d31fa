"""Transposition between the order of arrays at the border and the one that projectors work in."""

from collections.abc import Sequence
from typing import NamedTuple

import pyopencl as cl
from pyopencl.array import Array

from clra.ops.runtime.kernel import Step
from clra.ops.runtime.profile import profile_of

_TILE = {1: 32, 8: 8}  # by lanes, as in transpose.cl


class Planes(NamedTuple):
    """Lines of planes in an array; strides in elements."""

    array: Array
    plane_stride: int
    line_stride: int
    lines: int
    length: int


class Transpose:
    """Lines become columns.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    """

    def __init__(self, context: cl.Context) -> None:
        lanes = 8 if profile_of(context).on_cpu else 1
        self._tile = _TILE[lanes]
        # Where a device allows less, there are more groups than tiles; those beyond do nothing.
        self._local = 256 if lanes == 1 else 1
        self._step = Step(
            context, "transpose.cl", "transpose", (self._local, 1, 1), {"LANES": lanes}
        )

    def __call__(
        self,
        queue: cl.CommandQueue,
        target: Planes,
        source: Planes,
        planes: int,
        *,
        before: int = 0,
        accumulate: bool = False,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Fill each line of the target from a column of the source, and with zeros beyond.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        target, source : Planes
            Where to and from.
        planes : int
            How many.
        before : int
            Zeros to begin the target's lines with.
        accumulate : bool
            Whether to add to the target.
        wait_for : sequence of cl.Event, optional
            What has to be done before.

        Returns
        -------
        cl.Event
        """
        size = (
            self._local * -(-target.length // self._tile),
            -(-target.lines // self._tile),
            planes,
        )
        return self._step(queue, size, *target, *source, before, int(accumulate), wait_for=wait_for)
