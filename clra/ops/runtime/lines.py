"""Vectors of columns, and lined images, whose lines may be read past their ends: see lanes.clh."""

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clra.ops.runtime import build

# As in lanes.clh.
MARGIN = 16


def lanes(context: cl.Context) -> int:
    """Columns that a work-item handles at a time."""
    return 8 if build.is_cpu(build.device_of(context)) else 2


def line_stride(columns: int) -> int:
    """Elements from one line to the next."""
    return -(-columns // 16) * 16 + 2 * MARGIN


def lined(image: NDArray[np.generic]) -> NDArray[np.float32]:
    """Lined copy of a host image (rows, columns), for :func:`to_device`."""
    rows, columns = image.shape
    out = np.zeros((rows, line_stride(columns)), np.float32)
    out[:, MARGIN : MARGIN + columns] = image
    return out
