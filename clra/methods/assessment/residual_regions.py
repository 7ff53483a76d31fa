"""Where on the detector, and in which part of a scan, predictions fail."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Floats = NDArray[np.float64]

PARTS = 3
"""Parts of the detector along its rows and along its columns."""
VIEWS = 4
"""Parts of a scan."""


def residual_by_part(
    measured: NDArray[np.float32], simulated: NDArray[np.float32], band: tuple[float, float]
) -> Floats:
    """Return what simulated radiographs leave of measured ones, by part of the detector.

    Parameters
    ----------
    measured, simulated : ndarray, (n, rows, columns)
        Line integrals; the gain between the two is fitted.
    band : (float, float)
        Sigmas of the band-pass, low and high [pixel].

    Returns
    -------
    ndarray, (n, 3, 3)
        Mean square of the difference in each third of the rows and of the columns, as a part of
        the measured radiograph's own mean square.
    """
    m, s = (_in_band(images, band) for images in (measured, simulated))
    gain = np.sum(m * s, axis=(1, 2)) / np.maximum(np.sum(s * s, axis=(1, 2)), 1e-30)
    left = (m - gain[:, None, None] * s) ** 2
    own = np.maximum(np.mean(m**2, axis=(1, 2)), 1e-30)
    parts = [
        np.stack([part.mean(axis=(1, 2)) for part in np.array_split(rows, PARTS, axis=2)], axis=1)
        for rows in np.array_split(left, PARTS, axis=1)
    ]
    return np.asarray(np.stack(parts, axis=1) / own[:, None, None])


def by_part_of_scan(squares: Floats) -> Floats:
    """Return root mean squares over parts of a scan.

    Parameters
    ----------
    squares : ndarray, (views, 3, 3)
        As of :func:`residual_by_part`; NaN for views that were not predicted.

    Returns
    -------
    ndarray, (parts, 3, 3)
        At most four parts of the views, in their order.
    """
    known = squares[np.isfinite(squares[:, 0, 0])]
    blocks = np.array_split(known, min(VIEWS, len(known)))
    return np.array([np.sqrt(block.mean(axis=0)) for block in blocks])


def _in_band(images: NDArray[np.float32], band: tuple[float, float]) -> Floats:
    low, high = ((0.0, sigma, sigma) for sigma in band)
    return np.asarray(gaussian_filter(images, low) - gaussian_filter(images, high), np.float64)
