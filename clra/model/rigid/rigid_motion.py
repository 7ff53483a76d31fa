"""Rigid motion of the sample in each view: three translations and three rotations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError
from clra.model.motion import Motion
from clra.model.validation import same_views, selection, vectors

Floats = NDArray[np.float64]

PARAMETERS = ("along_u", "along_v", "along_beam", "tilt", "spin", "roll")
"""Translations [mm] along, then rotations [rad] about, a view's u, v and beam axes."""


class ViewPoses(Protocol):
    """What of a :class:`clra.ConeBeamGeometry` a motion needs to know."""

    @property
    def source(self) -> Floats: ...  # noqa: D102
    @property
    def detector(self) -> Floats: ...  # noqa: D102
    @property
    def u(self) -> Floats: ...  # noqa: D102
    @property
    def v(self) -> Floats: ...  # noqa: D102
    @property
    def views(self) -> int: ...  # noqa: D102
    @property
    def rows(self) -> int: ...  # noqa: D102
    @property
    def columns(self) -> int: ...  # noqa: D102
    @property
    def normal(self) -> Floats: ...  # noqa: D102
    @property
    def principal(self) -> Floats: ...  # noqa: D102
    @property
    def source_to_axis(self) -> Floats: ...  # noqa: D102
    @property
    def source_to_detector(self) -> Floats: ...  # noqa: D102


