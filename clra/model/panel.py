"""A panel that stands otherwise than the geometry says, in all views alike."""

from __future__ import annotations

import numpy as np

from clra.model.geometry import ConeBeamGeometry


def with_panel(
    geometry: ConeBeamGeometry, *, offset_u: float = 0.0, tilt: float = 0.0
) -> ConeBeamGeometry:
    """Return the geometry with the panel shifted along its rows and turned in its plane.

    A point that `geometry` puts at q, the returned one puts at ``c + R (q - c) + (offset_u, 0)``,
    with c the panel's centre, q = (column, row), and R the rotation by `tilt`.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        As it was believed to be.
    offset_u : float
        Shift of the radiographs toward higher columns [pixel]: where the shadow of the axis lies.
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
