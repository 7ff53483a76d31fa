"""Slow modes of a rigid alignment: how far they would still go, and how they add up errors."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.steps.slow_modes import half_waves, slow_part

Floats = NDArray[np.float64]

# A mode is taken to go on with at most this part of its last step. Balls on a circle, 128 pixels:
# the second harmonic of the rotation about v, with which the sample shears, goes on with 0.77.
_SLOWEST = 0.8


@dataclass
class SlowExtrapolation:
    """The slow part of an iteration's last steps.

    A reconstruction deforms with slow modes of the motion, so that its re-projections show a part
    of what is left of them only: each step finds 1 - r of it. What is left after a step s is the
    geometric series s (r + r^2 + ...), and what each step gets wrong adds up to 1 / (1 - r).

    Attributes
    ----------
    last : ndarray, (views, parameters), or None
        Slow part of the last step.
    contraction : ndarray, (parameters,), or None
        r, from the last two steps; 0 where they do not agree.
    """

    last: Floats | None = field(default=None)
    contraction: Floats | None = field(default=None)

    def add(self, step: Floats, valid_views: NDArray[np.bool_]) -> None:
        """Take in the next step, (views, parameters), of views of which some are valid."""
        weight = valid_views.astype(np.float64)
        slow = np.stack([slow_part(column, weight) for column in step.T], axis=1)
        if self.last is not None:
            square = np.maximum(np.sum(self.last**2, axis=0), 1e-300)
            self.contraction = np.clip(np.sum(slow * self.last, axis=0) / square, 0.0, _SLOWEST)
        self.last = slow

    def left(self) -> Floats:
        """Return what the steps that were not made would add, (views, parameters) or 0."""
        if self.last is None or self.contraction is None:
            return np.zeros(1)
        return np.asarray(self.last * self.contraction / (1 - self.contraction))

    def growth(self, views: int) -> Floats:
        """Return by how much errors exceed those of one step, (parameters,) or 1."""
        if self.contraction is None:
            return np.ones(1)
        share = half_waves(views) / views
        return np.asarray(np.sqrt(1 + share * ((1 - self.contraction) ** -2 - 1)))
