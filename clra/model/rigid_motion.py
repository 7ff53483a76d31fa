"""Rigid motion of the sample in each view: three translations and three rotations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError
from clra.model.validation import same_views, vectors, whole

if TYPE_CHECKING:
    from clra.model.geometry import ConeBeamGeometry
    from clra.model.motion import Motion

Floats = NDArray[np.float64]

PARAMETERS = ("along_u", "along_v", "along_beam", "tilt", "spin", "roll")
"""Translations [mm] along, then rotations [rad] about, a view's u, v and beam axes."""


@dataclass(frozen=True, init=False, eq=False, repr=False)
class RigidMotion:
    """How the sample moved in each view, in the axes of that view's detector.

    The axes are those of u, of v and of the detector's normal, which points away from the source;
    the origin is the point at the depth of the rotation axis on the perpendicular from the source
    to the detector, whichever part of the detector is used. A point of the sample that the ideal
    geometry has at X in these axes lies at ``Exp(rotation) X + translation``. Detectors whose rows and columns are not perpendicular are
    refused where a geometry absorbs the motion.

    Parameters
    ----------
    translation : array_like, (views, 3)
        Along u (toward higher columns), v (toward higher rows) and the beam (toward the detector)
        [mm at the sample].
    rotation : array_like, (views, 3)
        Rotation vector about the same axes [rad]; a roll is positive from u toward v.

    Raises
    ------
    InputError
        If shapes disagree or a number is not finite.
    """

    translation: Floats
    rotation: Floats

    def __init__(self, *, translation: ArrayLike, rotation: ArrayLike) -> None:
        object.__setattr__(self, "translation", vectors("translation", translation, "views"))
        object.__setattr__(self, "rotation", vectors("rotation", rotation, "views"))
        same_views(translation=self.translation, rotation=self.rotation)

    @classmethod
    def identity(cls, views: int) -> RigidMotion:
        """Return no motion of `views` views."""
        still = np.zeros((whole("views", views), 3))
        return cls(translation=still, rotation=still)

    @classmethod
    def from_table(cls, table: ArrayLike) -> RigidMotion:
        """Return the motion whose numbers are (views, 6), in the order of :data:`PARAMETERS`."""
        numbers = np.asarray(table, np.float64)
        return cls(translation=numbers[:, :3], rotation=numbers[:, 3:])

    @classmethod
    def from_shifts(cls, motion: Motion, geometry: ConeBeamGeometry) -> RigidMotion:
        """Return the translations that show at the depth of the axis what a `Motion` shows.

        Parameters
        ----------
        motion : Motion
            Shifts and magnifications of the detector's images.
        geometry : ConeBeamGeometry
            Ideal one, of the same views.
        """
        if motion.cause != "detector":
            raise InputError("motion: found one of the source, expected shifts of the radiographs")
        near, far = geometry.source_to_axis, geometry.source_to_detector
        pixel = np.stack([np.linalg.norm(a, axis=1) for a in (geometry.u, geometry.v)], axis=1)
        depth = near / motion.magnification  # what is nearer to the source appears larger
        shifts = np.stack([motion.shift_u, motion.shift_v], axis=1)
        shifts -= _about_centre(geometry, motion.magnification)
        table = np.zeros((motion.views, 6))
        table[:, :2] = shifts * pixel * (depth / far)[:, None]
        table[:, 2] = depth - near
        return cls.from_table(table)

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.translation)

    def __len__(self) -> int:
        """Return the number of views."""
        return self.views

    def __eq__(self, other: object) -> bool:
        """Compare exactly, number by number."""
        if not isinstance(other, RigidMotion):
            return NotImplemented
        return np.array_equal(self.table, other.table)

    def __repr__(self) -> str:
        """Summarise the ranges."""
        far = np.abs(self.translation).max(axis=0)
        turned = np.degrees(np.abs(self.rotation).max(axis=0))
        return (
            f"RigidMotion({self.views} views, translations up to "
            f"{', '.join(f'{t:.4g}' for t in far)} mm along u, v and the beam, rotations up to "
            f"{', '.join(f'{r:.4g}' for r in turned)} degrees about them)"
        )

    @property
    def table(self) -> Floats:
        """All numbers, (views, 6), in the order of :data:`PARAMETERS`."""
        return np.concatenate([self.translation, self.rotation], axis=1)

    def then(self, residual: RigidMotion) -> RigidMotion:
        """Return this motion followed by `residual`.

        Parameters
        ----------
        residual : RigidMotion
            In the axes of the views that have absorbed this motion.

        Raises
        ------
        InputError
            If it is of another number of views.
        """
        if residual.views != self.views:
            raise InputError(f"residual: found {residual.views} views, expected {self.views}")
        turn = rotation_matrices(residual.rotation)
        moved = np.einsum("nij,nj->ni", turn, self.translation) + residual.translation
        together = turn @ rotation_matrices(self.rotation)
        return RigidMotion(translation=moved, rotation=rotation_vectors(together))

    def inverse(self) -> RigidMotion:
        """Return the motion that undoes this one: ``motion.then(motion.inverse())`` is none."""
        back = rotation_matrices(-self.rotation)
        moved = -np.einsum("nij,nj->ni", back, self.translation)
        return RigidMotion(translation=moved, rotation=-self.rotation)

    def about(self, offset_u: float, offset_v: float) -> RigidMotion:
        """Return the same motion, which no window of the detector changes, see `Motion.about`."""
        return self

    def subset(self, index: ArrayLike) -> RigidMotion:
        """Return the motion of some views."""
        chosen = np.asarray(index)
        return RigidMotion(translation=self.translation[chosen], rotation=self.rotation[chosen])

    def in_pixels(self, geometry: ConeBeamGeometry) -> Floats:
        """Return what a point at the depth of the axis shows of it, (views, 6).

        Translations along u and v in pixels of the detector, the one along the beam as a change of
        the magnification, rotations in degrees.
        """
        near, far = geometry.source_to_axis, geometry.source_to_detector
        table = self.table
        depth = near + table[:, 2]
        aside = _about_centre(geometry, near / depth)
        for k, step in enumerate((geometry.u, geometry.v)):
            table[:, k] *= far / depth / np.linalg.norm(step, axis=1)
            table[:, k] += aside[:, k]
        table[:, 2] = near / depth - 1
        table[:, 3:] = np.degrees(table[:, 3:])
        return table


