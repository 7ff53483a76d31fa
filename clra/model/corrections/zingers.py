"""Zingers: single pixels of single frames that something else than the beam made bright."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

# A zinger's line integral is below all eight of its neighbours' by at least this, ...
_LEAST = 0.3
# ... by so many times the standard deviation of its 24 neighbours, ...
_DEVIATIONS = 2.5
# ... and of what the line integrals of the whole radiograph scatter about those of their neighbours
# (scaled median). Of photon noise with 50 photons a pixel nothing comes near to it: tests count.
_NOISE = 8.0


def replace_zingers(image: Floats) -> int:
    """Replace the zingers of one radiograph of line integrals (rows, columns), in place.

    Each gets the median of its eight neighbours.

    Returns
    -------
    int
        How many were replaced.
    """
    if min(image.shape) < 5:
        return 0
    wide = np.pad(image, 2, mode="reflect")
    row = np.minimum(wide[1:-1, 1:-3], wide[1:-1, 3:-1])
    lowest = np.minimum(row[1:-1], np.minimum(wide[1:-3, 2:-2], wide[3:-1, 2:-2]))
    np.minimum(lowest, np.minimum(row[:-2], row[2:]), out=lowest)
    j, i = np.nonzero(lowest - image > _LEAST)
    if not len(j):
        return 0
    noise = 1.4826 * float(np.median(np.abs(image[::2, 2::2] - image[::2, 1:-1:2]))) / np.sqrt(2)
    near = np.stack([wide[j + down, i + across] for down in range(5) for across in range(5)])
    others = np.delete(near, 12, axis=0)
    beside = near[[6, 7, 8, 11, 13, 16, 17, 18]]
    depth = beside.min(axis=0) - near[12]
    found = depth > np.maximum(_DEVIATIONS * others.std(axis=0), _NOISE * noise)
    image[j[found], i[found]] = np.median(beside[:, found], axis=0)
    return int(found.sum())
