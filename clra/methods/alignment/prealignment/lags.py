"""Lags at which profiles fit each other, by trying all of them."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_TINY = np.finfo(float).tiny


def best_lags(
    first: Floats, second: Floats, expected: NDArray[np.int_], least: int, *, gain: bool = False
) -> Floats:
    """Return the lags at which pairs of profiles fit each other best.

    Parameters
    ----------
    first, second : ndarray, (pairs, n)
        Profiles.
    expected : ndarray of int, (pairs,)
        Lags that all are tried around.
    least : int
        Pixels that have to overlap.
    gain : bool
        Whether the two may differ by a factor.

    Returns
    -------
    ndarray, (pairs,)
        How much farther what the first shows is found in the second, to a part of a pixel.
    """
    pairs, n = first.shape
    lags = np.arange(least - n, n - least + 1)
    cost = np.full((len(lags), pairs), np.inf)
    index = np.arange(n)
    for k, lag in enumerate(lags):
        at = index + (lag + expected)[:, None]
        seen = (at >= 0) & (at < n)
        there = np.where(seen, np.take_along_axis(second, np.clip(at, 0, n - 1), axis=1), 0)
        here = np.where(seen, first, 0)
        own, other, both = (here**2).sum(axis=1), (there**2).sum(axis=1), (here * there).sum(axis=1)
        # Relative to what is compared: air fits air at any lag.
        if gain:
            found = 1 - both * np.abs(both) / np.maximum(own * other, _TINY)
        else:
            found = (own + other - 2 * both) / np.maximum(own + other, _TINY)
        enough = seen.sum(axis=1) >= least
        cost[k, enough] = found[enough]
    best, pair = cost.argmin(axis=0), np.arange(pairs)
    lower, here, higher = (cost[np.clip(best + k, 0, len(lags) - 1), pair] for k in (-1, 0, 1))
    with np.errstate(invalid="ignore"):
        bend = lower - 2 * here + higher
    curved = np.isfinite(bend) & (bend > 0)
    slope = np.where(curved, lower - higher, 0.0)
    part = 0.5 * slope / np.where(curved, bend, 1.0)
    return np.asarray(lags[best] + np.clip(part, -0.5, 0.5) + expected)
