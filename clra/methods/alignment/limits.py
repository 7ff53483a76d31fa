"""Limits of re-projection alignment, noticed: motions out of reach, features too fine for a level.

The paper names both in its Section 4.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from clra.findings import warn
from clra.methods.alignment.reprojection import REACH
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.model.schedule import level_name

Floats = NDArray[np.float64]

# A view is at the end of the reach if it asks for this part of it, and there are too many if they
# are more than this part of the views: a few bad ones are dealt with elsewhere.
_AT_END, _TOO_MANY = 0.8, 0.05
# A level is contradicted by the next if that moves too many of the views by this part of the
# former's pixel or more: half of them where grains are 2 pixels wide, none where they are 4.
_ASIDE = 0.25
# Median correlation below which radiographs and re-projections hardly show the same.
_LOW = 0.6
# Views whose contrast is measured, and the scale of that contrast in pixels of the level.
_VIEWS, _SCALE = 12, 16


def far_motion(found: Motion, level: int) -> str:
    """Return a warning if many views moved as far as registration looks.

    Parameters
    ----------
    found : Motion
        By the first registration [pixel of the full-resolution detector].
    level : int
        Binning factor.

    Returns
    -------
    str
        Empty if all is well.
    """
    reach = REACH * level
    farthest = np.maximum(np.abs(found.shift_u), np.abs(found.shift_v))
    at_end = int(np.count_nonzero(farthest >= _AT_END * reach))
    if at_end <= _TOO_MANY * found.views:
        return ""
    levels = [level_name(factor) for factor in (16, 8, 4, 2) if factor <= max(2 * level, 4)]
    coarser = "-".join(f"2{name}" for name in levels[:3])
    return (
        f"{at_end} of {found.views} views moved by {_AT_END * reach:.0f} pixels or more: "
        f"registration at {level_name(level)} looks no farther than {reach:.0f}; start with a "
        f"coarser level (such as {coarser}) or from a motion"
    )


def false_shifts(level: int, last: Floats, finer: int, first: Floats) -> str:
    """Return a warning if a level contradicts what the coarser one before it found.

    Where features are lost, views settle at shifts that fit by chance. They agree with a volume
    made from views that lie like that, their correlation is high, but the next level disagrees.

    Parameters
    ----------
    level, finer : int
        Binning factors; nothing is said unless the second is the smaller one.
    last, first : ndarray, (2, views)
        Absolute updates of the shifts in u and v by the last iteration of the former and by the
        first of the latter [pixel of the full-resolution detector].

    Returns
    -------
    str
        Empty if all is well.
    """
    least = _ASIDE * level
    before, now = (int((update >= least).any(axis=0).sum()) for update in (last, first))
    views = first.shape[1]
    # What had not settled anyway goes on at the next level.
    if finer >= level or now <= max(before, _TOO_MANY * views):
        return ""
    name, next_name = level_name(level), level_name(finer)
    return (
        f"{next_name} moved {now} of {views} views by {least:g} pixel{'s' * (least != 1)} or more, "
        f"the last iteration at {name} {before}: what {name} found was not their motion. Features "
        f"are too small for it, too much alike, or move against each other (--estimate source); "
        f"look whether {next_name} converged, or begin there, such as with 4{next_name}"
    )


def lost_features(scan: Scan, correlation: Floats, level: int) -> str:
    """Return a warning if radiographs and re-projections have little in common at a level.

    Parameters
    ----------
    scan : Scan
        Of which a few radiographs are read if there is something to tell.
    correlation : ndarray, (views,)
        After the last registration at that level.
    level : int
        Binning factor.

    Returns
    -------
    str
        Empty if all is well.
    """
    middle = float(np.median(correlation))
    if middle >= _LOW:
        return ""
    survives = ""
    if level > 1:
        survives = (
            f"; {100 * surviving_contrast(scan, level):.1f} % of the contrast finer than "
            f"{_SCALE * level} pixels survives binning by {level} (noise alone would leave "
            f"{100 / level**2:.1f} %): start at a finer level if features are that small"
        )
    return (
        f"radiographs and re-projections hardly agree at {level_name(level)}, their median "
        f"correlation is {middle:.2f}{survives}"
    )


def warned(**notes: str) -> str:
    """Warn of each note that is not empty, by its code; return them as one, a line each."""
    said = {code: note for code, note in notes.items() if note}
    for code, note in said.items():
        warn(code.replace("_", "-"), note)
    return "\n".join(said.values())


def surviving_contrast(scan: Scan, level: int) -> float:
    """Return which part of the fine contrast of radiographs is left when they are binned.

    Parameters
    ----------
    scan : Scan
        Of which a dozen radiographs are read.
    level : int
        Binning factor.

    Returns
    -------
    float
        Variance of pixels binned, over that of pixels, both without what is coarser than 16 binned
        pixels: 1 / level^2 for white noise, nearly 1 for coarse structures.
    """
    rows, columns = (n // level * level for n in scan.geometry.shape)
    sigma = min(_SCALE * level, min(rows, columns) / 4)
    kept = total = 0.0
    for view in np.unique(np.linspace(0, scan.views - 1, _VIEWS).astype(int)):
        image = scan.read(int(view), int(view) + 1)[0, :rows, :columns].astype(np.float64)
        fine = image - gaussian_filter(image, sigma)
        blocks = fine.reshape(rows // level, level, columns // level, level).mean(axis=(1, 3))
        kept, total = kept + float(blocks.var()), total + float(fine.var())
    return kept / total if total else 0.0