def absorb(geometry: ConeBeamGeometry, motion: RigidMotion) -> dict[str, Floats]:
    """Return the four vectors, by name, of views that see the sample as it had moved.

    Turning the sample by R about c and moving it by t is turning source and detector back:
    a point a of them goes to ``R^T (a - c - t) + c``, a vector to its rotation.
    """
    if motion.views != geometry.views:
        raise InputError(f"motion: found {motion.views} views, expected {geometry.views}")
    axes = view_axes(geometry)
    centre = turning_centre(geometry)
    moved = np.einsum("nij,nj->ni", axes, motion.translation)
    back = rotation_matrices(-np.einsum("nij,nj->ni", turning_axes(axes), motion.rotation))

    def turned(vectors: Floats) -> Floats:
        return np.asarray(np.einsum("nij,nj->ni", back, vectors))

    return {
        "source": turned(geometry.source - centre - moved) + centre,
        "detector": turned(geometry.detector - centre - moved) + centre,
        "u": turned(geometry.u),
        "v": turned(geometry.v),
    }


def turning_centre(geometry: ConeBeamGeometry) -> Floats:
    """Return the origin of each view's axes, (views, 3) [mm]."""
    return np.asarray(geometry.source + geometry.normal * geometry.source_to_axis[:, None])


def _about_centre(geometry: ConeBeamGeometry, magnification: Floats) -> Floats:
    """Shift with which magnifying about the principal point is magnifying about the centre."""
    centre = np.array([geometry.columns - 1, geometry.rows - 1]) / 2
    return np.asarray((1 - magnification)[:, None] * (geometry.principal - centre))


def view_axes(geometry: ConeBeamGeometry) -> Floats:
    """Return unit vectors of u, v and the normal as columns, (views, 3, 3).

    Raises
    ------
    InputError
        If rows and columns of a detector are not perpendicular.
    """
    u, v = (a / np.linalg.norm(a, axis=1)[:, None] for a in (geometry.u, geometry.v))
    skew = np.abs(np.einsum("ni,ni->n", u, v))
    if skew.max() > 1e-6:
        raise InputError(
            f"geometry: rows and columns of view {int(skew.argmax())} are "
            f"{np.degrees(np.arccos(skew.max())):.4g} degrees apart, expected 90 for rigid motion"
        )
    return np.stack([u, v, geometry.normal], axis=2)


def turning_axes(axes: Floats) -> Floats:
    """Return the axes of turns: those of a left-handed view are reversed."""
    return np.asarray(axes * np.linalg.det(axes)[:, None, None])


def rotation_matrices(rotation: Floats) -> Floats:
    """Return the matrices of rotation vectors, (n, 3) to (n, 3, 3); Rodrigues' formula."""
    angle = np.linalg.norm(rotation, axis=1)[:, None, None]
    x, y, z = rotation.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    # sin(a) / a and (1 - cos(a)) / a^2, without loss of digits at small angles
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


def rotation_vectors(matrices: Floats) -> Floats:
    """Return the rotation vectors of matrices, (n, 3, 3) to (n, 3), of less than 180 degrees."""
    axis = 0.5 * np.stack(
        [
            matrices[:, 2, 1] - matrices[:, 1, 2],
            matrices[:, 0, 2] - matrices[:, 2, 0],
            matrices[:, 1, 0] - matrices[:, 0, 1],
        ],
        axis=1,
    )
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(matrices, axis1=1, axis2=2) - 1))
    return np.asarray(axis * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-300), 1.0)[:, None])
