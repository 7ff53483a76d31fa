"""Registration of measured and simulated radiographs: shift, magnification, gain and offset."""

import math
from collections.abc import Sequence

import numpy as np
import pyopencl as cl
from numpy.typing import ArrayLike
from pyopencl.array import Array

from clra.errors import InputError
from clra.ops.images.bandpass import Bandpass
from clra.ops.images.blur import Blur
from clra.ops.registration.phase_correlation import CoarseShift, check_pair
from clra.ops.registration.windows import box, registration_window
from clra.ops.runtime.buffers import Allocator, Scratch, check_array, check_queue, to_device, within
from clra.ops.runtime.kernel import Step, group
from clra.ops.runtime.lines import line_stride, lined
from clra.ops.runtime.profile import profile_of

ESTIMATE_FIELDS = (
    "shift_u",
    "shift_v",
    "magnification",
    "gain",
    "offset",
    "correlation",
    "residual",
    "sigma_u",
    "sigma_v",
    "sigma_m",
)

SMALLEST = 16
"""Fewest rows and columns of images that can be registered."""

# As gauss_newton.clh has them: floats of a view's state, sums of its normal equations.
_STATE, _SUMS = 8, 36

# Sigmas by which the measured image is blurred further, pixels, to resemble the simulated one. The
# pair more than halves the shift's error for simulated images averaged over random shifts of up to
# 9 pixels, and the magnification's falls from 4e-4 to 1e-4 for a plain blur of 2 pixels. (3,)
# alone, (1.5, 3) and (3, 6) do less, (2, 4, 8) no more.
_BLURS = (2.0, 4.0)

# Rows of a work-group's sums: 4 to 64 take the same time on a CPU, a GPU wants many groups.
_BLOCK_ROWS = 16
# Smaller steps than this many pixels end a view's iteration. Errors are ten times larger.
_TOLERANCE = 1e-3
# Longest step, pixels: structures are hardly narrower, so that longer ones may not be trusted.
_MAX_STEP = 2.0
_MAX_MAGNIFICATION = 0.05


def pair_bytes(shape: tuple[int, int], high_pass: float) -> int:
    """Bytes of scratch memory that a pair of (rows, columns) takes in :class:`Registration`."""
    # Most of it are images in lines; the wide Gaussian works on images that many times coarser.
    coarser = max(1.0, min(high_pass, min(shape) / 4) / 4)
    return round((32 + 18 / coarser**2) * shape[0] * line_stride(shape[1]))


