"""Difference-of-Gaussians band-pass of radiographs, evaluable between the pixels."""

import math
from collections.abc import Sequence

import numpy as np
import pyopencl as cl
from numpy.typing import ArrayLike
from pyopencl.array import Array

from clra.errors import InputError
from clra.ops.images.bandpass_tables import plane_fit, reciprocal, spline_table
from clra.ops.images.blur import gaussian_taps
from clra.ops.runtime.buffers import (
    Allocator,
    Scratch,
    check_array,
    check_images,
    check_queue,
    to_device,
)
from clra.ops.runtime.kernel import Step
from clra.ops.runtime.lines import MARGIN, line_stride, lined
from clra.ops.runtime.profile import profile_of

# Variance of the cubic B-spline, in squares of its knots' distance.
_SPLINE = 1 / 3
# As in bandpass.cl: blocks before the first, and one more behind the last.
_RIM = 2
LEAST_LOW_PASS, LARGEST_LOW_PASS = 0.6, MARGIN / 4


class Bandpass:
    r"""Difference of two Gaussians: structures between `low_pass` and `high_pass`.

    .. math:: D(q) = \sum_p b(q - p) \left[ \frac{h * (M I)}{h * M} - W \right](p)

    with the cubic B-spline b, so that D is defined between the pixels without interpolation error,
    and the mask M, 0 outside the detector: pixels that do not count are replaced by a mean of their
    neighbours (normalised convolution). b and h add up to a Gaussian of sigma `low_pass`. W(p) is
    the value at p of the plane fitted to the image with Gaussian weights of sigma `high_pass`,
    which is a Gaussian filter inside, and next to borders and masks keeps slopes from turning into
    structures that would stand still in the detector. Slopes give 0 (but for the outermost pixels).

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    shape : tuple of int
        (rows, columns) of the images.
    views : int
        Largest number of images of a call.
    low_pass : float
        Sigma of the narrow Gaussian, pixels, 0.6 to 4.
    high_pass : float
        Sigma of the wide Gaussian, pixels; no more than a quarter of the image's shorter side is
        used, see the attribute of this name.
    mask : array_like of bool, optional
        (rows, columns), True where pixels count, for all images.
    allocator : callable, optional
        Gives the scratch memory, see :class:`clra.ops.runtime.buffers.Scratch`.

    Attributes
    ----------
    shape : tuple of int
        (rows, columns).
    stride : int
        Elements of a line of a lined image.
    low_pass, high_pass : float
        As used.
    scratch : cl.array.Array
        Lined images that are free between calls.
    scratch_bytes : int
        Most bytes of scratch memory that it takes.

    Raises
    ------
    InputError
        If sigmas or mask are none of the above, or the image is too small for `low_pass`.
    """

    def __init__(
        self,
        context: cl.Context,
        shape: tuple[int, int],
        *,
        views: int,
        low_pass: float = 1.0,
        high_pass: float = 16.0,
        mask: ArrayLike | None = None,
        allocator: Allocator | None = None,
    ) -> None:
        rows, columns = self.shape = shape
        self.low_pass, self.high_pass = low_pass, min(high_pass, min(shape) / 4)
        if not LEAST_LOW_PASS <= low_pass <= LARGEST_LOW_PASS:
            raise InputError(
                f"low_pass: found {low_pass}, expected {LEAST_LOW_PASS} to {LARGEST_LOW_PASS} px"
            )
        if not self.high_pass >= 2 * low_pass:
            raise InputError(
                f"high_pass: found {self.high_pass} px (of {high_pass}, for images {shape}), "
                f"expected at least twice low_pass, {2 * low_pass}"
            )
        if mask is not None and np.shape(mask) != shape:
            raise InputError(f"mask: found shape {np.shape(mask)}, expected {shape}")
        if mask is not None and not np.any(mask):
            raise InputError("mask: found no pixel that counts, expected some")
        self.stride = line_stride(columns)
        self._context, self._views = context, views
        self._masked = mask is not None
        counts = np.ones(shape) if mask is None else (np.asarray(mask) != 0).astype(np.float64)

        narrow = gaussian_taps(math.sqrt(low_pass**2 - _SPLINE))
        # The coarse sigma stays within 2 to 4 coarse pixels: few taps, little aliasing.
        factor = self._factor = 1 << max(0, math.ceil(math.log2(self.high_pass / 4)))
        blocks = (factor**2 - 1) / 12 + _SPLINE * factor**2
        wide = gaussian_taps(math.sqrt(self.high_pass**2 - _SPLINE - blocks) / factor)
        coarse = self._coarse = rows // factor + 2 * _RIM + 1, columns // factor + 2 * _RIM + 1
        self._coarse_stride = line_stride(coarse[1])
        means = np.zeros(coarse)
        cut = rows // factor, factor, columns // factor, factor
        complete = counts[: cut[0] * factor, : cut[2] * factor].reshape(cut)
        means[_RIM : _RIM + cut[0], _RIM : _RIM + cut[2]] = complete.mean((1, 3))
        self._narrow, self._wide = to_device(context, narrow), to_device(context, wide)
        self._mask = to_device(context, lined(counts))
        self._scale = to_device(context, lined(reciprocal(counts, narrow)))
        self._fit = to_device(context, np.stack([lined(image) for image in plane_fit(means, wide)]))
        profile = profile_of(context)
        self._lanes = profile.image_lanes
        weights, bases = spline_table(columns, factor, self._lanes, _RIM)
        self._weights, self._bases = (
            to_device(context, lined(weights)),
            to_device(context, bases, np.int32),
        )
        self._memory = Scratch(context, allocator)
        self.scratch = self.empty()
        self._means, self._zeroth, self._first = (
            self._memory.zeros((views, coarse[0], self._coarse_stride)) for _ in range(3)
        )
        own = 4 * views * (rows + coarse[0]) * self.stride
        self.scratch_bytes = self._memory.bytes + own
        self._own: tuple[Array, Array] | None = None
        self._last: list[cl.Event] = []

        self._steps = {
            name: Step(context, "bandpass.cl", name, profile.image_group, {"LANES": self._lanes})
            for name in (
                "block_means",
                "wide_rows",
                "wide_columns",
                "expand_columns",
                "narrow_rows",
                "bandpass_columns",
                "spline_values",
            )
        }

    def empty(self) -> Array:
        """Lined images (views, rows, stride), zero."""
        return self._memory.zeros((self._views, self.shape[0], self.stride))

    def empty_expanded(self) -> Array:
        """Lined images (views, coarse rows, stride) for the wide part, zero."""
        return self._memory.zeros((self._views, self._coarse[0], self.stride))

    def __call__(
        self,
        queue: cl.CommandQueue,
        out: Array,
        images: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Band-pass images.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        out : cl.array.Array
            float32 (n, rows, columns), overwritten; n is at most `views`.
        images : cl.array.Array
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
        check_queue(queue, self._context)
        n = check_images("images", images, self.shape, self._context)
        if n > self._views:
            raise InputError(f"images: found {n} of them, expected 1 to {self._views}")
        check_array("out", out, (n, *self.shape), context=self._context)
        if self._own is None:
            self._own = self.empty(), self.empty_expanded()
        event = self.coefficients(queue, *self._own, images, wait_for)
        event = self._values(queue, out, self._own[0], n, self.shape[1], 0, [event])
        self._last = [event]
        return event

    def coefficients(
        self,
        queue: cl.CommandQueue,
        coefficients_out: Array,
        expanded_out: Array,
        images: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Spline coefficients of the band-passed images.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        coefficients_out : cl.array.Array
            From :meth:`empty`.
        expanded_out : cl.array.Array
            From :meth:`empty_expanded`: images blurred by the wide Gaussian, every few rows.
        images : cl.array.Array
            float32 (n, rows, columns), checked by the caller.
        wait_for : sequence of cl.Event, optional
            What has to be done before.

        Returns
        -------
        cl.Event
        """
        n = len(images)
        (rows, columns), stride = self.shape, self.stride
        coarse, coarse_stride, factor = self._coarse, self._coarse_stride, self._factor
        step, masked = self._steps, int(self._masked)
        event = step["block_means"](
            queue,
            (coarse[1], coarse[0], n),
            *(self._means, images, self._mask, rows, columns, stride, factor),
            *(*coarse, coarse_stride, masked, n),
            wait_for=self._memory.cleared(queue, [*(wait_for or ()), *self._last]),
        )
        blocks = -(-coarse[1] // self._lanes)
        event = step["wide_rows"](
            queue,
            (blocks, coarse[0], n),
            *(self._zeroth, self._first, self._means, self._wide, self._wide.size // 2),
            *(*coarse, coarse_stride, n),
            wait_for=[event],
        )
        event = step["wide_columns"](
            queue,
            (blocks, coarse[0], n),
            *(self._means, self._zeroth, self._first, self._fit, self._wide),
            *(self._wide.size // 2, *coarse, coarse_stride, n),
            wait_for=[event],
        )
        event = step["expand_columns"](
            queue,
            (-(-columns // self._lanes), coarse[0], n),
            *(expanded_out, self._means, self._weights, self._bases, len(self._weights)),
            *(coarse[0], coarse_stride, columns, stride, n),
            wait_for=[event],
        )
        blocks = -(-columns // self._lanes)
        event = step["narrow_rows"](
            queue,
            (blocks, rows, n),
            *(self.scratch, images, self._mask, self._narrow, self._narrow.size // 2),
            *(rows, columns, stride, masked, n),
            wait_for=[event],
        )
        event = step["bandpass_columns"](
            queue,
            (blocks, rows, n),
            *(coefficients_out, self.scratch, self._scale, self._narrow),
            *(self._narrow.size // 2, expanded_out, factor, coarse[0], rows, columns, stride, n),
            wait_for=[event],
        )
        self._last = [event]
        return event

    def values(
        self,
        queue: cl.CommandQueue,
        values_out: Array,
        coefficients: Array,
        n: int,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Evaluate the first `n` images at the pixels; both arrays come from :meth:`empty`."""
        return self._values(queue, values_out, coefficients, n, self.stride, MARGIN, wait_for)

    def _values(
        self,
        queue: cl.CommandQueue,
        out: Array,
        coefficients: Array,
        n: int,
        out_stride: int,
        out_lead: int,
        wait_for: Sequence[cl.Event] | None,
    ) -> cl.Event:
        rows, columns = self.shape
        return self._steps["spline_values"](
            queue,
            (-(-columns // self._lanes), rows, n),
            *(out, coefficients, rows, columns, self.stride, out_stride, out_lead, n),
            wait_for=wait_for,
        )
