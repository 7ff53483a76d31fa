"""Lined images, whose lines may be read past their ends: see vectors.clh."""

import numpy as np
from numpy.typing import NDArray

# As in vectors.clh.
MARGIN = 16


def line_stride(columns: int) -> int:
    """Elements from one line to the next."""
    return -(-columns // 16) * 16 + 2 * MARGIN


def lined(image: NDArray[np.generic]) -> NDArray[np.float32]:
    """Lined copy of a host image (rows, columns), for :func:`to_device`."""
    rows, columns = image.shape
    out = np.zeros((rows, line_stride(columns)), np.float32)
    out[:, MARGIN : MARGIN + columns] = image
    return out
