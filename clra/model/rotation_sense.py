"""A sample that turns the other way than the geometry says."""

from __future__ import annotations

import numpy as np

from clra.model.geometry import ConeBeamGeometry


def opposite_rotation(geometry: ConeBeamGeometry) -> ConeBeamGeometry:
    """Return the geometry of the same scanner with a sample that turns in the other sense.

    A view that stands at angle b is turned by -2b about z, and all that the scanner did in it with
    it: heights, offsets and tilts of the detector stay.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Its columns run about horizontally.
    """
    angle = np.arctan2(geometry.u[:, 1], geometry.u[:, 0])
    c, s = np.cos(2 * angle)[:, None, None], np.sin(2 * angle)[:, None, None]
    vectors = geometry.to_astra().reshape(-1, 4, 3)
    x, y, z = np.split(vectors, 3, axis=2)
    turned = np.concatenate([c * x + s * y, c * y - s * x, z], axis=2)
    return ConeBeamGeometry.from_astra(turned.reshape(-1, 12), geometry.shape)
