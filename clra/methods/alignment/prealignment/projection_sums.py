"""Sums over the rows of each radiograph, within a window that follows the sample."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clra.methods.truncation import AT_BORDER
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

# Columns at each border that have to be empty.
_BORDER = 2
# Where the mean profile ends, as a part of its largest value, and pixels that are added there; of
# the views, those that a profile's pixel has to be a mean of.
_END, _ROOM, _SHARED = 0.02, 2, 0.2
_ROUNDS = 4  # of finding the window, which moves the centres that it is placed by


@dataclass(frozen=True)
class ProjectionSums:
    """Sums over the columns of each radiograph; pixels are the radiographs'.

    Attributes
    ----------
    profiles : ndarray, (views, columns)
        Means over the rows, of all columns.
    mass : ndarray, (views, rows)
        Sum of each row within the window.
    moment : ndarray, (views, rows)
        Sum of each row's pixels times their columns, counted from `centre`.
    centre : ndarray, (views,)
        Column of the view's centre of mass.
    half_width : float
        Of the sample, about its centre of mass, as far as any view shows it.
    whole : ndarray of bool, (views,)
        Whether the sample lies between the detector's left and right border.
    """

    profiles: Floats
    mass: Floats
    moment: Floats
    centre: Floats
    half_width: float
    whole: NDArray[np.bool_]

    def of(self, views: NDArray[np.bool_]) -> "ProjectionSums":
        """Return the sums of some views."""
        arrays = (self.profiles, self.mass, self.moment, self.centre)
        profiles, mass, moment, centre = (values[views] for values in arrays)
        return replace(
            self,
            profiles=profiles,
            mass=mass,
            moment=moment,
            centre=centre,
            whole=self.whole[views],
        )


def projection_sums(
    stream: Stream, radiographs: Radiographs, valid_views: NDArray[np.bool_]
) -> ProjectionSums | None:
    """Sum radiographs up.

    Parameters
    ----------
    stream : Stream
        Memory budget, and whom to tell how far it is.
    radiographs : Radiographs
        All are read twice.
    valid_views : ndarray of bool, (views,)
        Views that tell where the sample ends.

    Returns
    -------
    ProjectionSums or None
        None if no more than half of the views show the sample between both borders.
    """
    columns = radiographs.shape[2]
    profiles = radiographs.tabulated(stream, _profiles, "pre-alignment: reading")
    left, right = profiles[:, :_BORDER].mean(axis=1), profiles[:, -_BORDER:].mean(axis=1)
    at_border = np.maximum(left, right)
    level = float(np.median(profiles[valid_views].max(axis=1)))
    inside = valid_views & (at_border < AT_BORDER * level)
    if level <= 0 or 2 * inside.sum() <= valid_views.sum():
        return None
    # Air is not quite empty: flats are of another time, and what scatters is everywhere.
    first, last = np.median(left[inside]), np.median(right[inside])
    air = np.linspace(first, last, columns)
    profiles -= air
    centre, half_width = _window(profiles, inside)
    sums = radiographs.tabulated(
        stream, _RowSums(air, centre, half_width), "pre-alignment: summing"
    )
    mass, moment = (np.ascontiguousarray(sums[:, k]) for k in (0, 1))
    within = (centre >= half_width) & (centre <= columns - 1 - half_width)
    whole = inside & within
    if 2 * whole.sum() <= valid_views.sum():
        return None
    return ProjectionSums(profiles, mass, moment, centre, half_width, whole)


def _profiles(images: NDArray[np.float32], views: slice) -> Floats:
    return np.asarray(images.mean(axis=1, dtype=np.float64))


@dataclass(frozen=True)
class _RowSums:
    """Sums up the rows of some views within their windows: mass and moment, (n, 2, rows)."""

    air: Floats
    centre: Floats
    half_width: float

    def __call__(self, images: NDArray[np.float32], views: slice) -> Floats:
        place = np.arange(images.shape[2]) - self.centre[views, None]
        # Its ends move by parts of a pixel.
        weight = np.clip(self.half_width + 0.5 - np.abs(place), 0, 1)
        above_air = images - self.air
        moments = (np.einsum("vrc,vc->vr", above_air, w) for w in (weight, weight * place))
        return np.stack(list(moments), axis=1)


def _window(profiles: Floats, inside: NDArray[np.bool_]) -> tuple[Floats, float]:
    """Centre of mass of each profile, and the half width of all about theirs."""
    columns = profiles.shape[1]
    at = np.arange(columns)
    positive = np.maximum(profiles, 0.0)
    centre = (positive @ at) / np.maximum(positive.sum(axis=1), np.finfo(float).tiny)
    around, half_width = np.arange(-columns, columns + 1), float(columns)
    for _ in range(_ROUNDS):
        total, count = np.zeros((2, len(around)))
        for profile, middle in zip(profiles[inside], centre[inside], strict=True):
            there = around + middle
            seen = (there >= 0) & (there <= columns - 1)
            total[seen] += np.interp(there[seen], at, profile)
            count += seen
        mean = np.where(count >= _SHARED * inside.sum(), total / np.maximum(count, 1), 0.0)
        half_width = float(np.abs(around[mean > _END * mean.max()]).max() + _ROOM)
        place = at - centre[:, None]
        weight = np.clip(half_width + 0.5 - np.abs(place), 0, 1)
        mass = (profiles * weight).sum(axis=1)
        usable = mass > 0
        step = (profiles * weight * place).sum(axis=1)[usable] / mass[usable]
        centre[usable] += step
    return np.clip(centre, 0, columns - 1), half_width
