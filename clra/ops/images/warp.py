"""Correction of radiographs for their motion: one interpolation, by cubic B-splines."""

import math
from collections.abc import Sequence

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from clra.errors import InputError
from clra.ops.runtime.buffers import (
    Allocator,
    Scratch,
    check_array,
    check_images,
    check_queue,
    to_device,
    within,
)
from clra.ops.runtime.kernel import Step
from clra.ops.runtime.lines import line_stride
from clra.ops.runtime.profile import profile_of

_TAPS = 14  # as in warp.cl


class Warp:
    """Images as they would be without motion: ``corrected(q) = measured(c + m (q - c) + t)``.

    m is the magnification, t = (shift_u, shift_v) and c = ((columns - 1) / 2, (rows - 1) / 2): a
    feature that the motion moved from q to ``c + m (q - c) + t`` is back at q. The spline
    interpolates: without motion images stay what they are. Positions off the image have the value
    at its border. [1]_

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    shape : tuple of int
        (rows, columns) of the images.
    allocator : callable, optional
        Gives the scratch memory, see :class:`clra.ops.runtime.buffers.Scratch`.
    scratch_limit : int, optional
        Bytes of scratch: fewer images are treated at a time, at least one.

    Attributes
    ----------
    shape : tuple of int
        As given.
    scratch_bytes : int
        Most bytes of scratch memory that it takes, with the first call of many images.

    Raises
    ------
    InputError
        If the shape is not two positive numbers.

    References
    ----------
    .. [1] M. Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal
       Processing Magazine 16(6), 22-38, 1999.
    """

    def __init__(
        self,
        context: cl.Context,
        shape: tuple[int, int],
        *,
        allocator: Allocator | None = None,
        scratch_limit: int | None = None,
    ) -> None:
        if len(shape) != 2 or min(shape) < 1:
            raise InputError(f"shape: found {shape}, expected two positive numbers")
        self.shape = shape
        self._context = context
        self._lanes = profile_of(context).image_lanes
        rows, columns = shape
        self._stride = line_stride(columns)
        # Of two images each; as many bytes are best for one.
        limit = None if scratch_limit is None else scratch_limit // 2
        most = within(profile_of(context).warp_bytes, limit)
        self._most_views = max(1, most // (4 * rows * self._stride))

        def step(name: str) -> Step:
            return Step(context, "warp.cl", name, (64, 2, 1), {"LANES": self._lanes})

        self._prefilter_rows = step("prefilter_rows")
        self._resample_rows = step("resample_rows")
        self._prefilter_columns = step("prefilter_columns")
        self._resample_columns = step("resample_columns")
        taps = math.sqrt(3) * (math.sqrt(3) - 2) ** np.arange(_TAPS + 1.0)
        self._taps = to_device(context, taps)
        self.scratch_bytes = 4 * self._most_views * rows * (columns + self._stride)
        self._memory = Scratch(context, allocator)
        self._images: tuple[Array, Array] | None = None
        self._last: list[cl.Event] = []

    def __call__(
        self,
        queue: cl.CommandQueue,
        corrected_out: Array,
        measured: Array,
        motion: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Correct images.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        corrected_out : cl.array.Array
            float32 (n, rows, columns), overwritten; may be `measured` itself.
        measured : cl.array.Array
            float32 (n, rows, columns), the raw images: warping twice blurs twice.
        motion : cl.array.Array
            float32 (n, 3), shift_u and shift_v in pixels of these images, and magnification.
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
        check_queue(queue, self._context)
        n = check_images("measured", measured, self.shape, self._context)
        check_array("corrected_out", corrected_out, (n, *self.shape), context=self._context)
        check_array("motion", motion, (n, 3), context=self._context)
        chunk = min(n, self._most_views)
        events = [*(wait_for or ()), *self._last]
        for start in range(0, n, chunk):
            part = slice(start, start + chunk)
            event = self._warp(queue, corrected_out[part], measured[part], motion[part], events)
            events = [event]
        self._last = events
        return event

    def _warp(
        self,
        queue: cl.CommandQueue,
        corrected: Array,
        measured: Array,
        motion: Array,
        events: list[cl.Event],
    ) -> cl.Event:
        views = len(measured)
        coefficients, lined = self._scratch(views)
        rows, columns = self.shape
        sizes = (columns, rows, views)
        blocks = (-(-columns // self._lanes), rows, views)
        event = self._prefilter_rows(
            queue, blocks, coefficients, measured, self._taps, *sizes, wait_for=events
        )
        event = self._resample_rows(
            queue,
            (self._stride // self._lanes, rows, views),
            lined,
            coefficients,
            motion,
            *sizes,
            self._stride,
            wait_for=[event],
        )
        event = self._prefilter_columns(
            queue,
            blocks,
            coefficients,
            lined,
            self._taps,
            *sizes,
            self._stride,
            wait_for=[event],
        )
        return self._resample_columns(
            queue, blocks, corrected, coefficients, motion, *sizes, wait_for=[event]
        )

    def _scratch(self, views: int) -> tuple[Array, Array]:
        """Hold two buffers for that many images, larger ones where a call brings more."""
        if self._images is None or len(self._images[0]) < views:
            rows, columns = self.shape
            self._images = (
                self._memory.empty((views, rows, columns)),
                self._memory.empty((views, rows, self._stride)),
            )
        return self._images
