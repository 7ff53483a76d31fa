"""Shifts along u from centres of mass: of each layer of the sample they are images of one point."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from clra.methods.alignment.prealignment.lags import best_lags
from clra.methods.alignment.prealignment.projection_sums import ProjectionSums

Floats = NDArray[np.float64]

# Layers along the axis, at most, and the fewest rows of each; and the part of the mean mass of a
# layer that tells where it is.
_LAYERS, _ROWS, _LEAST = 48, 4, 0.1
# Part of the columns in which a view that is cut off has to overlap one that is whole.
_OVERLAP = 0.3


@dataclass(frozen=True)
class CentreShifts:
    """What centres of mass tell.

    Attributes
    ----------
    shift : ndarray, (views,)
        Toward higher columns [pixel]. Of views that do not show the whole sample it is a rough
        one, by the profile of the nearest view that does.
    difference : ndarray, (views,)
        Shift by the upper half of the layers' mass minus that by the lower [pixel].
    loss : ndarray, (views,)
        Relative deviation of the view's mass from the mean of what it sees.
    """

    shift: Floats
    difference: Floats
    loss: Floats


def centre_shifts(
    sums: ProjectionSums, axis_column: Floats, slope: Floats, axis_row: Floats, source: Floats
) -> CentreShifts | None:
    """Find the shifts with which the layers' centres of mass are images of points.

    Parameters
    ----------
    sums : ProjectionSums
        Of the radiographs.
    axis_column : ndarray, (views,)
        Column in which the axis is seen, if nothing moved.
    slope : ndarray, (views, 2)
        Columns by which the image of a point at the axis moves for a unit along x and y.
    axis_row : ndarray, (views,)
        Row in which a point of the axis is seen, as far as it is known now.
    source : ndarray, (views, 3)
        Direction of the source, and its height in heights of the detector: near views look alike.

    Returns
    -------
    CentreShifts or None
        None if no layer is seen by two views, or none by a view that shows all of it.
    """
    layers = _layers(sums, axis_row)
    if layers is None:
        return None
    mass, moment, seen = layers
    whole = seen & sums.whole[:, None]
    mean = np.where(whole, mass, 0).sum(axis=0) / np.maximum(whole.sum(axis=0), 1)
    used = seen & (mean > _LEAST * mean.max()) & (mass > 0.5 * mean)
    # Of the variance of a centre: that of the pixels' noise over the mass squared.
    weight = np.where(used, mean**2, 0.0)
    place = sums.centre[:, None] + np.where(used, moment / np.where(used, mass, 1.0), 0.0)
    place -= axis_column[:, None]
    total = weight.sum(axis=1)
    told = sums.whole & (total > 0)
    if not told.any():
        return None
    points = _points(place[told], slope[told], weight[told])
    image = np.einsum("vi,li->vl", slope, points)
    left = place - image
    shift = (weight * left).sum(axis=1) / np.maximum(total, 1e-30)
    left = np.where(used, left - shift[:, None], 0.0)
    share = np.cumsum(weight, axis=1) / np.maximum(total[:, None], 1e-30)
    lower = share <= 0.5
    halves = [
        (weight * part * left).sum(axis=1) / np.maximum((weight * part).sum(axis=1), 1e-30)
        for part in (lower, ~lower)
    ]
    expected = np.where(used, mean, 0.0).sum(axis=1)
    loss = np.where(used, mass, 0.0).sum(axis=1) / np.maximum(expected, 1e-30) - 1
    if not told.all():
        middle = axis_column + slope @ np.average(points, axis=0, weights=mean)
        shift = _by_neighbours(sums.profiles, shift + middle, told, source) - middle
    return CentreShifts(shift, halves[1] - halves[0], loss)


def _by_neighbours(
    profiles: Floats, place: Floats, told: NDArray[np.bool_], source: Floats
) -> Floats:
    """Places of the sample, for views that do not tell it by the nearest that do."""
    known, wanted = np.flatnonzero(told), np.flatnonzero(~told)
    near = known[KDTree(source[known]).query(source[wanted])[1]]
    least = round(_OVERLAP * profiles.shape[1])
    lag = best_lags(profiles[near], profiles[wanted], np.zeros(len(near), int), least, gain=True)
    place = place.copy()
    place[wanted] = place[near] + lag
    return place


def _layers(
    sums: ProjectionSums, axis_row: Floats
) -> tuple[Floats, Floats, NDArray[np.bool_]] | None:
    """Mass and moment of the layers that a view sees, (views, layers), and which these are."""
    rows = sums.mass.shape[1]
    low, high = int(np.floor(-axis_row.max())), int(np.ceil(rows - axis_row.min()))
    count = max(1, min(_LAYERS, (high - low) // _ROWS))
    edges = np.linspace(low, high, count + 1)
    # Integrals from the first row on, between rows linear.
    at = edges + axis_row[:, None] + 0.5
    inside = (at >= 0) & (at <= rows)
    seen = inside[:, :-1] & inside[:, 1:]
    if not (seen.sum(axis=0) > 1).any():
        return None
    values = []
    for of_rows in (sums.mass, sums.moment):
        total = np.concatenate([np.zeros((len(of_rows), 1)), np.cumsum(of_rows, axis=1)], axis=1)
        left = np.clip(np.floor(at).astype(int), 0, rows - 1)
        part = np.clip(at - left, 0, 1)
        lower = np.take_along_axis(total, left, axis=1)
        upper = np.take_along_axis(total, left + 1, axis=1)
        values.append(np.diff((1 - part) * lower + part * upper, axis=1))
    return values[0], values[1], seen


def _points(place: Floats, slope: Floats, weight: Floats) -> Floats:
    """Least squares for the layers' points, (layers, 2), shifts of the views taken out."""
    layers = place.shape[1]
    total = np.maximum(weight.sum(axis=1), 1e-30)
    part = weight / total[:, None]
    left = place - (part * place).sum(axis=1, keepdims=True)
    # Normal equations: W A A' - W A (W A)' / sum W, for each view.
    normal = -np.einsum("vl,vi,vm,vj->limj", weight, slope, part, slope, optimize=True)
    own = np.einsum("vl,vi,vj->lij", weight, slope, slope)
    each = np.arange(layers)
    normal[each, :, each, :] += own
    right = np.einsum("vl,vi,vl->li", weight, slope, left)
    size = 2 * layers
    found = np.linalg.lstsq(normal.reshape(size, size), right.reshape(size), rcond=1e-9)[0]
    return np.asarray(found.reshape(layers, 2))
