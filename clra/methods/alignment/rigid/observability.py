"""Which parameters of a rigid motion a scan can tell; the others are held."""

import numpy as np
from numpy.typing import NDArray

from clra.findings import Finding
from clra.model.rigid.rigid_motion import RigidMotion

Floats = NDArray[np.float64]

# What each parameter is called, its unit, and how many units a millimetre or a radian has.
_NAMES = {
    2: ("translation along the beam", "mm", 1.0),
    3: ("rotation about u", "degrees", float(np.degrees(1))),
    4: ("rotation about v", "degrees", float(np.degrees(1))),
    5: ("rotation about the beam", "degrees", float(np.degrees(1))),
}
# Part of a parameter that has to be kept for it to count as seen.
_SEEN = 0.5


def held(
    motion: RigidMotion, sigma: Floats, valid_views: NDArray[np.bool_], free: tuple[int, ...]
) -> RigidMotion:
    """Pull what a scan hardly tells of a motion to its mean over the views.

    Each parameter but the shifts is expected to vary by as much as what was found exceeds its
    standard errors; of what is found the part s^2 / (s^2 + sigma^2) is the most probable. A finding
    names the parameters that are held by more than half.

    Parameters
    ----------
    motion : RigidMotion
        As found.
    sigma : ndarray, (views, 6)
        Its standard errors without any prior [mm, rad].
    valid_views : ndarray of bool, (views,)
        Views to go by.
    free : tuple of int
        Parameters that were estimated.
    """
    table = motion.table
    for parameter in set(free) & set(_NAMES):
        column = table[valid_views, parameter]
        if len(column) < 2:
            continue
        found, error = float(column.var()), float(np.mean(sigma[valid_views, parameter] ** 2))
        kept = max(0.0, 1 - error / found) if found > 0 else 0.0
        middle = column.mean()
        table[:, parameter] = middle + kept * (table[:, parameter] - middle)
        if kept < _SEEN:
            name, unit, scale = _NAMES[parameter]
            spread, told = scale * found**0.5, scale * error**0.5
            Finding(
                "not-observed",
                f"the {name} is not told from none: it varies by {spread:.2g} {unit}, its standard "
                f"error is {told:.2g}; {100 * kept:.0f} % of it are kept",
                severity="info",
                measured={"spread": spread, "sigma": told, "kept": kept},
            ).record()
    return motion.with_table(table)
