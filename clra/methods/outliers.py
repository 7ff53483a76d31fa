"""Views whose registration failed: blank, saturated, or not of this sample."""

import numpy as np
from numpy.typing import NDArray

from clra.model.motion import Motion

Floats = NDArray[np.float64]

# A view is not believed if its correlation lies this many robust standard deviations, and at least
# this much, below the others'.
_DEVIATIONS, _LEAST = 5.0, 0.1


def outliers(correlation: Floats) -> NDArray[np.bool_]:
    """Find the views that fit their re-projection far worse than the others do.

    Parameters
    ----------
    correlation : ndarray, (views,)
        Of each measured radiograph with its simulated twin, after registration.

    Returns
    -------
    ndarray of bool, (views,)
    """
    middle = np.median(correlation)
    spread = 1.4826 * np.median(np.abs(correlation - middle))
    return np.asarray(correlation < middle - max(_DEVIATIONS * spread, _LEAST))


def from_neighbours(motion: Motion, weak: NDArray[np.bool_]) -> Motion:
    """Replace the motion of weak views by what lies between their neighbours'.

    Parameters
    ----------
    motion : Motion
        Of all views.
    weak : ndarray of bool, (views,)
        Views not to be believed; not all of them.

    Returns
    -------
    Motion
        Linear in view number across the weak views, unchanged elsewhere.
    """
    if not weak.any():
        return motion
    views = np.arange(motion.views)
    good = views[~weak]

    def filled(values: Floats) -> Floats:
        return np.interp(views, good, values[good])

    return Motion(
        shift_u=filled(motion.shift_u),
        shift_v=filled(motion.shift_v),
        magnification=filled(motion.magnification),
    )
