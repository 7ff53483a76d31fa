"""How far from the rotation axis a scan measures, and detectors that are offset to see farther."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clra.model.geometry import ConeBeamGeometry
from clra.model.sampling.angular_coverage import is_whole_circle

Floats = NDArray[np.float64]

# A detector is offset if it sees this many times as far on one side of the axis as on the other. A
# centre of rotation that is a few per cent off must not enlarge every default grid.
_OFFSET = 1.2


def side_distances(geometry: ConeBeamGeometry) -> Floats:
    """Distance from the axis to the planes through the source and the sides of the detector.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan.

    Returns
    -------
    ndarray, (views, 2)
        For the side of column 0 and of the last column [mm], SOD sin(half fan) at the source's
        height; negative where the axis lies beyond that side.
    """
    distances = []
    for side in (-1, 1):
        edge = geometry.detector + side * geometry.columns / 2 * geometry.u - geometry.source
        normal = np.cross(edge, geometry.v)
        inward = np.sign(np.sum(normal * -side * geometry.u, axis=1))
        horizontal = np.linalg.norm(normal[:, :2], axis=1)
        distances.append(
            -np.sum(normal[:, :2] * geometry.source[:, :2], axis=1) * inward / horizontal
        )
    return np.stack(distances, axis=1)


def is_offset(geometry: ConeBeamGeometry) -> bool:
    """Whether the detector is offset, so that half a fan sees the sample over a whole circle.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan.

    Returns
    -------
    bool
        False for trajectories that are no whole circle: they need both sides.
    """
    sides = np.median(side_distances(geometry), axis=0)
    near, far = float(sides.min()), float(sides.max())
    return 0 < _OFFSET * near < far and is_whole_circle(geometry)


def field_radii(geometry: ConeBeamGeometry) -> Floats:
    """Radius of the circle about the axis within which each view measures all it should.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan.

    Returns
    -------
    ndarray, (views,)
        Distance of the nearer side of the detector [mm], of an offset detector that of the farther
        one; negative for a view that does not see the axis.
    """
    sides = side_distances(geometry)
    return np.asarray(sides.max(axis=1) if is_offset(geometry) else sides.min(axis=1))
