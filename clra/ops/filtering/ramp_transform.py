"""The ramp filter in one launch, where a pair of detector rows fits a GPU's local memory."""

from collections.abc import Sequence

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray
from pyopencl.array import Array

from clra.ops.runtime.buffers import to_device
from clra.ops.runtime.kernel import Step, group
from clra.ops.runtime.profile import profile_of

_FILE, _KERNEL = "ramp_transform.cl", "filter_pairs"
_GROUP = 256
_SPARE = 1 << 10  # bytes of local memory that drivers take


def transform_length(context: cl.Context, columns: int) -> int | None:
    """Length of a line of so many columns, with what they run out into; None if none fits."""
    length = max(4, 1 << (columns - 1).bit_length())
    needed = 8 * (length + length // 16) + _SPARE
    fits = all(device.local_mem_size >= needed for device in context.devices)
    return length if fits and not profile_of(context).on_cpu else None


class RampTransform:
    """Weight rows, filter them and cut them out.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    spectrum : ndarray, (length / 2 + 1,)
        Of the ramp; `length` as :func:`transform_length` says.
    """

    def __init__(self, context: cl.Context, spectrum: NDArray[np.float32]) -> None:
        length = 2 * (len(spectrum) - 1)
        frequency = digit_reversed(length)
        whole = spectrum[np.minimum(frequency, length - frequency)] / length
        self._spectrum = to_device(context, whole)
        turns = np.exp(-2j * np.pi * np.arange(length) / length)
        self._twiddles = to_device(context, turns, np.complex64)
        defines = {"LENGTH": length}
        self._group = group(context, _FILE, _KERNEL, min(_GROUP, length // 4), defines)
        defines["GROUP"] = self._group
        self._step = Step(context, _FILE, _KERNEL, (self._group,), defines)

    def __call__(
        self,
        queue: cl.CommandQueue,
        filtered: Array,
        projections: Array,
        tables: Sequence[Array],
        ray_stride: int,
        before: int,
        top: int,
        wait_for: Sequence[cl.Event],
    ) -> cl.Event:
        """Filter rows from `top` on; `tables` are of views, weights of rows and rays, and roll."""
        views, rows, columns = projections.shape
        return self._step(
            queue,
            (self._group * views * -(-rows // 2),),
            filtered,
            projections,
            *tables,
            self._spectrum,
            self._twiddles,
            rows,
            top,
            filtered.shape[1],
            columns,
            ray_stride,
            filtered.shape[2],
            before,
            wait_for=wait_for,
        )


def digit_reversed(length: int) -> NDArray[np.int64]:
    """Frequency of each element that the forward transform leaves."""
    frequency, place = np.zeros(length, np.int64), np.arange(length)
    span, weight = length, 1
    while span > 1:
        radix = 4 if span >= 4 else 2
        span //= radix
        frequency += place // span % radix * weight
        weight *= radix
    return frequency


def ramp_spectrum(length: int, window: str) -> NDArray[np.float32]:
    """Return the spectrum of the band-limited ramp times a window, (length / 2 + 1,).

    Sampling |frequency| itself would lose the mean.

    Parameters
    ----------
    length : int
        Of a line.
    window : {"ram-lak", "shepp-logan", "hann"}
        See :class:`clra.ops.filtering.ramp.RampFilter`.
    """
    n = np.arange(length)
    n = np.minimum(n, length - n)
    kernel = np.where(n % 2 == 1, -1 / (np.pi * np.maximum(n, 1)) ** 2, 0.0)
    kernel[0] = 0.25
    frequency = np.arange(length // 2 + 1) / length  # cycles a column, up to 1/2
    factor = {
        "ram-lak": np.ones_like(frequency),
        "shepp-logan": np.sinc(frequency),
        "hann": 0.5 + 0.5 * np.cos(2 * np.pi * frequency),
    }[window]
    return np.ascontiguousarray(np.fft.rfft(kernel).real * factor, np.float32)
