"""Samples that are wider than what the detector sees of them, as far as radiographs tell."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.rejected_views import odd, sums_of
from clra.model.geometry import ConeBeamGeometry
from clra.model.sampling.field_of_view import is_offset, side_distances
from clra.ops.streaming.radiographs import Radiographs

# Views that are looked at, and the part of the largest line integral, as means over rows, that may
# be left at a border. Scatter and unevenness of the open beam leave one or two per cent; a sample
# with less than 3 beyond suffers as little.
_PROBED, AT_BORDER = 24, 0.03
# Part of the views that may show more at a border.
_OFTEN = 0.5
# Part of the columns, at each side, that a wider sample's extent is fitted to: of a tenth to a
# quarter the extents differ by a few per cent. And the least and the most that it may reach beyond
# each side, as parts of the columns.
_FITTED, _LEAST_REACH, _MOST_REACH = 0.15, 0.02, 1.0


def profiles(radiographs: Radiographs, views: slice, rows: slice) -> NDArray[np.float64]:
    """Return means over rows of a few radiographs, (n, columns).

    Parameters
    ----------
    radiographs : Radiographs
        Of these, any that differ much in mean or contrast say nothing and are left out.
    views : slice
        To choose from.
    rows : slice
        To average.
    """
    chosen = np.arange(views.start, views.stop)
    return _probed(radiographs, chosen, lambda image: image[rows].mean(axis=0, dtype=np.float64))


def extension(
    radiographs: Radiographs,
    geometry: ConeBeamGeometry,
    valid_views: NDArray[np.bool_] | None = None,
) -> float:
    """Return how far a sample that is wider than the detector reaches beyond it.

    Parameters
    ----------
    radiographs : Radiographs
        A few are read, the first time.
    geometry : ConeBeamGeometry
        Of the radiographs: an offset detector always cuts the sample on its near side, so that only
        the other side counts.
    valid_views : ndarray of bool, (views,), optional
        Views to look at; all by default.

    Returns
    -------
    float
        Part of the detector's columns, from the circular cylinder about the axis whose squared
        chords fall as those of the outermost columns do; 0 if nothing is truncated.
    """
    if radiographs.extension is None:
        views = np.arange(geometry.views)[slice(None) if valid_views is None else valid_views]
        at_border, most = _border_values(radiographs, geometry, views)
        wider = at_border > AT_BORDER * most
        radiographs.extension = _reach(radiographs, geometry, views) if wider else 0.0
    return radiographs.extension


def truncated(radiographs: Radiographs, geometry: ConeBeamGeometry) -> str:
    """Return a warning if the sample reaches beyond the left or right border of the detector.

    Parameters
    ----------
    radiographs, geometry
        As :func:`extension` takes them.

    Returns
    -------
    str
        Empty if all is well.
    """
    at_border, most = _border_values(radiographs, geometry, np.arange(geometry.views))
    if not at_border > AT_BORDER * most:
        return ""
    return (
        f"the sample reaches beyond the detector (line integrals of {at_border:.3g} in its "
        f"outermost columns, {most:.3g} inside): intensities are off, most towards the border of "
        "the field of view"
    )


def falls_outwards(radiographs: Radiographs) -> bool:
    """Tell whether what is left at the border of the detector falls towards it.

    A sample that reaches beyond does; scatter, or flats of another intensity, leave a level.

    Parameters
    ----------
    radiographs : Radiographs
        A few are read.
    """
    views, rows, columns = radiographs.shape
    means = profiles(radiographs, slice(0, views), slice(0, rows))
    inwards = columns // 10
    left, right = means[:, inwards] - means[:, 0], means[:, -1 - inwards] - means[:, -1]
    fall = float(np.quantile(np.maximum(left, right), _OFTEN))
    return fall > AT_BORDER * float(means.max())


def _border_values(
    radiographs: Radiographs, geometry: ConeBeamGeometry, views: NDArray[np.intp]
) -> tuple[float, float]:
    """Typical line integrals in the outermost columns, and the largest anywhere."""
    means = _probed(radiographs, views, lambda image: image.mean(axis=0, dtype=np.float64))
    sides = [side for side, _ in _sides(geometry)]
    # Views that moved far may well show the sample at a border.
    return float(np.quantile(means[:, sides].max(axis=1), _OFTEN)), float(means.max())


def _probed(
    radiographs: Radiographs,
    views: NDArray[np.intp],
    profile: Callable[[NDArray[np.float32]], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Profiles of a few radiographs without any that differ much in mean or contrast."""
    profiles, sums = [], []
    for view in views[np.unique(np.linspace(0, len(views) - 1, _PROBED).astype(int))]:
        image = radiographs.read(slice(view, view + 1))
        profiles.append(profile(image[0]))
        sums.append(sums_of(image)[:, 0])
    return np.stack(profiles)[~odd(np.stack(sums, axis=1))]


def _sides(geometry: ConeBeamGeometry) -> list[tuple[int, float]]:
    """Sides that ought to see past the sample: 0 or -1, and how many columns from the axis."""
    left, right = np.maximum(np.median(side_distances(geometry), axis=0), 0)
    columns = [geometry.columns * float(d) / max(float(left + right), 1e-12) for d in (left, right)]
    sides = [(0, columns[0]), (-1, columns[1])]
    return [max(sides, key=lambda side: side[1])] if is_offset(geometry) else sides


def _reach(radiographs: Radiographs, geometry: ConeBeamGeometry, views: NDArray[np.intp]) -> float:
    """Part of the columns that the fitted cylinder has beyond the detector."""
    squared = _probed(
        radiographs, views, lambda image: np.square(image, dtype=np.float64).mean(axis=0)
    ).mean(axis=0)
    columns = len(squared)
    margin = max(2, round(_FITTED * columns))
    found = []
    for side, edge in _sides(geometry):
        outermost = squared[:margin] if side == 0 else squared[::-1][:margin]
        # (chord)^2 = 4 (r^2 - s^2), s columns from the axis
        slope, value = np.polyfit((edge - 0.5 - np.arange(margin)) ** 2, outermost, 1)
        radius = math.sqrt(max(-value / slope, 0.0)) if slope < 0 else math.inf
        found.append((radius - edge) / columns)
    return float(np.mean(np.clip(found, _LEAST_REACH, _MOST_REACH)))
