"""Windows by which registration weights the pixels."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError

Floats = NDArray[np.float64]


def tukey(length: int, fraction: float) -> Floats:
    """Window with raised-cosine sides, each `fraction`/2 of the length, sampled mid-pixel."""
    position = (np.arange(length) + 0.5) / length
    return _rise(np.minimum(position, 1 - position) * 2 / fraction)


def registration_window(
    shape: tuple[int, int], margin: float, low_pass: float, mask: ArrayLike | None = None
) -> Floats:
    """Weights of the pixels, 0 to 1.

    Parameters
    ----------
    shape : tuple of int
        (rows, columns).
    margin : float
        Part of height and width, 0.02 to 0.3: the weight is 0 up to half a margin from the border
        or a large masked area, and 1 from one and a half on.
    low_pass : float
        Sigma of the band-pass, pixels: next to masked pixels, weights rise over three of these.
    mask : array_like of bool, optional
        (rows, columns), True where pixels count.

    Returns
    -------
    ndarray of float64, (rows, columns)

    Raises
    ------
    InputError
        If `margin` is out of range, or nothing of the mask is left within it.
    """
    if not 0.02 <= margin <= 0.3:
        raise InputError(f"margin: found {margin}, expected 0.02 to 0.3")
    sides = []
    for length in shape:
        position = (np.arange(length) + 0.5) / length
        sides.append(_rise((np.minimum(position, 1 - position) - 0.5 * margin) / margin))
    weights = np.outer(*sides)
    if mask is not None:
        from scipy.ndimage import distance_transform_edt, gaussian_filter

        counts = np.asarray(mask) != 0
        # Beside a large masked area the blurred mask is 0.7 half a margin inside and 0.95 one and
        # a half inside; single pixels and lines hardly show in it.
        nearby = gaussian_filter(counts.astype(np.float64), margin * min(shape), mode="nearest")
        weights *= _rise((nearby - 0.7) / 0.25)
        if not counts.all():
            weights *= _rise((distance_transform_edt(counts) - 1) / (3 * low_pass))
    if not weights.any():
        raise InputError(f"mask: found no pixel that counts within the margin {margin}")
    return np.asarray(weights)


def _rise(x: Floats) -> Floats:
    """Rise from 0 at 0 to 1 at 1, as a raised cosine."""
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip(x, 0, 1)))


def box(weights: Floats) -> tuple[int, int, int, int]:
    """First row, one past the last, first column, one past the last that count."""
    rows, columns = np.flatnonzero(weights.any(1)), np.flatnonzero(weights.any(0))
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
