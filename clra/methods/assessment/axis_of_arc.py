"""The column of the rotation axis of an arc, by the rays that its views measure twice.

Slices of an arc are sharpest with the detector tilted by some degrees too much. What two views see
along the same line has to agree instead: of a fan each ray with the one that comes back along it.
Of a little less than half a turn of a parallel beam there is no such ray: there the spectrum of the
sinogram decides.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.methods.assessment.sinogram_spectrum import energy_outside
from clra.model.detector_pose import with_detector
from clra.model.geometry import ConeBeamGeometry
from clra.model.sampling.angular_coverage import beside_views, covered, holes
from clra.model.scan import Scan
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

# Rows about the source's height that are averaged: one is noisy, and far from that height the two
# rays of a line in a cone beam are not the same.
_ROWS = 5
# Offsets up to this part of the detector's width are searched, first in steps of this many pixels,
# then ever closer.
_REACH, _STEP, _LEAST_STEP = 0.125, 2.0, 0.02
# Part of the pixels that have to be measured twice; and how much the best agreement has to be
# better than the median of those searched.
_FEWEST, _CONTRAST = 0.002, 1.5
# Views' worth of rays measured twice below which the spectrum decides, of this part of half a turn
# or more: on a synchrotron's scan it was off by 0.3 to 1.1 pixels, where a single pair was by 0.1.
# And its contrast: 5 to 40 without motion, 1.4 to 1.8 with one of +-2 of 96 pixels.
_PAIRS, _HALF_TURN, _SPECTRAL_CONTRAST = 1.0, 0.95 * math.pi, 1.2


def axis_offset(
    stream: Stream, scan: Scan, radiographs: Radiographs | None = None
) -> tuple[float, float]:
    """Find the column of the axis by what is measured twice, or by the sinogram's spectrum.

    Parameters
    ----------
    stream : Stream
        Memory budget, and whom to tell how far it is.
    scan : Scan
        Of half a turn at least, and of a fan rather half a turn and the fan.
    radiographs : Radiographs, optional
        Those of the scan, as somebody else reads them: all are read.

    Returns
    -------
    offset_u : float
        Column of the axis' projection from where the scan's geometry puts it [pixel].
    gain : float
        Squared differences of the rays of a line, or energy outside the spectrum's wedges, at an
        offset of 0, relative to those found.

    Raises
    ------
    InputError
        If hardly any ray is measured twice, or no offset makes them agree.
    """
    radiographs = radiographs or Radiographs(stream, scan, 1)
    # Line integrals at the height of each source.
    middle = np.clip(np.rint(scan.geometry.principal[:, 1]), 0, scan.geometry.rows - 1).astype(int)
    lines = radiographs.tabulated(stream, _MeanRows(middle), "auto-focus: reading")
    cost, contrast = _criterion(scan.geometry)
    reach, step, centre = _REACH * scan.geometry.columns, _STEP, 0.0
    searched = np.arange(-reach, reach + 0.5 * step, step)
    costs = np.array([cost(lines, scan.geometry, offset) for offset in searched])
    if not np.isfinite(costs).any():
        raise InputError(
            f"{scan.name}: found hardly a ray that is measured twice, expected views over half a "
            "turn and the fan to find the axis by"
        )
    centre = float(searched[np.nanargmin(costs)])
    if np.nanmedian(costs) < contrast * np.nanmin(costs) or abs(centre) > reach - step:
        raise InputError(
            f"{scan.name}: found no offset of the axis, up to {reach:.3g} pixels, at which rays "
            "along the same line agree"
        )
    while step > _LEAST_STEP:
        step /= 4
        near = centre + step * np.arange(-5, 6)
        costs = np.array([cost(lines, scan.geometry, offset) for offset in near])
        centre = float(near[np.nanargmin(costs)])
    before = cost(lines, scan.geometry, 0.0)
    return centre, float(before / max(float(np.nanmin(costs)), np.finfo(float).tiny))


def _criterion(
    geometry: ConeBeamGeometry,
) -> tuple[Callable[[Floats, ConeBeamGeometry, float], float], float]:
    """Return what is least at the right offset, and its least contrast."""
    twice = _measured_twice(geometry).sum() / geometry.columns
    if twice < _PAIRS and covered(geometry) >= _HALF_TURN:
        return _outside_the_wedges, _SPECTRAL_CONTRAST
    return _disagreement, _CONTRAST


def _outside_the_wedges(lines: Floats, ideal: ConeBeamGeometry, offset: float) -> float:
    angle, fan = _rays(with_detector(ideal, offset_u=offset))
    return energy_outside(lines, angle, np.median(fan, axis=0), holes(ideal))


def _measured_twice(geometry: ConeBeamGeometry) -> NDArray[np.bool_]:
    """Whether a view looks back along each ray, (views, columns)."""
    angle, fan = _rays(geometry)
    other = (angle[:, None] + np.pi + 2 * fan) % (2 * np.pi)
    # The view before stands for one that is a step further: of half a turn, that is the pair.
    return beside_views(other, holes(geometry), float(np.median(np.diff(np.sort(angle)))))


@dataclass(frozen=True)
class _MeanRows:
    """Means of a few rows of each of some views, (n, columns)."""

    middle: NDArray[np.intp]

    def __call__(self, images: NDArray[np.float32], views: slice) -> Floats:
        first = np.maximum(0, self.middle[views] - _ROWS // 2)
        rows = [image[row : row + _ROWS] for image, row in zip(images, first, strict=True)]
        return np.stack([some.mean(axis=0, dtype=np.float64) for some in rows])


def _disagreement(lines: Floats, ideal: ConeBeamGeometry, offset: float) -> float:
    """Squared difference of the rays of a line, relative to their squares; NaN of too few."""
    geometry = with_detector(ideal, offset_u=offset)
    angle, fan = _rays(geometry)
    order = np.argsort(angle)
    other = (angle[:, None] + np.pi + 2 * fan) % (2 * np.pi)
    inside = _measured_twice(geometry)
    at = np.interp(other, angle[order], np.arange(len(order)), period=2 * np.pi)
    lower = np.floor(at).astype(int) % len(order)
    upper, part = (lower + 1) % len(order), at - np.floor(at)
    seen = np.zeros(other.shape)
    for neighbour, weight in ((lower, 1 - part), (upper, part)):
        view = order[neighbour]
        column = _column_of(fan, view, -fan)
        inside &= (column >= 0) & (column <= lines.shape[1] - 1)
        left = np.clip(np.floor(column).astype(int), 0, lines.shape[1] - 2)
        f = column - left
        seen += weight * ((1 - f) * lines[view, left] + f * lines[view, left + 1])
    if inside.mean() < _FEWEST:
        return float("nan")
    squares = np.sum(lines[inside] ** 2 + seen[inside] ** 2)
    return float(np.sum((lines[inside] - seen[inside]) ** 2) / max(squares, 1e-30))


def _rays(geometry: ConeBeamGeometry) -> tuple[Floats, Floats]:
    """Angle of each source, and of its columns' rays from the way to the axis [rad]."""
    place = np.arange(geometry.columns) - (geometry.columns - 1) / 2
    row = geometry.principal[:, 1] - (geometry.rows - 1) / 2
    middle = geometry.detector + row[:, None] * geometry.v - geometry.source
    ray = middle[:, None, :2] + place[:, None] * geometry.u[:, None, :2]
    x, y = geometry.source[:, 0, None], geometry.source[:, 1, None]
    fan = np.arctan2(-x * ray[..., 1] + y * ray[..., 0], -x * ray[..., 0] - y * ray[..., 1])
    return np.arctan2(x[:, 0], -y[:, 0]) % (2 * np.pi), fan


def _column_of(fan: Floats, view: NDArray[np.intp], wanted: Floats) -> Floats:
    """Column of other views at which their fan has an angle, by the views' tangents."""
    first, last = np.tan(fan[view, 0]), np.tan(fan[view, -1])
    return np.asarray((np.tan(wanted) - first) / (last - first) * (fan.shape[1] - 1))
