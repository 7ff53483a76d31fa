"""Geometries that no trajectory gives."""

from pathlib import Path

import numpy as np

from clra.model.geometry import ConeBeamGeometry


def tilted(seed=0, views=5, unit=1.0, shape=(37, 51)) -> ConeBeamGeometry:
    """Detectors in general position, tilted and skewed, that look at about the origin."""
    random = np.random.default_rng(seed)
    angle = 2 * np.pi * random.random(views)
    out = np.stack([np.sin(angle), -np.cos(angle), 0 * angle], axis=1)
    along = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    noise = random.normal(size=(4, views, 3))
    return ConeBeamGeometry(
        source=unit * (20 * out + noise[0]),
        detector=unit * (-30 * out + noise[1]),
        u=unit * (0.4 * along + 0.02 * noise[2]),
        v=unit * (0.4 * np.array([0, 0, 1]) + 0.02 * noise[3]),
        shape=shape,
    )


def upside_down(geometry: ConeBeamGeometry) -> ConeBeamGeometry:
    """The same detectors with their rows counted the other way."""
    return ConeBeamGeometry(
        source=geometry.source,
        detector=geometry.detector,
        u=geometry.u,
        v=-geometry.v,
        shape=geometry.shape,
    )


def geometry_of_cil(path: Path) -> ConeBeamGeometry:
    """What the arguments of CIL's create_Cone3D_SOUV describe."""
    told = np.load(path)
    columns, rows = told["num_pixels"]
    return ConeBeamGeometry(
        source=told["source_position_set"],
        detector=told["detector_position_set"],
        u=told["detector_direction_x_set"] * told["pixel_size"][0],
        v=told["detector_direction_y_set"] * told["pixel_size"][1],
        shape=(int(rows), int(columns)),
    )
