"""Geometries with the motion in them, as other programs describe detectors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry

Floats = NDArray[np.float64]

# Least that a detector may be off upright or rectangular, as a cosine: less is rounding.
_UPRIGHT = 1e-6


def with_one_pixel(geometry: ConeBeamGeometry) -> ConeBeamGeometry:
    """Return the same projections by detectors that all have the same pixel.

    A detector whose pixels are m times smaller sees what one m times as far from the source sees.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        With a motion: its magnifications are in the pixels.

    Returns
    -------
    ConeBeamGeometry
        With pixels as wide as the median; points project where they did.
    """
    width = np.linalg.norm(geometry.u, axis=1)
    scale = (np.median(width) / width)[:, None]
    return ConeBeamGeometry(
        source=geometry.source,
        detector=geometry.source + scale * (geometry.detector - geometry.source),
        u=scale * geometry.u,
        v=scale * geometry.v,
        shape=geometry.shape,
    )


def cil_arrays(geometry: ConeBeamGeometry) -> dict[str, Any]:
    """Return the arguments of CIL's ``create_Cone3D_SOUV``, detector included.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        With the motion.

    Returns
    -------
    dict
        The sets of positions and directions [mm], ``num_pixels`` and ``pixel_size`` as (columns,
        rows), and ``origin``: its pixel (0, 0) is ours.
    """
    same = with_one_pixel(geometry)
    wide, high = (np.linalg.norm(step, axis=1) for step in (same.u, same.v))
    return {
        "source_position_set": same.source,
        "detector_position_set": same.detector,
        "detector_direction_x_set": same.u / wide[:, None],
        "detector_direction_y_set": same.v / high[:, None],
        "num_pixels": np.array([same.columns, same.rows]),
        "pixel_size": np.array([np.median(wide), np.median(high)]),
        "origin": "bottom-left",
    }


def tigre_arrays(geometry: ConeBeamGeometry) -> dict[str, Any]:
    """Return TIGRE's numbers of each view.

    At angle a TIGRE has its source at DSO (cos a, sin a, 0), columns along (-sin a, cos a, 0) and
    rows, of which the first is the lowest, along z. Where a source is beside that, the volume's
    offset is the other way.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        With the motion; its detectors are upright: v along z and u across it.

    Returns
    -------
    dict
        ``angles`` [rad], ``DSD`` and ``DSO``, each (views,), ``offDetector`` (views, 2) as (v, u)
        and ``offOrigin`` (views, 3) as (z, y, x) [mm], ``nDetector`` and ``dDetector`` as (v, u);
        and whether rows and columns of the radiographs have to be turned round: ``flip_rows``,
        ``flip_columns``.

    Raises
    ------
    InputError
        If a detector is tilted.
    """
    same = with_one_pixel(geometry)
    wide, high = (np.linalg.norm(step, axis=1, keepdims=True) for step in (same.u, same.v))
    u, v = same.u / wide, same.v / high
    tilted = np.maximum(np.abs(u[:, 2]), np.hypot(v[:, 0], v[:, 1])) > _UPRIGHT
    if tilted.any():
        view = int(np.argmax(tilted))
        raise InputError(
            f"geometry: found a detector in view {view} that is tilted, expected rows along z and "
            "columns across it: TIGRE's detectors are exported upright only"
        )
    toward = -same.normal
    angle = np.arctan2(toward[:, 1], toward[:, 0])
    across = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    aside = {"u": np.sum(same.source * across, axis=1), "v": same.source @ up}
    flip_columns, flip_rows = np.sum(u * across, axis=1) < 0, v[:, 2] < 0
    if len(set(flip_columns)) > 1 or len(set(flip_rows)) > 1:
        raise InputError("geometry: found views that are mirrored against others, expected alike")
    lateral = aside["u"][:, None] * across + aside["v"][:, None] * up
    middle = [same.detector @ up - aside["v"], np.sum(same.detector * across, axis=1) - aside["u"]]
    return {
        "angles": angle,
        "DSD": same.source_to_detector,
        "DSO": np.sum(same.source * toward, axis=1),
        "offDetector": np.stack(middle, axis=1),
        "offOrigin": -lateral[:, ::-1],
        "nDetector": np.array([same.rows, same.columns]),
        "dDetector": np.array([np.median(high), np.median(wide)]),
        "flip_rows": bool(flip_rows[0]),
        "flip_columns": bool(flip_columns[0]),
    }
