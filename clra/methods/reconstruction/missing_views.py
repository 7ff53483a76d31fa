"""Views that Katsevich's method needs and a scan lacks, or that are rejected."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.model.helix.fit import fit_helices
from clra.model.helix.gaps import completed
from clra.model.scan import Scan

Views = NDArray[np.int64]


def without_gaps(scan: Scan, valid_views: NDArray[np.bool_] | None = None) -> Scan:
    """Put what lies between the views beside it in place of each view that helices lack.

    Parameters
    ----------
    scan : Scan
        Along one or more helices, free of motion.
    valid_views : ndarray of bool, (views,), optional
        Views to keep, all by default.

    Returns
    -------
    Scan
        Line integrals, of more views than `scan` if some are missing, of fewer if some repeat each
        other; as it is if nothing is to be done. At an end of a helix, where there is no view on
        one side, those of the other.

    Raises
    ------
    InputError
        If the trajectory is no helix, or no view of one of several is valid.
    """
    geometry, views = completed(scan.geometry)
    helices = [part for part, _ in fit_helices(geometry)]
    if valid_views is not None:
        views = np.where((views >= 0) & valid_views[views], views, -1)
    if np.array_equal(views, np.arange(scan.views)):
        return scan
    return Scan(_Filled(scan, views, helices), geometry, name=scan.name, mask=scan.mask)


class _Filled:
    """Line integrals (views, rows, columns) with gaps closed, as they are read.

    Parameters
    ----------
    scan : Scan
        What there is.
    views : ndarray of int
        Of each view its number in `scan`, or -1.
    helices : iterable of slice
        Views whose neighbours look from nearly the same place.
    """

    def __init__(self, scan: Scan, views: Views, helices: Iterable[slice]) -> None:
        self.shape = (len(views), *scan.geometry.shape)
        self._scan = scan
        self._views = views
        # Of each missing view: the views of the scan before and after, and the latter's weight.
        self._beside: dict[int, tuple[int, int, float]] = {}
        for part in helices:
            here = np.arange(part.start, part.stop)
            kept = here[views[part] >= 0]
            if not len(kept):
                raise InputError(
                    f"valid_views: found none of the views {part.start} to {part.stop - 1}, "
                    "expected at least one of each helix"
                )
            for view in here[views[part] < 0]:
                after = int(np.searchsorted(kept, view))
                near = kept[max(after - 1, 0)], kept[min(after, len(kept) - 1)]
                weight = (view - near[0]) / (near[1] - near[0]) if near[0] < near[1] else 0.0
                self._beside[int(view)] = (int(views[near[0]]), int(views[near[1]]), float(weight))

    def __getitem__(self, views: slice) -> NDArray[np.float32]:
        chosen = range(*views.indices(self.shape[0]))
        images = np.empty((len(chosen), *self.shape[1:]), np.float32)
        there = self._views[views]
        kept = there >= 0
        if kept.any():
            start, stop = int(there[kept][0]), int(there[kept][-1]) + 1
            images[kept] = self._scan.read(start, stop)[there[kept] - start]
        for index in np.flatnonzero(~kept):
            before, after, weight = self._beside[chosen[index]]
            images[index] = (1 - weight) * self._scan.read(before, before + 1)[0]
            images[index] += np.float32(weight) * self._scan.read(after, after + 1)[0]
        return images
