"""The gauge of rigid motion: what a movement of the sample as a whole explains of all views."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clra.model.geometry import ConeBeamGeometry
from clra.model.rigid.rigid_motion import (
    RigidMotion,
    rotation_matrices,
    rotation_vectors,
    turning_centre,
    view_axes,
)

Floats = NDArray[np.float64]

_STEP = 1e-4  # of finite differences: of the cloud's radius, and radians
_ROUNDS = 3


def between(nominal: ConeBeamGeometry, moved: ConeBeamGeometry) -> RigidMotion:
    """Return the motion with which one geometry becomes another, of the same scanner.

    Parameters
    ----------
    nominal, moved : ConeBeamGeometry
        Distances and pixels agree; only poses differ.
    """
    axes, turned = view_axes(nominal), view_axes(moved)
    centre = turning_centre(nominal)
    in_axes = np.swapaxes(turned, 1, 2) @ axes
    seen = np.einsum("nji,nj->ni", axes, nominal.source - centre)
    apart = np.einsum("nji,nj->ni", axes, moved.source - centre)
    translation = seen - np.einsum("nij,nj->ni", in_axes, apart)
    table = np.concatenate([translation, rotation_vectors(in_axes)], axis=1)
    return RigidMotion.of(nominal, table)


def without_rigid_gauge(
    motion: RigidMotion,
    nominal: ConeBeamGeometry,
    points: Floats,
    reference: RigidMotion | None = None,
) -> RigidMotion:
    """Return a motion without what a movement of the sample as a whole explains.

    The sample is moved so that the moved views project points of it as nearly as possible, by least
    squares, to where the reference does; a mean translation along the beam, which is the sample's
    size, is taken out.

    Parameters
    ----------
    motion : RigidMotion
        As found.
    nominal : ConeBeamGeometry
        Before any motion.
    points : ndarray, (n, 3)
        Of the sample [mm]; some hundred will do.
    reference : RigidMotion, optional
        Whose movement of the sample is kept; no motion by default.
    """
    target = nominal if reference is None else nominal.with_motion(reference)
    wanted = target.project(points)
    geometry = nominal.with_motion(motion)
    radius = float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())
    steps = np.diag([_STEP * radius] * 3 + [_STEP] * 3)
    moved = np.zeros(6)

    def projected(by: Floats) -> Floats:
        turn = rotation_matrices(by[None, 3:])[0]
        return geometry.project(points @ turn.T + by[:3])

    for _ in range(_ROUNDS):
        error = (projected(moved) - wanted).ravel()
        columns = [
            ((projected(moved + h) - projected(moved - h)) / (2 * h.max())).ravel() for h in steps
        ]
        moved = moved - np.linalg.lstsq(np.stack(columns, axis=1), error, rcond=1e-8)[0]
    turn = rotation_matrices(moved[None, 3:])[0]
    anchored = ConeBeamGeometry(
        source=(geometry.source - moved[:3]) @ turn,
        detector=(geometry.detector - moved[:3]) @ turn,
        u=geometry.u @ turn,
        v=geometry.v @ turn,
        shape=geometry.shape,
    )
    table = between(nominal, anchored).table
    kept = 0.0 if reference is None else reference.table[:, 2].mean()
    table[:, 2] += kept - table[:, 2].mean()
    return motion.with_table(table)
