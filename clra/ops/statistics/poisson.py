"""Statistics of transmission data with Poisson noise, and the volume updates that follow from them.

A ray with line integral l counts q = b exp(-l) + r photons, b in the open beam and r background.
Measured counts y are given as line integrals p: y = b exp(-p) + r.
"""

from collections.abc import Sequence

import numpy as np
import pyopencl as cl
from numpy.typing import ArrayLike
from pyopencl.array import Array

from clra.errors import InputError
from clra.ops.runtime.buffers import check_array, check_images, check_queue, to_device
from clra.ops.runtime.kernel import Step

_FILE = "poisson.cl"


class RayStatistics:
    """What the likelihood of counted photons says of each ray of radiographs.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    open_beam : array_like, (rows, columns)
        Photons of the open beam at each pixel; 0 where a pixel may not be used.
    background : float
        Photons at each pixel that did not pass the sample straight.

    Raises
    ------
    InputError
        If photons are negative or not finite.

    References
    ----------
    .. [1] H. Erdogan, J. A. Fessler, "Ordered subsets algorithms for transmission tomography",
       Phys. Med. Biol. 44, 2835 (1999).
    """

    def __init__(self, context: cl.Context, open_beam: ArrayLike, background: float = 0.0) -> None:
        photons = np.asarray(open_beam, np.float64)
        if photons.ndim != 2 or not (np.isfinite(photons).all() and photons.min() >= 0):
            raise InputError(
                f"open_beam: found shape {photons.shape} from {photons.min():g}, expected photons "
                "of rows and columns, none negative"
            )
        if not 0 <= background < np.inf:
            raise InputError(f"background: found {background:g}, expected photons, 0 or more")
        self._context = context
        self._shape = photons.shape
        self._open_beam = to_device(context, photons)
        self._used = int(np.count_nonzero(photons))
        self._background = float(background)
        self._sums = to_device(context, np.zeros(photons.shape))
        self._steps = {
            name: Step(context, _FILE, name, (64, 1))
            for name in ("deviance", "gradient", "curvature", "optimal_curvature", "balance")
        }

    def deviance(
        self,
        queue: cl.CommandQueue,
        simulated: Array,
        measured: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Add the Poisson deviance ``2 (q - y + y log(y / q))`` of each ray to a running sum.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order.
        simulated, measured : cl.array.Array
            float32 (n, rows, columns), line integrals.
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
        n = self._check(queue, simulated=simulated, measured=measured)
        pixels = self._shape[0] * self._shape[1]
        return self._steps["deviance"](
            queue,
            (pixels, 1),
            *(self._sums, simulated, measured, self._open_beam, self._background, pixels, n),
            wait_for=wait_for,
        )

    def misfit(self, queue: cl.CommandQueue, views: int) -> float:
        """Return the mean of the summed deviances and start anew.

        Parameters
        ----------
        queue : cl.CommandQueue
            The one that :meth:`deviance` was called with.
        views : int
            That were summed.

        Returns
        -------
        float
            Deviance of a ray; about 1 where nothing but noise is left.
        """
        total = float(self._sums.get(queue=queue).sum(dtype=np.float64))
        self._sums.fill(np.float32(0), queue=queue)
        return total / (self._used * views)

    def gradient(
        self,
        queue: cl.CommandQueue,
        gradient_out: Array,
        simulated: Array,
        measured: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Fill `gradient_out`, which may be `simulated`, with ``(1 - y / q) b exp(-l)`` [photons].

        Back-projected it is the gradient of the log-likelihood. Other arguments, result and errors
        are as for :meth:`deviance`.
        """
        n = self._check(queue, gradient_out=gradient_out, simulated=simulated, measured=measured)
        return self._rays("gradient", queue, n, [gradient_out, simulated, measured], wait_for)

    def curvature(
        self,
        queue: cl.CommandQueue,
        weighted_out: Array,
        chords: Array,
        measured: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Fill `weighted_out`, which may be `chords`, with ``a (y - r)^2 / y`` [photons mm].

        a is the length of a ray within the volume, `chords`. Back-projected it is the denominator
        of the separable-paraboloid step with precomputed curvatures, [1]_ of the class. Other
        arguments, result and errors are as for :meth:`deviance`.
        """
        n = self._check(queue, weighted_out=weighted_out, chords=chords, measured=measured)
        return self._rays("curvature", queue, n, [weighted_out, chords, measured], wait_for)

    def optimal_curvature(
        self,
        queue: cl.CommandQueue,
        weighted_out: Array,
        simulated: Array,
        chords: Array,
        measured: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Fill `weighted_out` with ``a c(l)``, c the least curvature that never overshoots.

        `weighted_out` may be `simulated` or `chords`. The steps that follow never lower the
        likelihood. Other arguments, result and errors are as for :meth:`deviance`.
        """
        arrays = [weighted_out, simulated, chords, measured]
        names = ("weighted_out", "simulated", "chords", "measured")
        n = self._check(queue, **dict(zip(names, arrays, strict=True)))
        return self._rays("optimal_curvature", queue, n, arrays, wait_for)

    def balance(
        self,
        queue: cl.CommandQueue,
        simulated: Array,
        found_out: Array,
        measured: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Turn `simulated` into ``b exp(-l)`` and fill `found_out` with ``b exp(-l) y / q``.

        Back-projected, the two are equal where the likelihood is largest; their ratio is the
        multiplicative step. Other arguments, result and errors are as for :meth:`deviance`.
        """
        n = self._check(queue, simulated=simulated, found_out=found_out, measured=measured)
        return self._rays("balance", queue, n, [simulated, found_out, measured], wait_for)

    def _rays(
        self,
        name: str,
        queue: cl.CommandQueue,
        n: int,
        arrays: Sequence[Array],
        wait_for: Sequence[cl.Event] | None,
    ) -> cl.Event:
        pixels = self._shape[0] * self._shape[1]
        return self._steps[name](
            queue,
            (pixels, n),
            *(*arrays, self._open_beam, self._background, pixels, n),
            wait_for=wait_for,
        )

    def _check(self, queue: cl.CommandQueue, **arrays: Array) -> int:
        """Refuse what does not fit; number of views."""
        check_queue(queue, self._context)
        measured = arrays.pop("measured")
        n = check_images("measured", measured, self._shape, self._context)
        for name, array in arrays.items():
            check_array(name, array, (n, *self._shape), context=self._context)
        return n


class VolumeStep:
    """The step of a volume, or of a slab of it, once its back-projections are known.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    """

    def __init__(self, context: cl.Context) -> None:
        self._context = context
        self._add, self._multiply = (
            Step(context, _FILE, name, (64, 1)) for name in ("add_step", "multiply_step")
        )

    def add(
        self,
        queue: cl.CommandQueue,
        volume: Array,
        numerator: Array,
        denominator: Array,
        step: float,
        least: float,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Do ``mu <- max(0, mu + step numerator / denominator)``.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        volume : cl.array.Array
            float32 with three axes; changed in place.
        numerator, denominator : cl.array.Array
            float32, of the same shape.
        step : float
            Factor of the step.
        least : float
            Voxels with no larger denominator keep their value: no ray meets them, or hardly one.
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
        sizes = self._check(queue, volume, numerator, denominator)
        return self._add(
            queue,
            sizes,
            *(volume, numerator, denominator, float(step), float(least), *sizes),
            wait_for=wait_for,
        )

    def multiply(
        self,
        queue: cl.CommandQueue,
        volume: Array,
        numerator: Array,
        denominator: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Do ``mu <- mu numerator / denominator``, by a factor of 4 at most.

        Voxels whose numerator and denominator are 0 keep their value. Arguments, result and errors
        are as for :meth:`add`.
        """
        sizes = self._check(queue, volume, numerator, denominator)
        return self._multiply(
            queue, sizes, *(volume, numerator, denominator, *sizes), wait_for=wait_for
        )

    def _check(
        self, queue: cl.CommandQueue, volume: Array, numerator: Array, denominator: Array
    ) -> tuple[int, int]:
        """Refuse what does not fit; voxels along the last axis, and lines of them."""
        check_queue(queue, self._context)
        shape: tuple[int, ...] = getattr(volume, "shape", ())
        named = {"volume": volume, "numerator": numerator, "denominator": denominator}
        for name, array in named.items():
            check_array(name, array, shape, context=self._context)
        return int(shape[-1]), int(np.prod(shape[:-1]))
