"""Radiographs that are stored mirrored against what the geometry says."""

from __future__ import annotations

import numpy as np

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry

FLIPS = ("columns", "rows", "both")


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