class Registration:
    r"""Residual motion of each radiograph of a batch against its re-projection.

    Finds, for each view, the shift t, magnification m, gain g and offset o that minimise

    .. math:: \sum_q w(q) \left[ \textstyle\sum_k a_k A_k(q)
        - g\,B\!\left(c + \frac{q - c - t}{m}\right) - o \right]^2

    by Gauss-Newton steps from the peak of the cross-correlation. B is the simulated image after
    the `Bandpass`, a spline that is evaluated between its pixels; the
    A_k are the measured image after it and the same blurred further by Gaussians of 2 and 4 pixels,
    in the mixture a that resembles B most, found anew in each step: a re-projection is less sharp
    than a radiograph, and least squares takes this for magnification. c is the detector's centre.
    The window w is 0 along the borders and rises to 1 smoothly.

    Gradients are those of the simulated image, which has no noise. Intensity slopes and gains do
    not matter, as the band-pass takes them out and g is free.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    shape : tuple of int
        (rows, columns) of the images, at least 16 each.
    views : int, optional
        Largest number of pairs worked on at a time; larger batches are cut. It is no more than fits
        128 MiB of scratch memory on a CPU, 512 MiB elsewhere, about 32 bytes a pixel.
    low_pass, high_pass : float
        Sigmas of the band-pass, pixels. `high_pass` is clipped to a quarter of the image's shorter
        side.
    mask : array_like of bool, optional
        (rows, columns), True where all images count. A masked area is treated like the space beyond
        the border, a masked pixel or line is filled from its neighbours and left out.
    margin : float
        Part of the image's height and width over which the window rises, 0.02 to 0.3; it starts at
        half of it from the border. Less lets in what moved into or out of the detector.
    iterations : int
        Largest number of Gauss-Newton steps; a view stops as soon as it moves less than 0.001 px.
    magnification : bool
        False: m stays 1.
    spread : float
        Standard deviation of log(magnification) that is expected of a view, `known` included; 0
        if nothing is. It counts as much as the image does not tell: small images and those with
        little structure leave the magnification where it is expected.
    coarse : bool
        Start from the peak of the cross-correlation, searched up to `max_shift`, instead of from
        shift 0. Worth it where shifts may exceed 2 pixels.
    max_shift : float
        Views that leave this range, pixels, stay with the best estimate before.
    allocator : callable, optional
        Gives the scratch memory, see :class:`clra.ops.runtime.buffers.Scratch`.
    scratch_limit : int, optional
        Bytes of scratch: fewer pairs are treated at a time, at least one.

    Attributes
    ----------
    scratch_bytes : int
        Of scratch memory.

    Raises
    ------
    InputError
        If an option is none of the above.

    Notes
    -----
    A view without usable signal (blank, constant, not finite, or unlike its counterpart) gets shift
    0, magnification 1, gain 1, correlation 0 and large sigmas (the image's longer side, and 1).

    Standard errors come from the inverse normal matrix and the residual's variance. The residual is
    white noise after the band-pass, of which :math:`4 \pi s^2` neighbouring pixels count as one
    sample for a Gaussian of sigma s (`low_pass`, for a mixture of blurs accordingly).
    """

    def __init__(
        self,
        context: cl.Context,
        shape: tuple[int, int],
        *,
        views: int | None = None,
        low_pass: float = 1.0,
        high_pass: float = 16.0,
        mask: ArrayLike | None = None,
        margin: float = 0.12,
        iterations: int = 6,
        magnification: bool = True,
        spread: float = 0.0,
        coarse: bool = True,
        max_shift: float = 16.0,
        allocator: Allocator | None = None,
        scratch_limit: int | None = None,
    ) -> None:
        rows, columns = self.shape = shape
        if min(shape) < SMALLEST:
            raise InputError(f"shape: found {shape}, expected at least {SMALLEST} rows and columns")
        if iterations < 1:
            raise InputError(f"iterations: found {iterations}, expected 1 or more")
        if not max_shift > 0:
            raise InputError(f"max_shift: found {max_shift}, expected a positive number of pixels")
        if views is not None and views < 1:
            raise InputError(f"views: found {views}, expected 1 or more")
        most = within(profile_of(context).registration_bytes, scratch_limit)
        fitting = max(1, most // pair_bytes(shape, high_pass))
        views = fitting if views is None else min(views, fitting)
        self._context, self._views = context, views
        self._iterations, self._magnification = iterations, int(magnification)
        self._max_shift = float(max_shift)
        if not spread >= 0:
            raise InputError(f"spread: found {spread}, expected 0 or more")
        self._spread = float(spread)
        memory = self._memory = Scratch(context, allocator)
        band = self._bandpass = Bandpass(
            context,
            shape,
            views=views,
            low_pass=low_pass,
            high_pass=high_pass,
            mask=mask,
            allocator=memory,
        )
        weights = registration_window(shape, margin, low_pass, mask)
        valid = np.ones(shape) if mask is None else np.asarray(mask) != 0
        self._window, self._valid = (to_device(context, lined(image)) for image in (weights, valid))
        self._box = box(weights)
        self._blocks = -(-(self._box[1] - self._box[0]) // _BLOCK_ROWS)
        self._coarse = (
            CoarseShift(context, weights, views=views, max_shift=max_shift, allocator=memory)
            if coarse
            else None
        )
        self._measured, self._simulated = band.empty(), band.empty()
        self._wide = band.empty_expanded(), band.empty_expanded()
        self._mixed = memory.zeros((1 + len(_BLURS), views, rows, line_stride(columns)))
        self._state, self._levels, self._shifts, self._sums = (
            memory.empty((views, *item)) for item in ((_STATE,), (2,), (2,), (self._blocks, _SUMS))
        )
        self.scratch_bytes = memory.bytes
        variances = np.array([0.0, *_BLURS]) ** 2
        self._blurs = [Blur(context, shape, math.sqrt(variance)) for variance in np.diff(variances)]
        # White noise of variance 1 a pixel has this covariance after two Gaussians.
        noise = 1 / (2 * math.pi * np.add.outer(variances, variances + 2 * low_pass**2))
        self._noise = to_device(context, noise)

        sums = ("gauss_newton_sums.cl", "normal_equations")
        self._group = group(context, *sums, 64)
        defines = {"GROUP": self._group}
        if self._group == 1:
            defines["LANES"] = profile_of(context).image_lanes
        self._normal_equations = Step(context, *sums, (self._group, 1, 1), defines)
        alone = (self._group,)  # work-items, of a view each
        self._start = Step(context, "gauss_newton.cl", "start", alone)
        self._advance = Step(context, "gauss_newton.cl", "advance", alone)
        self._nothing = to_device(context, np.zeros(views))
        self._last: list[cl.Event] = []

    def __call__(
        self,
        queue: cl.CommandQueue,
        estimates_out: Array,
        measured: Array,
        simulated: Array,
        known: Array | None = None,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Register pairs.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        estimates_out : cl.array.Array
            float32 (n, 10), overwritten, columns in the order of ``ESTIMATE_FIELDS``. Shifts and
            their sigmas are in pixels, u along columns. A feature of the simulated image at q is
            found in the measured one at c + magnification (q - c) + shift: this is the motion to
            append to the one that the simulation was made with (``motion.then``). correlation is
            that of A and B after the fit, 0 to 1; offset and residual (rms) are in the measured
            image's units, after the band-pass.
        measured, simulated : cl.array.Array
            float32 (n, rows, columns).
        known : cl.array.Array, optional
            float32 (n,): logarithm of the magnification that each simulation was made with.
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
        n = check_pair(self._context, self.shape, measured, simulated)
        check_array(
            "estimates_out", estimates_out, (n, len(ESTIMATE_FIELDS)), context=self._context
        )
        if known is not None:
            check_array("known", known, (n,), context=self._context)
        for start in range(0, n, self._views):
            part = slice(start, min(n, start + self._views))
            event = self._prepare(
                queue, measured[part], simulated[part], [*(wait_for or ()), *self._last]
            )
            grown = self._nothing if known is None else known[part]
            event = self._iterate(queue, estimates_out[part], grown, [event])
            self._last = [event]
        return event

    def _prepare(
        self,
        queue: cl.CommandQueue,
        measured: Array,
        simulated: Array,
        wait_for: Sequence[cl.Event],
    ) -> cl.Event:
        """Band-pass both images, search the coarse shift, blur the measured image further."""
        n, band = len(measured), self._bandpass
        wait_for = self._memory.cleared(queue, wait_for)
        event = band.coefficients(queue, self._measured, self._wide[0], measured, wait_for)
        event = band.coefficients(queue, self._simulated, self._wide[1], simulated, [event])
        event = band.values(queue, self._mixed[0], self._measured, n, [event])
        if self._coarse is not None:
            shifts = self._shifts[:n]
            event = self._coarse(queue, shifts, self._measured, self._simulated, [event])
        for k, blur in enumerate(self._blurs):
            event = blur(queue, self._mixed[k + 1], self._mixed[k], band.scratch, n, [event])
        return event

    def _iterate(
        self,
        queue: cl.CommandQueue,
        estimates: Array,
        known: Array,
        wait_for: Sequence[cl.Event],
    ) -> cl.Event:
        """Gauss-Newton rounds; views that are done are passed over."""
        n, (rows, columns), stride = len(estimates), self.shape, self._bandpass.stride
        radius, unknown = 0.5 * math.hypot(rows, columns), float(max(rows, columns))
        event = self._start(
            queue,
            (n,),
            *(self._state, estimates, self._levels, self._shifts),
            *(int(self._coarse is not None), *self._wide, self._wide[0].shape[1]),
            *(columns, stride, self._max_shift, unknown, 1.0, n),
            wait_for=wait_for,
        )
        # One more than there are steps: the last one is judged too.
        for _ in range(self._iterations + 1):
            event = self._normal_equations(
                queue,
                (self._group, self._blocks, n),
                *(self._sums, self._mixed, self._views, self._simulated, self._window),
                *(self._valid, self._state, rows, columns, stride, *self._box, _BLOCK_ROWS),
                *(1 / radius, n),
                wait_for=[event],
            )
            event = self._advance(
                queue,
                (n,),
                *(self._state, estimates, self._sums, self._levels, self._blocks, radius),
                *(self._noise, self._max_shift, _MAX_MAGNIFICATION, _MAX_STEP, _TOLERANCE),
                *(unknown, 1.0, self._magnification, known, self._spread, n),
                wait_for=[event],
            )
        return event
