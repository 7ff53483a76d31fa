"""Shifts along v from the rows' sums: along the axis all views of a sample show the same mass.

In a parallel beam the sum over a row of a radiograph is the mass of the sample at that height,
whatever the angle; in a cone beam nearly so. Neighbours are matched first, one after the other,
then all views to their mean.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.prealignment.lags import best_lags

Floats = NDArray[np.float64]

# Rows of the profiles that are matched by trying all lags, at most; the part of them that has to
# overlap, and the fewest.
_SEARCHED, _OVERLAP, _FEWEST = 128, 0.25, 8
# Rows at the detector's borders that do not count.
_BORDER = 2
# Gauss-Newton steps, the longest and the one that ends them [pixel].
_STEPS, _LONGEST, _SMALLEST = 30, 2.0, 1e-3


@dataclass(frozen=True)
class ProfileShifts:
    """What matching found.

    Attributes
    ----------
    shift : ndarray, (views,)
        Toward higher rows, mean 0 over the views that count [pixel].
    difference : ndarray, (views,)
        Shift by the upper half of what tells shifts minus that by the lower half [pixel].
    stretch : ndarray, (views,)
        By which the profile is longer than the mean one, a part of 1.
    before, after : float
        Root mean square of what their mean leaves of the profiles without any shift, and with
        these.
    """

    shift: Floats
    difference: Floats
    stretch: Floats
    before: float
    after: float


def profile_shifts(mass: Floats, axis_row: Floats, chosen: NDArray[np.bool_]) -> ProfileShifts:
    """Match the profiles of all views.

    Parameters
    ----------
    mass : ndarray, (views, rows)
        Sums of the rows.
    axis_row : ndarray, (views,)
        Row in which one point of the axis is seen, if nothing moved.
    chosen : ndarray of bool, (views,)
        Views whose mass is complete: the mean is theirs.

    Returns
    -------
    ProfileShifts
    """
    shift = _chained(mass, axis_row)
    shift -= np.median(shift[chosen])
    before = _mismatch(mass, axis_row, chosen)
    difference = np.zeros(len(mass))
    for _ in range(_STEPS):
        step, difference = _step(mass, axis_row + shift, chosen)
        shift = shift + step
        if np.abs(step[chosen]).max() < _SMALLEST:
            break
    after = _mismatch(mass, axis_row + shift, chosen)
    stretch = _stretch(mass, axis_row + shift, chosen)
    return ProfileShifts(shift - shift[chosen].mean(), difference, stretch, before, after)


def _chained(mass: Floats, axis_row: Floats) -> Floats:
    """Shifts from one view to its neighbour along the axis, added up."""
    views, rows = mass.shape
    factor = -(-rows // _SEARCHED)
    kept = rows // factor
    binned = mass[:, : kept * factor].reshape(views, kept, factor).mean(axis=2)
    order = np.argsort(np.rint(axis_row), kind="stable")
    expected = np.diff(axis_row[order]) / factor
    whole = np.rint(expected).astype(int)
    least = max(_FEWEST, round(_OVERLAP * kept))
    lag = best_lags(binned[order[:-1]], binned[order[1:]], whole, least)
    step = lag - expected
    shift = np.zeros(views)
    shift[order[1:]] = factor * np.cumsum(step)
    return shift


def _composite(mass: Floats, row: Floats, chosen: NDArray[np.bool_]) -> tuple[Floats, Floats, int]:
    """Mean profile along the axis, how many views it is the mean of, and its first position."""
    rows = mass.shape[1]
    first = int(np.floor(-row.max())) - 1
    along = np.arange(first, int(np.ceil(rows - row.min())) + 2)
    values, seen = _sampled(mass[chosen], along + row[chosen, None])
    count = seen.sum(axis=0)
    return values.sum(axis=0) / np.maximum(count, 1), count.astype(np.float64), first


def _sampled(profiles: Floats, at: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Interpolate each profile at its positions, 0 outside; and where they are inside."""
    last = profiles.shape[1] - 1
    seen = (at >= 0) & (at <= last)
    left = np.clip(np.floor(at).astype(int), 0, last - 1)
    part = at - left
    lower = np.take_along_axis(profiles, left, axis=1)
    upper = np.take_along_axis(profiles, left + 1, axis=1)
    return np.where(seen, (1 - part) * lower + part * upper, 0.0), seen


def _fitted(
    mass: Floats, row: Floats, chosen: NDArray[np.bool_]
) -> tuple[Floats, Floats, Floats, Floats]:
    """Mean profile and its slope where each view's rows are, what is left, and weights."""
    mean, count, first = _composite(mass, row, chosen)
    slope = np.gradient(mean)
    at = np.arange(mass.shape[1]) - row[:, None] - first
    along = np.arange(len(mean))
    there, slope, count = (np.interp(at, along, values) for values in (mean, slope, count))
    weight = np.clip((count - 1) / 3, 0, 1)
    weight[:, :_BORDER] = weight[:, -_BORDER:] = 0.0
    # Intensities drift: masses are compared up to a factor.
    gain = (weight * mass * there).sum(axis=1) / np.maximum((weight * there**2).sum(axis=1), 1e-30)
    return there, slope, mass / np.maximum(gain, 1e-3)[:, None] - there, weight


def _step(mass: Floats, row: Floats, chosen: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Gauss-Newton step of each view to the mean, and that of its upper minus its lower half."""
    there, slope, left, weight = _fitted(mass, row, chosen)
    # What a change of the factor would explain as well says nothing of the shift.
    energy = np.maximum((weight * there**2).sum(axis=1, keepdims=True), 1e-30)
    telling = slope - there * (weight * slope * there).sum(axis=1, keepdims=True) / energy
    told = weight * telling**2
    share = np.cumsum(told, axis=1) / np.maximum(told.sum(axis=1, keepdims=True), 1e-30)

    def stepped(part: Floats) -> Floats:
        w = weight * part
        square = (w * telling**2).sum(axis=1)
        found = -(w * telling * left).sum(axis=1) / np.maximum(square, 1e-30)
        return np.asarray(np.clip(found, -_LONGEST, _LONGEST))

    lower = (share <= 0.5).astype(np.float64)
    return stepped(np.ones_like(lower)), stepped(1 - lower) - stepped(lower)


def _stretch(mass: Floats, row: Floats, chosen: NDArray[np.bool_]) -> Floats:
    """Stretch of each view's profile, fitted together with a shift and a factor."""
    there, slope, left, weight = _fitted(mass, row, chosen)
    place = np.arange(mass.shape[1]) - (mass.shape[1] - 1) / 2
    design = np.stack([-slope * place, -slope, there], axis=2)
    normal = np.einsum("vr,vri,vrj->vij", weight, design, design)
    right = np.einsum("vr,vri,vr->vi", weight, design, left)
    found = np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ right[:, :, None]
    return np.asarray(found[:, 0, 0])


def _mismatch(mass: Floats, row: Floats, chosen: NDArray[np.bool_]) -> float:
    """Root mean square of what the mean profile leaves of the chosen views'."""
    _, _, left, weight = _fitted(mass, row, chosen)
    left, weight = left[chosen], weight[chosen]
    return float(np.sqrt((weight * left**2).sum() / max(weight.sum(), 1.0)))
