"""What a few radiographs tell against the way in which a scan is read."""

import warnings

import numpy as np

from clra.model.scan import Scan

# Transmission that no sample causes, and the part of the pixels in which it may be all the same:
# the rims of phase contrast are as bright, flats that fit badly are not.
_BRIGHT, _RIMS = 1.5, 0.01


def warn_of_scale(scan: Scan) -> None:
    """Warn of radiographs that are hardly transmission: not normalised by what belongs to them.

    The first, the middle and the last are looked at, so that a bad one raises no alarm.

    Parameters
    ----------
    scan : Scan
        Just opened; line integrals can be anything and are not looked at.
    """
    if scan.kind != "transmission":
        return
    few = sorted({0, scan.views // 2, scan.views - 1})
    pixels = np.concatenate([np.ravel(scan.projections[k : k + 1]) for k in few])
    dark, bright = np.mean(pixels <= 0), np.mean(pixels > _BRIGHT)
    if dark > 0.5:
        warnings.warn(
            f"{scan.name}: {dark:.0%} of the pixels are not brighter than the darks: are flats and "
            "darks of these frames, or do the frames hold transmission or line integrals already "
            "(clra import --kind)?",
            stacklevel=3,
        )
    elif bright > _RIMS:
        warnings.warn(
            f"{scan.name}: {bright:.0%} of the pixels are more than {_BRIGHT:g} times as bright as "
            "the open beam: are the flats of these frames, is the byte order right, or do they "
            "hold line integrals (clra import --kind)?",
            stacklevel=3,
        )
