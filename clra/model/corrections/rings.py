"""Ring artefacts: errors of pixels that are the same in all views.

The mean of the radiographs over the views is smooth along the rows, for the sample moves over the
detector; what it has beyond its running median is the detector's, and is subtracted from every
view: Boin & Haibel, "Compensation of ring artefacts in synchrotron tomographic images", Optics
Express 14 (2006), with a median in place of the moving average, so that a large error of one pixel
does not spread to others.
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

# Columns of the running median: rings of up to four pixels are removed. Twice as many take more of
# what is sharp in the sample near the axis.
_WIDTH = 9
# Standard deviation of the Gaussian that takes slopes off, columns.
_SLOPE = 4.0


def ring_errors(mean: Floats) -> Floats:
    """Return the errors of the pixels, (rows, columns).

    Parameters
    ----------
    mean : ndarray of float32, (rows, columns)
        Of the line integrals of all views, bad pixels interpolated.
    """
    from scipy.ndimage import gaussian_filter1d, median_filter

    # A median does not see small errors on a slope: what is smooth is taken off before.
    sharp: Floats = mean - gaussian_filter1d(mean, _SLOPE, axis=1, mode="nearest")
    smooth: Floats = median_filter(sharp, size=(1, _WIDTH), mode="nearest")
    return sharp - smooth
