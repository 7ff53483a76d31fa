"""Standard errors of an alignment: what registration leaves open, and what held-out views find."""

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct
from scipy.ndimage import uniform_filter1d

from clra.methods.alignment.result import AlignmentResult
from clra.model.schedule import level_factor

Floats = NDArray[np.float64]

# Part of registration's variances that counts. They are larger than what noise causes, as the
# residual holds the reconstruction's errors as well; those displace a view, too, but less.
_REGISTRATION, _REGISTRATION_M = 0.65, 0.5
# Errors are so many times what held-out views find: the rest is in what all parts of the views
# share. More of it in shifts where the sample is truncated, and on less than half a turn. With 0.5
# for the magnification, truncated rocks of 128 columns err by 1.4 to 2.8 times sigma.
_SEEN, _SEEN_OF_TRUNCATED, _SEEN_ON_TILTS = 1.1, (1.8, 1.6, 1.0), 1.6
# Views below which most of what is found is that they hardly predict each other.
_MANY = 100
# Views at each side over which squares of what is found are averaged.
_AROUND = 4
# What is found by mistake where views are predicted at a coarser level than they were aligned at
# [pixel of that level]: 0.004 to 0.006 on circles, 0.01 on space-filling scans.
_COARSE = 0.0065
# Cosines along a scan below which magnifications are slow: four cycles a scan.
_SLOW = 8


def standard_errors(
    aligned: AlignmentResult, left: Floats, level: int, *, truncated: bool, tilts: bool
) -> Floats:
    """Return standard errors that count noise, unconverged modes and bias.

    Parameters
    ----------
    aligned : AlignmentResult
        With registration's own standard errors.
    left : ndarray, (views, 3)
        What registration with predictions of held-out views finds to be left of shift_u, shift_v
        [pixel] and log(magnification), gauge-free; NaN for views that were not held out.
    level : int
        Binning factor at which they were predicted.
    truncated : bool
        Whether the sample reaches beyond the sides of the detector.
    tilts : bool
        Whether the views cover less than half a turn.

    Returns
    -------
    ndarray, as ``aligned.sigma``
        Other columns than the first three are left as they are.
    """
    sigma = aligned.sigma.copy()
    known = np.flatnonzero(np.isfinite(left[:, 0]))
    everywhere = np.arange(len(sigma))
    squares = uniform_filter1d(left[known, :2] ** 2, 2 * _AROUND + 1, axis=0, mode="nearest")
    if level > _last_level(aligned, level):
        squares = np.maximum(squares - (_COARSE * level) ** 2, 0.0)
    factors = np.array([_SEEN, _SEEN, 1.0])
    if truncated:
        factors = np.array(_SEEN_OF_TRUNCATED)
    elif tilts:
        factors[:2] = _SEEN_ON_TILTS
    squares = squares * factors[:2] ** 2 * min(1.0, len(known) / _MANY)
    for axis in range(2):
        seen = np.interp(everywhere, known, squares[:, axis])
        sigma[:, axis] = np.sqrt(_REGISTRATION * sigma[:, axis] ** 2 + seen)
    m = below_four_cycles(left[known, 2])
    sigma[:, 2] = np.sqrt(_REGISTRATION_M * sigma[:, 2] ** 2 + np.mean((factors[2] * m) ** 2))
    # Rejected views have their neighbours' motion, and differ from it as neighbours do.
    motion = aligned.motion
    found = np.stack([motion.shift_u, motion.shift_v, motion.magnification], axis=1)
    lost = ~aligned.valid_views
    for axis in range(3):
        sigma[lost, axis] = np.hypot(sigma[lost, axis], apart_from_neighbours(found[known, axis]))
    return sigma


def _last_level(aligned: AlignmentResult, unknown: int) -> int:
    """Binning factor of the last iteration."""
    return level_factor(aligned.history[-1].level) if aligned.history else unknown


def below_four_cycles(values: Floats) -> Floats:
    """Return values along a scan below four cycles of it, without their mean."""
    waves = dct(values, norm="ortho")
    waves[0] = 0.0
    waves[_SLOW + 1 :] = 0.0
    return np.asarray(idct(waves, norm="ortho"))


def apart_from_neighbours(values: Floats) -> float:
    """Return the RMS of the difference of values and the mean of their two neighbours."""
    if len(values) < 3:
        return 0.0
    return float(np.sqrt(np.mean((values[1:-1] - 0.5 * (values[:-2] + values[2:])) ** 2)))
