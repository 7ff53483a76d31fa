"""Detectors that stand, or are stored, otherwise than the geometry says or ramp filters expect."""

from __future__ import annotations

import numpy as np

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry

FLIPS = ("columns", "rows", "both")

# Angle between rows and the horizontal from which on ramp-FBP is wrong by more than two per cent: a
# compact object comes out 0.6 % too bright at 5 degrees, 2.5 % at 10, 9 % at 20, 33 % at 90.
_STEEP = np.radians(10.0)


def with_detector(
    geometry: ConeBeamGeometry, *, offset_u: float = 0.0, tilt: float = 0.0
) -> ConeBeamGeometry:
    """Return the geometry with the detector shifted along its rows and turned in its plane.

    A point that `geometry` puts at q, the returned one puts at ``c + R (q - c) + (offset_u, 0)``,
    with c the detector's centre, q = (column, row), and R the rotation by `tilt`.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        As it was thought to be.
    offset_u : float
        Shift of the radiographs toward higher columns [pixel]: where the projection of the axis
        lies.
    tilt : float
        Angle by which radiographs are turned from columns toward rows [rad]; pixels that are not
        square are turned as lengths.
    """
    c, s = np.cos(tilt), np.sin(tilt)
    aspect = (np.linalg.norm(geometry.u, axis=1) / np.linalg.norm(geometry.v, axis=1))[:, None]
    u = c * geometry.u - s * aspect * geometry.v
    v = s / aspect * geometry.u + c * geometry.v
    return ConeBeamGeometry(
        source=geometry.source,
        detector=geometry.detector - offset_u * u,
        u=u,
        v=v,
        shape=geometry.shape,
    )


def with_axis_at(
    geometry: ConeBeamGeometry, column: float, row: float | None = None
) -> ConeBeamGeometry:
    """Return the geometry with the rotation axis, and the principal row, seen elsewhere.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        As it was thought to be.
    column : float
        Where the axis is seen, from the detector's middle, positive toward higher columns; the
        median over the views [pixel]. Source and detector move beside the axis together.
    row : float, optional
        Where the perpendicular from the source meets the detector, likewise, positive toward
        higher rows [pixel]; as it is if not given.
    """
    level = geometry.source * np.array([0.0, 0.0, 1.0])
    ray = level - geometry.source
    basis = np.stack([geometry.u, geometry.v, -ray], axis=2)
    seen = np.linalg.solve(basis, (geometry.source - geometry.detector)[:, :, None])[:, 0, 0]
    beside = (column - np.median(seen)) * geometry.u
    beside *= (geometry.source_to_axis / geometry.source_to_detector)[:, None]
    detector = geometry.detector - beside
    if row is not None:
        middle = (geometry.rows - 1) / 2
        detector = detector - (row - np.median(geometry.principal[:, 1] - middle)) * geometry.v
    return ConeBeamGeometry(
        source=geometry.source - beside,
        detector=detector,
        u=geometry.u,
        v=geometry.v,
        shape=geometry.shape,
    )


def flipped(geometry: ConeBeamGeometry, which: str) -> ConeBeamGeometry:
    """Return the geometry of the same scanner for radiographs that are stored mirrored.

    The sample turns and rises as before. What lies at some column (or row) of the stored
    radiograph stays there: only the side of the scanner that it stands for is another.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Its columns run about horizontally.
    which : {"columns", "rows", "both"}
        What is in the reverse order.

    Raises
    ------
    InputError
        If `which` is none of these.
    """
    if which not in FLIPS:
        raise InputError.at("--flip", "flip", repr(which), f"one of {', '.join(FLIPS)}")
    source, detector, u, v = (
        a.copy() for a in (geometry.source, geometry.detector, geometry.u, geometry.v)
    )
    if which != "rows":
        across = geometry.u * np.array([1.0, 1.0, 0.0])
        across /= np.linalg.norm(across, axis=1)[:, None]
        for vectors in (source, detector, u, v):
            vectors -= 2 * np.sum(vectors * across, axis=1)[:, None] * across
    if which != "columns":
        detector[:, 2] = 2 * source[:, 2] - detector[:, 2]
        u[:, 2], v[:, 2] = -u[:, 2], -v[:, 2]
    return ConeBeamGeometry(source=source, detector=detector, u=u, v=v, shape=geometry.shape)


def mirrored_axes(geometry: ConeBeamGeometry) -> tuple[bool, bool]:
    """Tell whether rows count upwards and whether columns count to the left.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Columns are looked at from the source, with +z up.

    Returns
    -------
    (bool, bool)
        Of the rows and of the columns; in all views, else False.
    """
    upwards = bool(np.all(geometry.v[:, 2] > 0))
    right = np.cross(geometry.normal, [0.0, 0.0, 1.0])
    return upwards, bool(np.all(np.sum(geometry.u * right, axis=1) < 0))


def reversed_axes(geometry: ConeBeamGeometry, *, rows: bool, columns: bool) -> ConeBeamGeometry:
    """Return the geometry of the same pixels counted from the other end."""
    return ConeBeamGeometry(
        source=geometry.source,
        detector=geometry.detector,
        u=-geometry.u if columns else geometry.u,
        v=-geometry.v if rows else geometry.v,
        shape=geometry.shape,
    )


def steep_rows(geometry: ConeBeamGeometry) -> str:
    """Return a warning if detector rows are too steep to be filtered along.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of any trajectory about z.

    Returns
    -------
    str
        Empty if all is well.
    """
    turned = np.arcsin(np.abs(geometry.u[:, 2]) / np.linalg.norm(geometry.u, axis=1))
    angle = float(np.median(turned))
    if angle < _STEEP:
        return ""
    return (
        f"fbp filters along the rows of the detector, which rise by {np.degrees(angle):.0f} "
        f"degrees, expected less than {np.degrees(_STEEP):.0f}; intensities may be off by "
        "a third, not by method 'osem-tr'"
    )
