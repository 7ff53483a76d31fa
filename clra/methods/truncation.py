"""Samples that are wider than what the detector sees of them, as far as radiographs tell."""

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.rejected_views import odd, sums_of
from clra.ops.streaming.radiographs import Radiographs

# Views that are looked at, and the part of the largest line integral, as means over rows, that may
# be left at a border. Scatter and unevenness of the open beam leave one or two per cent; a sample
# with less than 3 beyond suffers as little.
_PROBED, AT_BORDER = 24, 0.03
# Part of the views that may show more at a border.
_OFTEN = 0.5


def profiles(radiographs: Radiographs, views: slice, rows: slice) -> NDArray[np.float64]:
    """Return means over rows of a few radiographs, (n, columns).

    Parameters
    ----------
    radiographs : Radiographs
        Of these, any that differ much in mean or contrast say nothing and are left out.
    views : slice
        To choose from.
    rows : slice
        To average.
    """
    probed, sums = [], []
    for view in np.unique(np.linspace(views.start, views.stop - 1, _PROBED).astype(int)):
        image = radiographs.read(slice(view, view + 1))
        probed.append(image[0, rows].mean(axis=0, dtype=np.float64))
        sums.append(sums_of(image)[:, 0])
    return np.stack(probed)[~odd(np.stack(sums, axis=1))]


def truncated(radiographs: Radiographs) -> str:
    """Return a warning if the sample reaches beyond the left or right border of the detector.

    Parameters
    ----------
    radiographs : Radiographs
        A few are read.

    Returns
    -------
    str
        Empty if all is well.
    """
    views, rows, _ = radiographs.shape
    means = profiles(radiographs, slice(0, views), slice(0, rows))
    # Views that moved far may well show the sample at a border.
    cut = float(np.quantile(means[:, [0, -1]].max(axis=1), _OFTEN))
    most = float(means.max())
    if not cut > AT_BORDER * most:
        return ""
    return (
        f"the sample reaches beyond the detector (line integrals of {cut:.3g} in its outermost "
        f"columns, {most:.3g} inside): intensities are too high, most towards the border of the "
        "field of view"
    )


def falls_outwards(radiographs: Radiographs) -> bool:
    """Tell whether what is left at the border of the detector falls towards it.

    A sample that reaches beyond does; scatter, or flats of another intensity, leave a level.

    Parameters
    ----------
    radiographs : Radiographs
        A few are read.
    """
    views, rows, columns = radiographs.shape
    means = profiles(radiographs, slice(0, views), slice(0, rows))
    inwards = columns // 10
    left, right = means[:, inwards] - means[:, 0], means[:, -1 - inwards] - means[:, -1]
    fall = float(np.quantile(np.maximum(left, right), _OFTEN))
    return fall > AT_BORDER * float(means.max())
