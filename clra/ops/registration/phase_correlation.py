"""Shifts of image pairs from the peak of their cross-correlation or phase correlation."""

import math
from collections.abc import Sequence

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray
from pyopencl.array import Array

from clra.ops.filtering.fft import RealFFT, fast_length
from clra.ops.registration.windows import tukey
from clra.ops.runtime.buffers import (
    Allocator,
    Scratch,
    check_array,
    check_images,
    check_queue,
    to_device,
)
from clra.ops.runtime.kernel import Step, group
from clra.ops.runtime.lines import lined
from clra.ops.runtime.profile import profile_of

# Part of the mean modulus of a pair's cross-power below which a frequency fades out of the phase
# correlation. Where motion has blurred a reconstruction, what a re-projection still has of high
# frequencies is the radiograph's own share of it, which lies where it lay: with all frequencies
# alike most pairs of the paper's simulation are found not to have moved. An error of 5.2 pixels
# becomes 4.3 in the first iteration with 0, 0.68 with 1e-3, 0.29 with 1e-2, 0.33 with 0.1.
_FAINT = 0.01


class CorrelationPeak:
    """Peak of the cyclic cross-correlation of the images in its two arrays.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    shape : tuple of int
        (rows, columns) of the images; they are padded with zeros to lengths that transform fast.
    views : int
        Largest number of pairs.
    reach : tuple of int
        Largest shift that is looked for along (rows, columns), pixels; clipped to half the image.
    pixel : float
        Unit of these images' pixels, in which shifts are returned.
    whiten : bool
        Phase correlation: all spatial frequencies count alike, but for the faintest, see `_FAINT`.
    allocator : callable, optional
        Gives the scratch memory, see :class:`clra.ops.runtime.buffers.Scratch`.

    Attributes
    ----------
    shape : tuple of int
        Padded (rows, columns).
    measured, simulated : cl.array.Array
        float32 (views, rows, columns) of that shape, to be filled by the owner before a call.
    """

    def __init__(
        self,
        context: cl.Context,
        shape: tuple[int, int],
        *,
        views: int,
        reach: tuple[int, int],
        pixel: float = 1.0,
        whiten: bool = False,
        allocator: Allocator | None = None,
    ) -> None:
        rows, columns = self.shape = (
            fast_length(context, shape[0]),
            fast_length(context, shape[1]),
        )
        self._reach = min(reach[0], (shape[0] - 1) // 2), min(reach[1], (shape[1] - 1) // 2)
        self._pixel = float(pixel)
        memory = Scratch(context, allocator)
        self._fft = RealFFT(context, (views, rows, columns), allocator=memory)
        self.measured = memory.empty((views, rows, columns))
        self.simulated = memory.empty((views, rows, columns))
        self._spectra = [memory.empty(self._fft.spectrum_shape, np.complex64) for _ in range(2)]
        self._cross_power = Step(context, "phase_correlation.cl", "cross_power", (64,))
        self._group = group(context, "phase_correlation.cl", "peak", 256)
        shared = (self._group, 1), {"GROUP": self._group}
        self._whiten = Step(context, "phase_correlation.cl", "whiten", *shared) if whiten else None
        self._peak = Step(context, "phase_correlation.cl", "peak", *shared)

    def __call__(
        self,
        queue: cl.CommandQueue,
        shifts_out: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Find the shifts of the first len(shifts_out) pairs.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        shifts_out : cl.array.Array
            float32 (n, 2), overwritten: (u, v) of measured relative to simulated.
        wait_for : sequence of cl.Event, optional
            What has to be done before.

        Returns
        -------
        cl.Event
        """
        n = len(shifts_out)
        measured, simulated = (spectrum[:n] for spectrum in self._spectra)
        events = [
            self._fft.forward(queue, measured, self.measured[:n], wait_for),
            self._fft.forward(queue, simulated, self.simulated[:n], wait_for),
        ]
        event = self._cross_power(
            queue,
            (measured.size,),
            *(measured, simulated, measured.size),
            wait_for=events,
        )
        if self._whiten:
            size = (self._group, n), measured, _FAINT, measured.size // n
            event = self._whiten(queue, *size, wait_for=[event])
        event = self._fft.inverse(queue, self.measured[:n], measured, [event])
        return self._peak(
            queue,
            (self._group, n),
            *(shifts_out, self.measured, *self.shape, *reversed(self._reach), self._pixel),
            wait_for=[event],
        )


class CoarseShift:
    """Shift of band-passed pairs to about half a pixel, from their halved images.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    weights : ndarray, (rows, columns)
        Window of the images.
    views : int
        Largest number of pairs.
    max_shift : float
        Largest shift looked for, pixels.
    allocator : callable, optional
        Gives the scratch memory, see :class:`clra.ops.runtime.buffers.Scratch`.
    """

    def __init__(
        self,
        context: cl.Context,
        weights: NDArray[np.float64],
        *,
        views: int,
        max_shift: float,
        allocator: Allocator | None = None,
    ) -> None:
        rows, columns = self._shape = weights.shape
        reach = math.ceil(max_shift / 2)
        self._peak = CorrelationPeak(
            context,
            (rows // 2, columns // 2),
            views=views,
            reach=(reach, reach),
            pixel=2.0,
            allocator=allocator,
        )
        half = weights[: rows // 2 * 2 : 2, : columns // 2 * 2 : 2]
        self._window = to_device(context, lined(half))
        profile = profile_of(context)
        self._lanes = profile.image_lanes
        self._halve = Step(
            context, "phase_correlation.cl", "halve", profile.image_group, {"LANES": self._lanes}
        )

    def __call__(
        self,
        queue: cl.CommandQueue,
        shifts_out: Array,
        measured: Array,
        simulated: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Find the shifts of the first len(shifts_out) pairs.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        shifts_out : cl.array.Array
            float32 (n, 2), overwritten, pixels: (u, v) of measured relative to simulated.
        measured, simulated : cl.array.Array
            Lined spline coefficients (at least n, rows, stride) of the band-passed images.
        wait_for : sequence of cl.Event, optional
            What has to be done before.

        Returns
        -------
        cl.Event
        """
        n, half = len(shifts_out), self._peak.shape
        halved = [
            self._halve(
                queue,
                (-(-half[1] // self._lanes), half[0], n),
                *(out, image, self._window, self._window.shape[1], *self._shape),
                *(image.shape[-1], *half, n),
                wait_for=wait_for,
            )
            for out, image in (
                (self._peak.measured, measured),
                (self._peak.simulated, simulated),
            )
        ]
        return self._peak(queue, shifts_out, halved)


class PhaseCorrelation:
    """Phase correlation with a parabola through the peak: the classical estimator.

    The mean is removed, a Tukey window of 0.35 applied, the spectra's cross-power whitened (but for
    its faintest frequencies); the integer peak is refined by the least-squares parabola of its
    3 x 3 neighbourhood. It is the baseline beside `Registration`,
    which is several times more accurate and fails less on blurred images.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    shape : tuple of int
        (rows, columns) of the images.
    views : int
        Pairs worked on at a time; larger batches are cut.
    max_shift : float, optional
        Largest shift looked for, pixels; half the image by default.
    allocator : callable, optional
        Gives the scratch memory, see :class:`clra.ops.runtime.buffers.Scratch`.

    Attributes
    ----------
    scratch_bytes : int
        Of scratch memory.
    """

    def __init__(
        self,
        context: cl.Context,
        shape: tuple[int, int],
        *,
        views: int = 16,
        max_shift: float | None = None,
        allocator: Allocator | None = None,
    ) -> None:
        self._context, self._shape, self._views = context, shape, views
        memory = Scratch(context, allocator)
        reach = max(shape) if max_shift is None else int(max_shift)
        self._correlation = CorrelationPeak(
            context, shape, views=views, reach=(reach, reach), whiten=True, allocator=memory
        )
        self._windows = [to_device(context, tukey(length, 0.35)) for length in shape]
        self._mean = [memory.empty((views,)) for _ in range(2)]
        self.scratch_bytes = memory.bytes
        size = self._group = group(context, "phase_correlation.cl", "means", 256)
        self._means = Step(context, "phase_correlation.cl", "means", (size, 1), {"GROUP": size})
        self._windowed = Step(context, "phase_correlation.cl", "windowed", (32, 4, 1))
        self._last: list[cl.Event] = []

    def __call__(
        self,
        queue: cl.CommandQueue,
        shifts_out: Array,
        measured: Array,
        simulated: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Find shifts.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        shifts_out : cl.array.Array
            float32 (n, 2), overwritten, pixels: (u, v) by which a feature of the simulated image
            is found further in the measured one; u > 0 is toward higher columns.
        measured, simulated : cl.array.Array
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
        n = check_pair(self._context, self._shape, measured, simulated)
        check_array("shifts_out", shifts_out, (n, 2), context=self._context)
        for start in range(0, n, self._views):
            part = slice(start, min(n, start + self._views))
            waits = [*(wait_for or ()), *self._last]
            windowed = [
                self._window(queue, out, image[part], mean, waits)
                for out, image, mean in (
                    (self._correlation.measured, measured, self._mean[0]),
                    (self._correlation.simulated, simulated, self._mean[1]),
                )
            ]
            self._last = [self._correlation(queue, shifts_out[part], windowed)]
        return self._last[0]

    def _window(
        self,
        queue: cl.CommandQueue,
        out: Array,
        images: Array,
        mean: Array,
        wait_for: Sequence[cl.Event],
    ) -> cl.Event:
        n, rows, columns = images.shape
        event = self._means(
            queue, (self._group, n), mean, images, rows * columns, wait_for=wait_for
        )
        size = self._correlation.shape
        return self._windowed(
            queue,
            (size[1], size[0], n),
            *(out, images, mean, *self._windows, rows, columns, *size, n),
            wait_for=[event],
        )


def check_pair(
    context: cl.Context, shape: tuple[int, int], measured: Array, simulated: Array
) -> int:
    """Return the number of pairs, after both arrays were found to be (n, rows, columns)."""
    n = check_images("measured", measured, shape, context)
    check_array("simulated", simulated, (n, *shape), context=context)
    return n
