"""The modes of the gauge: movements of the sample, and what they look like in each view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion
from clra.model.validation import vectors

Floats = NDArray[np.float64]

GAUGE_MODES = (
    "translation x",
    "translation y",
    "translation z",
    "tilt x",
    "tilt y",
    "scale",
    "stretch z",
)
"""The seven movements. Rotation about z is not one: it looks like a wrong centre of rotation, which
the data see."""

# Fewest points in a view from which three numbers are fitted.
_FEWEST = 8

# Elements of a work array: the fifteen of them fit a cache. At eight times the size it is as quick.
_CHUNK = 1 << 16


def gauge_columns(
    geometry: ConeBeamGeometry, points: ArrayLike, modes: Sequence[str] = GAUGE_MODES
) -> Floats:
    """Return what small movements of the sample look like as motion of each view.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan.
    points : array_like, (n, 3)
        Points of the sample, best where it has its edges [mm].
    modes : sequence of str
        Movements out of `GAUGE_MODES`, about the origin.

    Returns
    -------
    ndarray, (3 views, modes)
        All du [pixel], then all dv [pixel], then all dm: the least-squares fit, over the points
        that the view sees, of shift and magnification to the points' displacement, for each unit
        of movement: 1 mm, 1 rad, or 1 (a doubled size). Zero in a view that sees hardly any.
    """
    points = vectors("points", points, "points")
    fields = np.concatenate([mode_field(mode, points) for mode in modes], axis=1)
    to_pixels = geometry.projection_matrices()[:, :, :3].copy()
    # Pixels are counted from the detector's centre here, about which it is magnified.
    to_pixels[:, 0] -= (geometry.columns - 1) / 2 * to_pixels[:, 2]
    to_pixels[:, 1] -= (geometry.rows - 1) / 2 * to_pixels[:, 2]
    columns = np.zeros((3, geometry.views, len(modes)))
    step = max(1, _CHUNK // len(points))
    for start in range(0, geometry.views, step):
        part = slice(start, start + step)
        columns[:, part] = _apparent(
            geometry.source[part], to_pixels[part], geometry.shape, points, fields
        )
    return columns.reshape(3 * geometry.views, len(modes))


def mode_field(mode: str, points: Floats) -> Floats:
    """Return the movement of each point for a unit of a mode, (n, 3) [mm]."""
    if mode not in GAUGE_MODES:
        raise InputError(f"modes: found {mode!r}, expected some of {GAUGE_MODES}")
    kind, _, axis = mode.partition(" ")
    if kind == "scale":
        return points
    unit = np.eye(3)["xyz".index(axis)]
    if kind == "translation":
        return np.broadcast_to(unit, points.shape)
    return np.cross(unit, points) if kind == "tilt" else points * unit


def _apparent(
    source: Floats, to_pixels: Floats, shape: tuple[int, int], points: Floats, fields: Floats
) -> Floats:
    """Fitted (du, dv, dm) of some views, (3, views, modes).

    A movement w displaces the pixel q = (a, b) / g by (A w - q (A_g w)) / g. The sums over points
    that the fit needs are linear in w, hence products of (views, points) with (points, modes).
    """
    a, b, g = np.moveaxis(to_pixels @ points.T - to_pixels @ source[:, :, None], 1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b, near = a / g, b / g, 1 / g
        seen = (g > 0) & (np.abs(a) < shape[1] / 2) & (np.abs(b) < shape[0] / 2)
    a, b, near = (np.where(seen, x, 0.0) for x in (a, b, near))
    square = a**2 + b**2

    # Sums over the points of 1, a, b and a^2 + b^2 times w / g, each (views, modes, 3)
    plain, with_a, with_b, with_square = (
        (weight @ fields).reshape(len(source), -1, 3)
        for weight in (near, near * a, near * b, near * square)
    )

    def component(moved: Floats, row: int) -> Floats:
        return np.asarray(np.einsum("vmi,vi->vm", moved, to_pixels[:, row]))

    sum_u = component(plain, 0) - component(with_a, 2)
    sum_v = component(plain, 1) - component(with_b, 2)
    sum_along = component(with_a, 0) + component(with_b, 1) - component(with_square, 2)
    count = np.maximum(seen.sum(axis=1), 1)[:, None]
    mean_a, mean_b = a.sum(axis=1)[:, None] / count, b.sum(axis=1)[:, None] / count
    spread = square.sum(axis=1)[:, None] - count * (mean_a**2 + mean_b**2)
    fitted = (count >= _FEWEST) & (spread > 0)
    dm = (sum_along - mean_a * sum_u - mean_b * sum_v) / np.where(fitted, spread, 1.0)
    du, dv = sum_u / count - dm * mean_a, sum_v / count - dm * mean_b
    return np.where(fitted, np.stack([du, dv, dm]), 0.0)


def apparent_shift(
    geometry: ConeBeamGeometry, points: ArrayLike, offset: tuple[float, float, float]
) -> Motion:
    """Return the motion that a sample shows from where it is offset to where its points are.

    Unlike :func:`gauge_columns` for movements of any length.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan.
    points : array_like, (n, 3)
        Points of the sample, which every view sees [mm].
    offset : (float, float, float)
        By which it was displaced along x, y and z [mm].

    Returns
    -------
    Motion
        Least-squares fit, over the points, of shift and magnification in each view.
    """
    there = vectors("points", points, "points")
    centre = np.array([geometry.columns - 1, geometry.rows - 1]) / 2
    before, after = (geometry.project(p) - centre for p in (there + offset, there))
    spread = before - before.mean(axis=1, keepdims=True)
    m = np.sum(spread * after, axis=(1, 2)) / np.sum(spread**2, axis=(1, 2))
    u, v = (after - m[:, None, None] * before).mean(axis=1).T
    return Motion(shift_u=u, shift_v=v, magnification=m)
