"""Views that are rejected: blank, saturated, or not of this sample."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial import KDTree

from clra.findings import Finding
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
# Why a view is rejected.
_DARK = "dark, no beam reached the detector or something was in its way"
_BLANK = "blank or saturated, it shows little of the sample"
_UNLIKE = "brighter or of another contrast than the others"
_FOREIGN = "no fit to the volume of the others: another sample, place or angle"
# Neighbours in time that the ends of a scan, which look past the sample, are compared with.
_NEIGHBOURS = 9
# Views that take over the weight of one that is left out: those around it on a space-filling
# lattice, where 4 leave the worst of six choices 10 % more error in u than no gap would, 6 leave
# 5 %, 10 no less; on a helix nearly all goes to the two beside it. And the most that each takes: a
# long gap stays a gap rather than become streaks of the views beside it.
_SUBSTITUTES, _MOST = 6, 1.0


class Rejections:
    """Which views are rejected in the course of an alignment, and why.

    Parameters
    ----------
    views : int
        Number of views.
    excluded : iterable of int
        Views that the user excludes.

    Attributes
    ----------
    reasons : dict of int to str
        Why a view's pixels alone reject it.
    accepted : ndarray of bool, (views,)
        Whether a registration of the view was accepted so far.
    vouched : ndarray of bool, (views,)
        Views that are known to show the sample: no correlation rejects them.
    """

    def __init__(self, views: int, excluded: Iterable[int] = ()) -> None:
        self.excluded = _marked(excluded, views)
        self.reasons: dict[int, str] = {}
        self.accepted = np.zeros(views, np.bool_)
        self.vouched = np.zeros(views, np.bool_)

    def first(self, stream: Stream, radiographs: Radiographs) -> NDArray[np.bool_]:
        """Return the views that are rejected before anything is registered, (views,)."""
        self.reasons = unusable_radiographs(stream, radiographs)
        return self.excluded | _marked(self.reasons, len(self.excluded))

    def of(self, correlation: Floats) -> NDArray[np.bool_]:
        """Return the views that are rejected for their correlations, or excluded."""
        return self.excluded | (outliers(correlation) & ~self.vouched)

    def settled(
        self, before: Motion, after: Motion, rejected: NDArray[np.bool_], *, first: bool
    ) -> Motion:
        """Return the motion after a registration in which some views were rejected.

        A view whose registration was accepted before stays where it was: that is closer than what
        lies between its neighbours, if the motion is no smooth one. Others get the latter. What the
        first registration accepts, with a volume that is blurred, is not relied on.
        """
        kept = rejected & self.accepted
        motion = from_neighbours(after, rejected & ~kept)
        if not first:
            self.accepted |= ~rejected
        return motion if not kept.any() else _mixed(before, motion, kept)

    def findings(self, rejected: NDArray[np.bool_]) -> list[Finding]:
        """Return what to tell users of the views that are rejected in the end, a reason each."""
        views: dict[str, list[int]] = {}
        for view in np.flatnonzero(rejected).tolist():
            reason = _FOREIGN if not self.excluded[view] else "excluded by the user"
            views.setdefault(self.reasons.get(view, reason), []).append(view)
        return [
            Finding(
                "rejected-views",
                f"{'views' if len(which) > 1 else 'view'} {', '.join(map(str, which))} rejected: "
                f"{reason}",
                severity="info",
                measured={"views": " ".join(map(str, which)), "reason": reason},
            )
            for reason, which in views.items()
        ]


def _marked(which: Iterable[int], views: int) -> NDArray[np.bool_]:
    marked = np.zeros(views, np.bool_)
    marked[list(which)] = True
    return marked


def _mixed(motion: Motion, others: Motion, which: NDArray[np.bool_]) -> Motion:
    """Take the motion of some views, and others' of the rest."""
    return Motion(
        shift_u=np.where(which, motion.shift_u, others.shift_u),
        shift_v=np.where(which, motion.shift_v, others.shift_v),
        magnification=np.where(which, motion.magnification, others.magnification),
        cause=others.cause,
    )


def unusable_radiographs(stream: Stream, radiographs: Radiographs) -> dict[int, str]:
    """Find blank, dark and saturated radiographs by their pixels alone.

    Parameters
    ----------
    stream : Stream
        Memory budget, and whom to tell how far it is.
    radiographs : Radiographs
        Line integrals at any resolution; all are read once.

    Returns
    -------
    dict of int to str
        Views whose mean or standard deviation of the pixels is far from those of all views and from
        those of the views before and after as well, and what they are. Fewer than half of them.
    """
    sums = radiographs.tabulated(stream, _sums_of_each, "looking for blank radiographs").T
    means, deviations = np.median(sums, axis=1)
    return {
        int(view): _DARK
        if sums[0, view] > means
        else _BLANK
        if sums[1, view] < deviations
        else _UNLIKE
        for view in np.flatnonzero(odd(sums))
    }


def sums_of(images: NDArray[np.float32]) -> Floats:
    """Return mean and standard deviation of each of some images, (2, views)."""
    axes = (1, 2)
    return np.stack([images.mean(axes, dtype=np.float64), images.std(axes, dtype=np.float64)])


def _sums_of_each(images: NDArray[np.float32], views: slice) -> Floats:
    return sums_of(images).T


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
    middle = float(np.median(correlation))
    spread = 1.4826 * float(np.median(np.abs(correlation - middle)))

    def lowest(usual: float) -> float:
        return usual - max(_DEVIATIONS * spread, min(_LEAST, _LACK * (1 - usual)))

    low = np.asarray(correlation < lowest(middle))
    # What views at the ends of a scan look at hardly any other sees: all of them fit it worse, and
    # the more so the fewer are valid. Wrong ones are worse than those beside them, too.
    for order in (slice(None), slice(None, None, -1)):
        ends, values = low[order], correlation[order]
        sound = np.convolve(~ends, np.ones(_NEIGHBOURS), "valid") == _NEIGHBOURS
        for view in range(int(sound.argmax()) if sound.any() else 0):
            start = max(0, view - _NEIGHBOURS // 2)
            near = float(np.median(values[start : start + _NEIGHBOURS]))
            ends[view] &= values[view] < lowest(near)
    return low


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
    count = min(_SUBSTITUTES, len(neighbours))
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
