"""A small scan of balls that move and turn in every view."""

import numpy as np

import clra
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.model.rigid.rigid_motion import RigidMotion

VIEWS, SIZE = 60, 48


def balls() -> Ellipsoids:
    random = np.random.default_rng(3)
    centres = random.uniform(-0.25, 0.25, (30, 3)) * SIZE
    return Ellipsoids(centres, random.uniform(1.5, 4, 30), random.uniform(0.02, 0.06, 30))


def moved_scan(size: list[float]) -> tuple[clra.Scan, clra.ConeBeamGeometry]:
    """Return a scan whose motion is uniform within +-size, and the geometry it really had."""
    ideal = clra.circular(
        VIEWS,
        source_to_axis=2.5 * SIZE,
        source_to_detector=3.75 * SIZE,
        pixel_size=1.5,
        shape=(64, 64),
    )
    table = size * np.random.default_rng(4).uniform(-1, 1, (VIEWS, 6))
    true = ideal.with_motion(RigidMotion.of(ideal, table))
    return clra.Scan(balls().line_integrals(true, oversample=2), ideal), true
