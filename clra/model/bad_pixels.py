"""Pixels of a detector that may not be used, filled from those beside them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Pixels within which a median stands in; others get the nearest good pixel's value.
_REACH = 2


class Patches:
    """Where such pixels are, and the good pixels that stand in for each.

    The median of the good ones within one pixel, or else within two, or else the nearest.

    Parameters
    ----------
    dead : ndarray of bool, (rows, columns)
        Pixels to fill, not all of them.

    Attributes
    ----------
    far : ndarray of bool, (rows, columns)
        Which are filled from more than two pixels away.
    unreliable : ndarray of bool, (rows, columns)
        `far`, and the pixels to fill around those: what is large is masked as a whole.
    """

    def __init__(self, dead: NDArray[np.bool_]) -> None:
        self._sets: list[tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]] = []
        self.far = dead.copy()
        rows, columns = dead.shape
        for reach in range(1, _REACH + 1):
            j, i = np.nonzero(self.far)
            offsets = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
            near_j, near_i = j[:, None] + offsets[0], i[:, None] + offsets[1]
            inside = (near_j >= 0) & (near_j < rows) & (near_i >= 0) & (near_i < columns)
            near = np.where(inside, near_j * columns + near_i, 0)
            good = inside & ~dead.ravel()[near]
            found = good.any(axis=1)
            self._sets.append(((j * columns + i)[found], near[found], good[found]))
            self.far[j[found], i[found]] = False
        if self.far.any():
            from scipy.ndimage import distance_transform_edt

            nearest = distance_transform_edt(dead, return_distances=False, return_indices=True)
            near = (nearest[0] * columns + nearest[1])[self.far][:, None]
            self._sets.append((np.flatnonzero(self.far), near, np.ones_like(near, dtype=np.bool_)))
        self.unreliable = _spread(self.far, _REACH) & dead

    def fill(self, image: NDArray[np.float32]) -> None:
        """Replace the pixels of one radiograph (rows, columns), C-contiguous, in place."""
        flat = image.reshape(-1)
        for pixels, near, good in self._sets:
            if near.shape[1] == 1:
                flat[pixels] = flat[near[:, 0]]
            elif len(pixels):
                flat[pixels] = np.nanmedian(np.where(good, flat[near], np.nan), axis=1)


def _spread(mask: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Also the pixels within `reach` of those in a mask, along rows, columns and diagonals."""
    for axis in (0, 1):
        moved = np.moveaxis(mask, axis, 0).copy()
        wide = moved.copy()
        for step in range(1, reach + 1):
            wide[step:] |= moved[:-step]
            wide[:-step] |= moved[step:]
        mask = np.moveaxis(wide, 0, axis)
    return mask
