"""What becomes of magnifications that are found: held to what is expected, or told by place."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.options import Solver
from clra.methods.alignment.reprojection import Registered
from clra.methods.alignment.steps.moved_sample import MovedSample
from clra.methods.alignment.steps.slow_modes import held, slow_part
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion

# Most iterations of a level in which small images tell magnifications without a prior: two find
# where the sample stands, a third that it stays.
_PROBES = 3


class Magnifications:
    """The magnifications of an alignment, from iteration to iteration.

    Parameters
    ----------
    solver : Solver
        Parts of the iteration.
    start : Motion
        Where the alignment starts: its magnifications are expected.
    scale : bool
        Whether magnifications are estimated.
    place : (ConeBeamGeometry, VolumeGrid), optional
        Of the scan, at full resolution, and of its sample, if that may be moved across the axis.

    Attributes
    ----------
    probing : bool
        Whether small images have to tell magnifications without a prior in this iteration.
    displaced : bool
        Whether the last iteration moved the sample.
    """

    def __init__(
        self,
        solver: Solver,
        start: Motion,
        scale: bool,
        place: tuple[ConeBeamGeometry, VolumeGrid] | None,
    ) -> None:
        self._solver, self._start, self._scale = solver, start, scale
        may_move = scale and solver.spread > 0 and start.cause == "detector"
        self._sample = MovedSample(*place) if place and may_move else None
        self._shape: tuple[int, ...] = (0, 0)
        self._probes = 0
        self.probing = self.displaced = False

    def begin(self, shape: tuple[int, ...]) -> None:
        """Begin with a level whose images have these rows and columns."""
        self._shape, self._probes = shape, 0

    def prepare(self, motion: Motion, valid_views: NDArray[np.bool_], *, first: bool) -> None:
        """Decide whether the next iteration probes: once a level, and until the sample stays."""
        again = self._probes == 0 or (self.displaced and self._probes < _PROBES)
        self.probing = False
        if self._sample is not None and not first and again and self._solver.pull(self._shape):
            drift = slow_part(motion.shift_u, valid_views.astype(np.float64))
            self.probing = self._sample.doubt(drift) > self._solver.spread
            self._probes += self.probing

    def aside(
        self, motion: Motion, found: Registered, valid_views: NDArray[np.bool_]
    ) -> Motion | None:
        """Return the motion that puts the sample on the axis, if magnifications are told that tell.

        Parameters
        ----------
        motion : Motion
            Before the iteration.
        found : Registered
            By it.
        valid_views : ndarray of bool, (views,)
            Views that count.
        """
        aside = None
        if self._sample is not None and (self.probing or not self._solver.pull(self._shape)):
            there = motion.then(found.motion).magnification / self._start.magnification
            told = valid_views & (found.sigma[:, 2] > 0)
            sigma = np.where(told, found.sigma[:, 2], np.inf)
            aside = self._sample.aside(np.log(there), sigma, self._solver.spread)
        self.displaced = aside is not None
        return aside

    def held(self, motion: Motion, found: Registered) -> Motion:
        """Pull magnifications to those expected, where registration did not.

        Parameters
        ----------
        motion : Motion
            With what was found.
        found : Registered
            Tells standard errors.
        """
        jitter, pull = self._solver.jitter(self._shape), self._solver.pull(self._shape)
        if not (self._scale and (jitter or self.probing)):
            return motion
        expected, sigma = np.log(self._start.magnification), found.sigma[:, 2]
        logarithm = np.log(motion.magnification) - expected
        if jitter:
            pulled = held(logarithm, sigma, jitter)
        else:
            pulled = logarithm * pull**2 / (pull**2 + sigma**2)
        return replace(motion, magnification=np.exp(pulled + expected))
