"""What data tell against the way in which a scan is read, or against what alignment found."""

import math
from typing import TYPE_CHECKING

import numpy as np

from clra.findings import warn
from clra.model.motion import Motion
from clra.model.scan import Scan

if TYPE_CHECKING:
    from clra.methods.assessment.agreement import Agreement

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
    pixels = np.concatenate([np.asarray(scan.projections[k : k + 1]) for k in few])
    dark = np.mean(pixels <= 0)
    # Hot pixels and columns, which are found later, stand alone.
    is_bright = pixels > _BRIGHT
    bright = np.mean(is_bright[:, :, 4:] & is_bright[:, :, 2:-2] & is_bright[:, :, :-4])
    if dark > 0.5:
        warn(
            "intensity-scale",
            f"{scan.name}: {dark:.0%} of the pixels are not brighter than the darks: are flats and "
            "darks of these frames, or do the frames hold transmission or line integrals already "
            "(clra import --kind)?",
        )
    elif bright > _RIMS:
        warn(
            "intensity-scale",
            f"{scan.name}: {bright:.0%} of the pixels are more than {_BRIGHT:g} times as bright as "
            "the open beam: are the flats of these frames, is the byte order right, or do they "
            "hold line integrals (clra import --kind)?",
        )


def doubt_of_shifts(quality: "Agreement", motion: Motion) -> str:
    """Return a warning if half scans disagree on the shifts by more than there is of them.

    Parameters
    ----------
    quality : Agreement
        Of the alignment.
    motion : Motion
        That it found.

    Returns
    -------
    str
        Empty if all is well.
    """
    found = [float(np.median(np.abs(shift))) for shift in (motion.shift_u, motion.shift_v)]
    halves = (quality.half_u, quality.half_v)
    if math.hypot(*halves) <= math.hypot(*found):
        return ""
    return (
        "even and odd views by themselves disagree on the shifts, by {:.2f}, {:.2f} pixel along u, "
        "v (median), and all together found no more than {:.2f}, {:.2f}: what was found may be no "
        "motion, compare the slices before and after".format(*halves, *found)
    )
