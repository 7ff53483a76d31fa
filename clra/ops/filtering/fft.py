"""Real Fourier transforms: pocketfft on CPU devices, reikna on GPUs, behind one class.

On a CPU device the buffers are host memory, and scipy's pocketfft is 7 to 70 times faster than
OpenCL FFT kernels there.
"""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from clra.errors import InputError
from clra.findings import warn
from clra.ops.filtering.fft_device import DeviceFFT, NoPlanError
from clra.ops.filtering.fft_host import HostFFT
from clra.ops.runtime.buffers import Allocator, check_array, check_queue
from clra.ops.runtime.profile import profile_of

BACKENDS = ("scipy", "reikna")


def fast_length(context: cl.Context, length: int, backend: str | None = None) -> int:
    """Smallest length of at least `length` that transforms fast.

    Parameters
    ----------
    context : cl.Context
        Where the transform will run.
    length : int
        Least length, positive.
    backend : {"scipy", "reikna"}, optional
        As for :class:`RealFFT`.

    Returns
    -------
    int
        A product of 2, 3 and 5 for pocketfft, a power of two for reikna.
    """
    if _backend(context, backend) == "reikna":
        return 1 << max(1, (length - 1).bit_length())
    from scipy.fft import next_fast_len

    return int(next_fast_len(length, real=True))


class RealFFT:
    """Batched transforms of real images along their columns, or along rows and columns.

    Spectra are numpy's: ``rfft`` or ``rfft2`` without scaling forward, 1/N backward, half of the
    last axis kept. The scipy backend computes on the host: its calls block until their inputs are
    there, and return an event that is as good as complete.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    shape : tuple of int
        (n, rows, columns) of the images; a call may bring fewer than `n`.
    axes : tuple of int
        ``(1, 2)`` for rows and columns, ``(2,)`` for columns only.
    backend : {"scipy", "reikna"}, optional
        None: "scipy" on a CPU device, "reikna" elsewhere. Where reikna finds no work-group that a
        device allows, a warning says so and scipy is used.
    allocator : callable, optional
        Gives the scratch memory, see :class:`clra.ops.runtime.buffers.Scratch`.

    Attributes
    ----------
    shape, spectrum_shape : tuple of int
        Of the images and of their spectra, (n, rows, columns) and (n, rows, columns // 2 + 1).
    scratch_bytes : int
        Most bytes of scratch memory that it takes, without what reikna's transform keeps.

    Raises
    ------
    InputError
        If shape, axes or backend are none of these.
    """

    def __init__(
        self,
        context: cl.Context,
        shape: tuple[int, int, int],
        axes: Sequence[int] = (1, 2),
        backend: str | None = None,
        *,
        allocator: Allocator | None = None,
    ) -> None:
        if len(shape) != 3 or min(shape) < 1:
            raise InputError(f"shape: found {shape}, expected three positive numbers")
        if tuple(axes) not in ((2,), (1, 2)):
            raise InputError(f"axes: found {tuple(axes)}, expected (2,) or (1, 2)")
        self.shape = shape
        self.spectrum_shape = (*shape[:2], shape[2] // 2 + 1)
        self._context = context
        self._multiplier_shape = self.spectrum_shape[3 - len(axes) :]
        self._backend: _Backend
        self.scratch_bytes = 0
        if _backend(context, backend) == "reikna":
            try:
                transform = DeviceFFT(context, shape, tuple(axes), allocator)
            except NoPlanError as error:  # a device of small work-groups
                warn("slow-transforms", f"{error}: transforms run on the host, slowly")
            else:
                self.scratch_bytes = transform.scratch_bytes
                self._backend = transform
                return
        self._backend = HostFFT(context, shape, tuple(axes))

    def forward(
        self,
        queue: cl.CommandQueue,
        spectrum_out: Array,
        image: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Spectrum of every image.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        spectrum_out : Array
            complex64 (n, rows, columns // 2 + 1), overwritten.
        image : Array
            float32 (n, rows, columns), n up to the planned number.
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
        n = self._count(image)
        self._check("image", image, (n, *self.shape[1:]))
        self._check("spectrum_out", spectrum_out, (n, *self.spectrum_shape[1:]), np.complex64)
        return self._backend.forward(queue, spectrum_out, image, list(wait_for or ()))

    def inverse(
        self,
        queue: cl.CommandQueue,
        image_out: Array,
        spectrum: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Image of every spectrum; arguments, result and errors as in :meth:`forward`.

        The spectrum has to be that of a real image; it is not changed.
        """
        check_queue(queue, self._context)
        n = self._count(image_out)
        self._check("image_out", image_out, (n, *self.shape[1:]))
        self._check("spectrum", spectrum, (n, *self.spectrum_shape[1:]), np.complex64)
        return self._backend.inverse(queue, image_out, spectrum, list(wait_for or ()))

    def apply(
        self,
        queue: cl.CommandQueue,
        image_out: Array,
        image: Array,
        multiplier: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Cyclic convolution: transform, multiply, transform back.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        image_out : Array
            float32 (n, rows, columns), overwritten; may be `image` itself.
        image : Array
            float32 (n, rows, columns).
        multiplier : Array
            float32 or complex64 factors of the spectrum, (columns // 2 + 1,) where columns are
            transformed, (rows, columns // 2 + 1) where rows are too.
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
        n = self._count(image)
        self._check("image", image, (n, *self.shape[1:]))
        self._check("image_out", image_out, (n, *self.shape[1:]))
        complex_factors = getattr(multiplier, "dtype", None) == np.complex64
        dtype = np.complex64 if complex_factors else np.float32
        self._check("multiplier", multiplier, self._multiplier_shape, dtype)
        return self._backend.apply(queue, image_out, image, multiplier, list(wait_for or ()))

    def _count(self, image: Any) -> int:
        """Images in this call; the planned number where that is what has to be said."""
        n = image.shape[0] if getattr(image, "shape", ()) else 0
        return int(n) if 1 <= n <= self.shape[0] else self.shape[0]

    def _check(
        self, name: str, array: Any, shape: tuple[int, ...], dtype: Any = np.float32
    ) -> None:
        check_array(name, array, shape, dtype, self._context)


def _backend(context: cl.Context, backend: str | None) -> str:
    if backend is None:
        return profile_of(context).fft
    if backend not in BACKENDS:
        raise InputError(f"backend: found {backend!r}, expected one of {', '.join(BACKENDS)}")
    return backend


class _Backend(Protocol):
    def forward(
        self, queue: cl.CommandQueue, spectrum: Array, image: Array, wait_for: list[cl.Event]
    ) -> cl.Event: ...

    def inverse(
        self, queue: cl.CommandQueue, image: Array, spectrum: Array, wait_for: list[cl.Event]
    ) -> cl.Event: ...

    def apply(
        self,
        queue: cl.CommandQueue,
        out: Array,
        image: Array,
        multiplier: Array,
        wait_for: list[cl.Event],
    ) -> cl.Event: ...