@dataclass(frozen=True, init=False, eq=False, repr=False)
class RigidMotion(Motion):
    """How the sample moved in each view, in the axes of that view's detector.

    The axes are those of u, of v and of the detector's normal, which points away from the source;
    the origin is the point at the depth of the rotation axis on the perpendicular from the source
    to the detector, whichever part of the detector is used. A point of the sample that the ideal
    geometry has at X in these axes lies at ``Exp(rotation) X + translation``. Its `shift_u`,
    `shift_v` and `magnification` are those of a point at the depth of the axis.

    Parameters
    ----------
    translation : array_like, (views, 3)
        Along u (toward higher columns), v (toward higher rows) and the beam (toward the detector)
        [mm at the sample].
    rotation : array_like, (views, 3)
        Rotation vector about the same axes [rad]; a roll is positive from u toward v.
    optics : array_like, (views, 5)
        As :func:`optics_of` gives it for the ideal geometry.

    Raises
    ------
    InputError
        If shapes disagree or a number is not finite.
    """

    translation: Floats
    rotation: Floats
    optics: Floats

    def __init__(self, *, translation: ArrayLike, rotation: ArrayLike, optics: ArrayLike) -> None:
        object.__setattr__(self, "translation", vectors("translation", translation, "views"))
        object.__setattr__(self, "rotation", vectors("rotation", rotation, "views"))
        known = np.array(optics, np.float64)
        if known.ndim != 2 or known.shape[1] != 5 or not np.isfinite(known).all():
            raise InputError(f"optics: found shape {known.shape}, expected finite (views, 5)")
        known.flags.writeable = False
        object.__setattr__(self, "optics", known)
        same_views(translation=self.translation, rotation=self.rotation, optics=known)
        near, per_u, per_v, aside_u, aside_v = known.T
        depth = near + self.translation[:, 2]
        magnification = near / depth
        super().__init__(
            shift_u=self.translation[:, 0] * per_u / depth + (1 - magnification) * aside_u,
            shift_v=self.translation[:, 1] * per_v / depth + (1 - magnification) * aside_v,
            magnification=magnification,
            cause="sample",
        )

    @classmethod
    def of(cls, geometry: ViewPoses, table: ArrayLike | None = None) -> RigidMotion:
        """Return a motion of the views of a geometry.

        Parameters
        ----------
        geometry : ConeBeamGeometry
            Ideal one.
        table : array_like, (views, 6), optional
            Numbers in the order of :data:`PARAMETERS`; no motion by default.
        """
        numbers = np.zeros((geometry.views, 6)) if table is None else np.asarray(table, np.float64)
        return cls(translation=numbers[:, :3], rotation=numbers[:, 3:], optics=optics_of(geometry))

    @classmethod
    def from_shifts(cls, motion: Motion, geometry: ViewPoses) -> RigidMotion:
        """Return the translations that show at the depth of the axis what a `Motion` shows.

        Parameters
        ----------
        motion : Motion
            Shifts and magnifications, whatever caused them.
        geometry : ConeBeamGeometry
            Ideal one, of the same views.
        """
        near, per_u, per_v, aside_u, aside_v = optics_of(geometry).T
        depth = near / motion.magnification  # what is nearer to the source appears larger
        lost = 1 - motion.magnification
        table = np.zeros((motion.views, 6))
        table[:, 0] = (motion.shift_u - lost * aside_u) * depth / per_u
        table[:, 1] = (motion.shift_v - lost * aside_v) * depth / per_v
        table[:, 2] = depth - near
        return cls.of(geometry, table)

    def columns(self) -> tuple[Floats, ...]:
        """Return all numbers that tell it from others, those of a view at one place in each."""
        return (*self.table.T, *self.optics.T)

    def with_table(self, table: Floats) -> RigidMotion:
        """Return a motion of the same views with other numbers, (views, 6)."""
        return RigidMotion(translation=table[:, :3], rotation=table[:, 3:], optics=self.optics)

    def __eq__(self, other: object) -> bool:
        """Compare exactly, number by number."""
        if not isinstance(other, RigidMotion):
            return NotImplemented
        return np.array_equal(self.table, other.table) and np.array_equal(self.optics, other.optics)

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

    def then(self, residual: Motion) -> RigidMotion:
        """Return this motion followed by `residual`.

        Parameters
        ----------
        residual : RigidMotion
            In the axes of the views that have absorbed this motion.

        Raises
        ------
        InputError
            If it is of another number of views, or no rigid motion.
        """
        if not isinstance(residual, RigidMotion) or residual.views != self.views:
            raise InputError(f"residual: found {residual!r}, expected {self.views} rigid motions")
        turn = rotation_matrices(residual.rotation)
        moved = np.einsum("nij,nj->ni", turn, self.translation) + residual.translation
        together = rotation_vectors(turn @ rotation_matrices(self.rotation))
        return self.with_table(np.concatenate([moved, together], axis=1))

    def inverse(self) -> RigidMotion:
        """Return the motion that undoes this one: ``motion.then(motion.inverse())`` is none."""
        back = rotation_matrices(-self.rotation)
        moved = -np.einsum("nij,nj->ni", back, self.translation)
        return self.with_table(np.concatenate([moved, -self.rotation], axis=1))

    def normalised(self) -> RigidMotion:
        """Return the motion as it is: its gauge is another, see `without_rigid_gauge`."""
        return self

    def about(self, offset_u: float, offset_v: float) -> RigidMotion:
        """Return the same motion, whose shifts are those of another centre, see `Motion.about`."""
        optics = self.optics - np.array([0, 0, 0, offset_u, offset_v])
        return RigidMotion(translation=self.translation, rotation=self.rotation, optics=optics)

    def subset(self, index: slice | ArrayLike) -> RigidMotion:
        """Return the motion of some of the views."""
        chosen = selection(index)
        return RigidMotion(
            translation=self.translation[chosen],
            rotation=self.rotation[chosen],
            optics=self.optics[chosen],
        )


def optics_of(geometry: ViewPoses) -> Floats:
    """Return how views show translations, (views, 5).

    Columns are the distance from source to axis [mm], that to the detector in steps of columns and
    of rows, and column and row of the principal point from the detector's centre [pixel].
    """
    far = geometry.source_to_detector
    centre = np.array([geometry.columns - 1, geometry.rows - 1]) / 2
    per_u, per_v = (far / np.linalg.norm(step, axis=1) for step in (geometry.u, geometry.v))
    aside = geometry.principal - centre
    return np.stack([geometry.source_to_axis, per_u, per_v, aside[:, 0], aside[:, 1]], axis=1)


def absorb(geometry: ViewPoses, motion: RigidMotion) -> dict[str, Floats]:
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


def turning_centre(geometry: ViewPoses) -> Floats:
    """Return the origin of each view's axes, (views, 3) [mm]."""
    return np.asarray(geometry.source + geometry.normal * geometry.source_to_axis[:, None])


def view_axes(geometry: ViewPoses) -> Floats:
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
