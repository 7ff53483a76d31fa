"""Pixels of a detector that may not be used, interpolated from their neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

# Good pixels are looked for within so many pixels along rows, columns and diagonals; those that are
# farther than the first number from any are far.
_NEAR, _REACH = 2, 3
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))


class Patches:
    """Where such pixels are, and the good pixels that stand in for each.

    Along each row, column and diagonal on which there are good pixels on both sides, these are
    interpolated linearly; the results are averaged, weighted by the inverse square of the distance
    of the two. Where there is no such line, good pixels on one side stand in, or else the nearest.

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

    def __init__(self, dead: Mask) -> None:
        columns = dead.shape[1]
        self._pixels = np.flatnonzero(dead)
        self.far = dead & ~_spread(~dead, _NEAR)
        j, i = np.nonzero(dead)
        count = len(self._pixels)
        places = np.zeros((count, 2 * len(_DIRECTIONS)), np.intp)
        paired, single = np.zeros((2, *places.shape))
        for index, step in enumerate(_DIRECTIONS):
            before, after = (_nearest(dead, j, i, step, sign) for sign in (-1, 1))
            left, right = 2 * index, 2 * index + 1
            length = np.hypot(*step)
            for column, (distance, place), (other, _) in (
                (left, before, after),
                (right, after, before),
            ):
                places[:, column] = place
                found = distance > 0
                single[found, column] = 1 / (length * distance[found]) ** 2
                both = found & (other > 0)
                gap = (distance + other)[both]
                paired[both, column] = other[both] / gap / (length * gap) ** 2
        weights = np.where(paired.any(axis=1, keepdims=True), paired, single)
        lost = ~weights.any(axis=1)
        if lost.any():
            from scipy.ndimage import distance_transform_edt

            nearest = distance_transform_edt(dead, return_distances=False, return_indices=True)
            places[lost, 0] = (nearest[0] * columns + nearest[1])[j[lost], i[lost]]
            weights[lost, 0] = 1
        self._places = places
        self._weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
        self.unreliable = _spread(self.far, _NEAR) & dead

    def fill(self, image: NDArray[np.float32]) -> None:
        """Replace the pixels of one radiograph (rows, columns), C-contiguous, in place."""
        flat = image.reshape(-1)
        # A place of weight 0 may hold anything, NaN as well.
        values = np.where(self._weights > 0, flat[self._places], np.float32(0))
        flat[self._pixels] = np.einsum("pk,pk->p", self._weights, values)


def _nearest(
    dead: Mask, j: NDArray[np.intp], i: NDArray[np.intp], step: tuple[int, int], sign: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the steps to the nearest good pixel on a side, 0 if there is none, and its place."""
    rows, columns = dead.shape
    distance, place = np.zeros((2, len(j)), np.intp)
    for k in range(_REACH, 0, -1):
        row, column = j + sign * k * step[0], i + sign * k * step[1]
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        good = inside.copy()
        good[inside] = ~dead[row[inside], column[inside]]
        distance[good] = k
        place[good] = (row * columns + column)[good]
    return distance, place


def _spread(mask: Mask, reach: int) -> Mask:
    """Also the pixels within `reach` of those in a mask, along rows, columns and diagonals."""
    for axis in (0, 1):
        moved = np.moveaxis(mask, axis, 0)
        wide = moved.copy()
        for step in range(1, reach + 1):
            wide[step:] |= moved[:-step]
            wide[:-step] |= moved[step:]
        mask = np.moveaxis(wide, 0, axis)
    return mask
