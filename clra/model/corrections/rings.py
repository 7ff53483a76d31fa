"""Ring artefacts: errors of pixels that are the same in all views.

The mean of the radiographs over the views is smooth along the rows, for the sample moves over the
detector; what it has beyond its running median is the detector's, and is subtracted from every
view: Boin & Haibel, "Compensation of ring artefacts in synchrotron tomographic images", Optics
Express 14 (2006), with a median in place of the moving average, so that one bad pixel does not
spread.
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

# Columns of the running median: rings of up to four pixels are removed. Twice as many take more of
# what is sharp in the sample near the axis.
_WIDTH = 9


def ring_errors(mean: Floats) -> Floats:
    """Return the errors of the pixels, (rows, columns).

    Parameters
    ----------
    mean : ndarray of float32, (rows, columns)
        Of the line integrals of all views, bad pixels interpolated.
    """
    from scipy.ndimage import median_filter

    smooth: Floats = median_filter(mean, size=(1, _WIDTH), mode="nearest")
    return mean - smooth
