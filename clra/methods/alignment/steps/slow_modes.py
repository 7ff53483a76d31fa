"""Slow modes of a motion: what is the same in many views, and takes many iterations to be found."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Half waves over the scan that count as slow, and views that a half wave has at least: drifts are
# slower than 8 cycles a scan, jitter is in all modes alike and hardly in these.
_HALF_WAVES, _VIEWS = 16, 6
# A mode that moves by this part of its step before, or more, is taken to go on with this part.
_SLOWEST = 0.9


def half_waves(views: int) -> int:
    """Return how many cosines count as slow among so many views."""
    return max(1, min(_HALF_WAVES, views // _VIEWS))


def slow_part(values: Floats, weight: Floats, damping: float = 0.0) -> Floats:
    """Fit cosines of few half waves over the scan.

    Parameters
    ----------
    values : ndarray, (views,)
        Of views in order.
    weight : ndarray, (views,)
        Of the squares that the fit minimises; not all zero.
    damping : float
        Part of its square by which a mode that all views tell is damped; others more, the fewer of
        the views tell them.

    Returns
    -------
    ndarray, (views,)
        The fit, at all views.
    """
    views = len(values)
    angle = np.pi * (np.arange(views) + 0.5) / views
    count = half_waves(views)
    basis = np.cos(np.multiply.outer(angle, np.arange(count)))
    basis[:, 1:] *= np.sqrt(2)  # each mode's mean square is 1
    root = np.sqrt(weight)
    design = np.concatenate([basis * root[:, None], np.sqrt(damping * views) * np.eye(count)])
    target = np.concatenate([values * root, np.zeros(count)])
    found, *_ = np.linalg.lstsq(design, target, rcond=None)
    return np.asarray(basis @ found)


def held(logarithm: Floats, sigma: Floats, spread: float) -> Floats:
    """Pull magnifications to what is expected: jitter as far as it is uncertain, drift not at all.

    What an image cannot tell by itself hundreds of them can together. Pulled in each view, a drift
    that iterations find a fifth of at a time would end two thirds too small.

    Parameters
    ----------
    logarithm : ndarray, (views,)
        Of the magnifications.
    sigma : ndarray, (views,)
        Their standard errors, positive.
    spread : float
        Expected standard deviation of their jitter, positive.

    Returns
    -------
    ndarray, (views,)
        The most probable ones.
    """
    drift = slow_part(logarithm, 1 / (spread**2 + sigma**2))
    return np.asarray(drift + (logarithm - drift) * spread**2 / (spread**2 + sigma**2))


class SlowSteps:
    """How far the slow modes of an iteration still have to go, by their last two steps.

    A median over the views does not tell: jitter is found at once, and a drift of a pixel may go
    on by a hundredth of it in each view for a hundred iterations.
    """

    def __init__(self) -> None:
        self._last: float | None = None

    def left(self, step: Floats) -> float:
        """Return the root mean square that is left, for the component with most of it.

        Parameters
        ----------
        step : ndarray, (components, views)
            Of the iteration, as lengths; called once an iteration.
        """
        even = np.ones(step.shape[1])
        size = max(float(np.sqrt(np.mean(slow_part(row, even) ** 2))) for row in step)
        last, self._last = self._last, size
        if last is None:
            return size  # as if half of it were left each time
        contraction = min(size / last, _SLOWEST) if last > 0 else 0.0
        return size * contraction / (1 - contraction)
