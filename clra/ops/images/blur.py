"""Gaussian blur of lined images."""

import math
from collections.abc import Sequence

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray
from pyopencl.array import Array

from clra.ops.runtime.buffers import to_device
from clra.ops.runtime.kernel import Step
from clra.ops.runtime.lines import MARGIN, lined
from clra.ops.runtime.profile import profile_of

# Taps beyond this many sigmas weigh less than 0.3 % of the middle one.
_REACH = 3.5


def gaussian_taps(sigma: float) -> NDArray[np.float64]:
    """Sample a Gaussian: unit sum, odd length, cut off at 3.5 sigma or at MARGIN.

    Parameters
    ----------
    sigma : float
        Samples, positive.

    Returns
    -------
    ndarray of float64
    """
    radius = min(MARGIN, math.ceil(_REACH * sigma))
    values = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    return np.asarray(values / values.sum())


class Blur:
    """Gaussian blur; near the border, of what lies on the detector.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    shape : tuple of int
        (rows, columns) of the images.
    sigma : float
        Pixels.
    """

    def __init__(self, context: cl.Context, shape: tuple[int, int], sigma: float) -> None:
        self._shape = shape
        taps = gaussian_taps(sigma)
        part = np.convolve(np.ones(shape[1]), taps, "full")[taps.size // 2 :][: shape[1]]
        self._taps, self._scale = (
            to_device(context, taps),
            to_device(context, lined(1 / part[None])),
        )
        profile = profile_of(context)
        self._lanes = profile.image_lanes
        self._rows, self._columns = (
            Step(context, "blur.cl", name, profile.image_group, {"LANES": self._lanes})
            for name in ("blur_rows", "blur_columns")
        )

    def __call__(
        self,
        queue: cl.CommandQueue,
        blurred_out: Array,
        image: Array,
        between: Array,
        n: int,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Blur the first `n` images.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        blurred_out, image, between : cl.array.Array
            Lined images (at least n, rows, stride): result, input, scratch; those of the input and
            scratch have to be zero beyond the detector. `blurred_out` may be `image`.
        n : int
            Number of images.
        wait_for : sequence of cl.Event, optional
            What has to be done before.

        Returns
        -------
        cl.Event
        """
        (rows, columns), stride = self._shape, image.shape[-1]
        size = (-(-columns // self._lanes), rows, n)
        radius = self._taps.size // 2
        event = self._rows(
            queue,
            size,
            *(between, image, self._taps, radius, rows, columns, stride, n),
            wait_for=wait_for,
        )
        return self._columns(
            queue,
            size,
            *(blurred_out, between, self._taps, radius, self._scale, rows, columns, stride, n),
            wait_for=[event],
        )
