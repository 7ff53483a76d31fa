"""Views that are rejected: blank, saturated, or not of this sample."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial import KDTree

from clra.model.motion import Motion
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

# A view is rejected if its correlation lies this many robust standard deviations, and at least
# this much, below the others'; where all others lack little to 1, ten times what they lack will do.
# In a stack of spheres, alike from everywhere, a wrong frame lacks 20 to 30 times as much; views of
# a porous sample that are in order, twice.
_DEVIATIONS, _LEAST, _LACK = 5.0, 0.1, 10.0
# A radiograph is odd before anything is known of the sample if its mean or its contrast differs
# from the others' by this part of it: the noise of a dark frame leaves streaks in the first volume
# that cost twice the error of all other views; a wrong frame hardly shows.
_ODD = 0.3
# Neighbours in time that the ends of a scan, which look past the sample, are compared with.
_NEIGHBOURS = 9
# Views that take over the weight of one that is left out: those around it on a space-filling
# lattice, where 4 leave the worst of six choices 10 % more error in u than no gap would, 6 leave
# 5 %, 10 no less; on a helix nearly all goes to the two beside it. And the most that each takes: a
# long gap stays a gap rather than become streaks of the views beside it.
_NEIGHBOURS, _MOST = 6, 1.0


def unusable_radiographs(stream: Stream, radiographs: Radiographs) -> NDArray[np.bool_]:
    """Find blank, dark and saturated radiographs by their pixels alone.

    Parameters
    ----------
    stream : Stream
        Memory budget.
    radiographs : Radiographs
        Line integrals at any resolution; all are read once.

    Returns
    -------
    ndarray of bool, (views,)
        Where the mean or the standard deviation of the pixels is far from those of all views and
        from those of the views before and after as well. Fewer than half of them.
    """
    views = radiographs.shape[0]
    sums = np.empty((2, views))
    for chunk in stream.chunks(views, radiographs.view_bytes):
        sums[:, chunk] = sums_of(radiographs.read(chunk))
    return odd(sums)


def sums_of(images: NDArray[np.float32]) -> Floats:
    """Return mean and standard deviation of each of some images, (2, views)."""
    axes = (1, 2)
    return np.stack([images.mean(axes, dtype=np.float64), images.std(axes, dtype=np.float64)])


def odd(sums: Floats) -> NDArray[np.bool_]:
    """Find what :func:`unusable_radiographs` does from what :func:`sums_of` gives.

    Parameters
    ----------
    sums : ndarray, (2, views)
        Of views in order; they need not be all.
    """
    found = np.zeros(sums.shape[1], np.bool_)
    for values in sums:
        near = median_filter(values, size=_NEIGHBOURS, mode="nearest")
        least = _ODD * abs(float(np.median(values)))
        found |= _far(values, np.median(values), least) & _far(values, near, least)
    return found if found.sum() < len(found) / 2 else np.zeros(len(found), np.bool_)


def _far(values: Floats, expected: Floats | np.floating, least: float) -> NDArray[np.bool_]:
    """Whether values differ from what is expected more than twice as much as nine of ten do."""
    aside = np.abs(values - expected)
    return np.asarray(aside > max(2 * float(np.quantile(aside, 0.9)), least))


def outliers(correlation: Floats) -> NDArray[np.bool_]:
    """Find the views that fit their re-projection far worse than the others do.

    Parameters
    ----------
    correlation : ndarray, (views,)
        Of each measured radiograph with its simulated counterpart, after registration.

    Returns
    -------
    ndarray of bool, (views,)
    """
    middle = np.median(correlation)
    spread = 1.4826 * np.median(np.abs(correlation - middle))
    least = min(_LEAST, _LACK * (1 - middle))
    return np.asarray(correlation < middle - max(_DEVIATIONS * spread, least))


def neighbour_weights(source: Floats, valid_views: NDArray[np.bool_]) -> Floats:
    """Hand the weight of views that are left out of a reconstruction on to those beside them.

    Without that a gap in the directions draws the volume, and with it the motions of all others
    that are registered with it, aside.

    Parameters
    ----------
    source : ndarray, (views, 3)
        Positions of the source [mm]; views beside each other look from nearly the same.
    valid_views : ndarray of bool, (views,)
        Views to reconstruct from, at least one.

    Returns
    -------
    ndarray, (views,)
        Weights: 0 for views left out, 1 to 2 for the others, by the inverse squared distance.
    """
    weights = valid_views.astype(np.float64)
    neighbours = np.flatnonzero(valid_views)
    if len(neighbours) == len(valid_views):
        return weights
    count = min(_NEIGHBOURS, len(neighbours))
    distance, nearest = KDTree(source[neighbours]).query(
        source[~valid_views], k=range(1, count + 1)
    )
    near = 1 / np.maximum(distance, np.finfo(np.float32).eps * np.abs(source).max()) ** 2
    taken = np.zeros(len(neighbours))
    np.add.at(taken, nearest, near / near.sum(axis=1, keepdims=True))
    weights[neighbours] += np.minimum(taken, _MOST)
    return weights


def from_neighbours(motion: Motion, rejected: NDArray[np.bool_]) -> Motion:
    """Replace the motion of rejected views by what lies between their neighbours'.

    Parameters
    ----------
    motion : Motion
        Of all views.
    rejected : ndarray of bool, (views,)
        Views rejected; not all of them.

    Returns
    -------
    Motion
        Linear in view number across the rejected views, unchanged elsewhere.
    """
    if not rejected.any():
        return motion
    views = np.arange(motion.views)
    good = views[~rejected]

    def filled(values: Floats) -> Floats:
        return np.interp(views, good, values[good])

    return Motion(
        shift_u=filled(motion.shift_u),
        shift_v=filled(motion.shift_v),
        magnification=filled(motion.magnification),
        cause=motion.cause,
    )
