"""Views that a helix lacks, such as frames marked invalid, or has twice, such as retaken ones."""

import numpy as np
from numpy.typing import NDArray

from clra.model.geometry import ConeBeamGeometry
from clra.model.helix.fit import LARGEST_STEP

Floats = NDArray[np.float64]

# Part of a step by which a view after a gap may be off its place.
_OFF = 0.25


def completed(geometry: ConeBeamGeometry) -> tuple[ConeBeamGeometry, NDArray[np.int64]]:
    """Put in the views that helices lack: one at a place, or as many as 6 degrees hold.

    Of views that repeat each other the last stays. Wider gaps stay: what lies between their ends
    says nothing of what is missing.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of any trajectory; one without such gaps and repetitions comes back as it is.

    Returns
    -------
    geometry : ConeBeamGeometry
        A missing view is the one before it, turned and raised.
    views : ndarray of int, (views of the new geometry,)
        Number of each view in the old geometry, -1 of a missing one.
    """
    x, y, z = geometry.source.T
    turned, raised = _wrapped(np.diff(np.arctan2(x, -y))), np.diff(z)
    turn, rise = (np.median(np.abs(s)) if len(s) else 0.0 for s in (turned, raised))
    views = np.arange(geometry.views)
    if not (turn > 0 and rise > 0):
        return geometry, views
    repeated = (np.abs(turned) < _OFF * turn) & (np.abs(raised) < _OFF * rise)
    if repeated.any():
        kept = np.flatnonzero(~np.append(repeated, False))
        once, chosen = completed(geometry.subset(kept))
        return once, np.where(chosen >= 0, kept[chosen], -1)
    regular = (np.abs(np.abs(turned) - turn) < _OFF * turn) & (
        np.abs(np.abs(raised) - rise) < _OFF * rise
    )
    steps = np.ones(len(turned), np.int64)
    most = 1 + max(1, int(LARGEST_STEP / turn))
    usual = np.flatnonzero(regular)
    for gap in np.flatnonzero(~regular):
        count = int(np.rint(abs(raised[gap]) / rise))
        if not 2 <= count <= most:
            continue
        # The helix goes on as it does before or after.
        after = np.searchsorted(usual, gap)
        for beside in usual[max(after - 1, 0) : after + 1]:
            left = _wrapped(turned[gap] - count * turned[beside])
            short = raised[gap] - count * raised[beside]
            if abs(left) < _OFF * turn and abs(short) < _OFF * rise:
                steps[gap] = count
                turned[gap] = count * turned[beside] + left
    if (steps == 1).all():
        return geometry, views
    # Each new view is a part of the way from the old one before it.
    before = np.repeat(views, np.append(steps, 1))
    number = np.arange(len(before)) - np.append(0, np.cumsum(steps))[before]
    part = number / np.append(steps, 1)[before]
    angle, height = part * np.append(turned, 0)[before], part * np.append(raised, 0)[before]

    def moved(vectors: Floats, lift: bool) -> Floats:
        one, other, along = vectors[before].T
        cosine, sine = np.cos(angle), np.sin(angle)
        rotated = [cosine * one - sine * other, sine * one + cosine * other, along + lift * height]
        return np.stack(rotated, axis=1)

    whole = ConeBeamGeometry(
        source=moved(geometry.source, True),
        detector=moved(geometry.detector, True),
        u=moved(geometry.u, False),
        v=moved(geometry.v, False),
        shape=geometry.shape,
    )
    return whole, np.where(number == 0, before, -1)


def _wrapped(angle: Floats) -> Floats:
    """Angle within half a turn [rad]."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
