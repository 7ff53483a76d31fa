"""The acquisition geometry: where source and detector stood in each view."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError
from clra.model.rigid.rigid_motion import RigidMotion, absorb
from clra.model.validation import detector_shape, same_views, selection, vectors, whole

if TYPE_CHECKING:
    from clra.model.motion import Motion

Floats = NDArray[np.float64]

# Ratios of lengths below which a detector counts as degenerate: float64 rounding leaves 1e-16, and
# no scanner has an angle of 1e-9 between its rows and columns.
_DEGENERATE = 1e-9


@dataclass(frozen=True, init=False, eq=False, repr=False)
class ConeBeamGeometry:
    """Source and detector of every view, in a right-handed frame fixed to the sample.

    The z axis is the rotation axis. The centre of pixel (row j, column i) of a view is
    ``detector + (i - (columns - 1) / 2) u + (j - (rows - 1) / 2) v``; these are the numbers of
    ASTRA's ``cone_vec``. Values are checked and copied; the arrays are read-only.

    Parameters
    ----------
    source : array_like, (views, 3)
        Position (x, y, z) of the source [mm].
    detector : array_like, (views, 3)
        Position of the detector's centre [mm].
    u, v : array_like, (views, 3)
        Step from one column, and from one row, to the next [mm].
    shape : (int, int)
        Rows and columns of the detector.

    Raises
    ------
    InputError
        If shapes disagree, a number is not finite, ``u`` and ``v`` are parallel, or the source is
        in the detector's plane.
    """

    source: Floats
    detector: Floats
    u: Floats
    v: Floats
    shape: tuple[int, int]

    def __init__(
        self,
        *,
        source: ArrayLike,
        detector: ArrayLike,
        u: ArrayLike,
        v: ArrayLike,
        shape: tuple[int, int],
    ) -> None:
        object.__setattr__(self, "source", vectors("source", source, "views"))
        object.__setattr__(self, "detector", vectors("detector", detector, "views"))
        object.__setattr__(self, "u", vectors("u", u, "views"))
        object.__setattr__(self, "v", vectors("v", v, "views"))
        object.__setattr__(self, "shape", detector_shape(shape))
        same_views(source=self.source, detector=self.detector, u=self.u, v=self.v)
        self._refuse_degenerate()

    def _refuse_degenerate(self) -> None:
        """Raise where a detector is no plane or its source lies in it."""
        pitch_u, pitch_v = _norm(self.u), _norm(self.v)
        area = _norm(np.cross(self.u, self.v))
        _refuse(area <= _DEGENERATE * pitch_u * pitch_v, "u and v: parallel or zero", "a plane")
        ray = self.detector - self.source
        reach = _norm(ray) + self.columns * pitch_u + self.rows * pitch_v
        depth = np.abs(_dot(np.cross(self.u, self.v), ray)) / area
        _refuse(
            depth <= _DEGENERATE * reach, "source: in the detector's plane", "one off the plane"
        )

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.source)

    @property
    def rows(self) -> int:
        """Rows of the detector."""
        return self.shape[0]

    @property
    def columns(self) -> int:
        """Columns of the detector."""
        return self.shape[1]

    def __len__(self) -> int:
        """Return the number of views."""
        return self.views

    def __eq__(self, other: object) -> bool:
        """Compare exactly, number by number."""
        if not isinstance(other, ConeBeamGeometry):
            return NotImplemented
        return self.shape == other.shape and np.array_equal(self.to_astra(), other.to_astra())

    def __repr__(self) -> str:
        """Summarise views, detector, distances, travel, sense of rotation and order of rows."""
        z = self.source[:, 2]
        angle = np.arctan2(self.u[:, 1], self.u[:, 0])
        # Steps of more than half a turn count as shorter ones the other way.
        step = np.sum(np.sign((np.diff(angle) + np.pi) % (2 * np.pi) - np.pi))
        turns = "turns cw" if step > 0 else "turns ccw" if step < 0 else "stands"
        row0 = "bottom" if np.median(self.v[:, 2]) >= 0 else "top"
        pixel = f"{np.median(_norm(self.u)):.4g} x {np.median(_norm(self.v)):.4g}"
        return (
            f"ConeBeamGeometry({self.views} views of {self.rows} x {self.columns} pixels, "
            f"pixel {pixel} mm, source to axis {np.median(self.source_to_axis):.4g} mm, "
            f"to detector {np.median(self.source_to_detector):.4g} mm, "
            f"source z {z.min():.4g} to {z.max():.4g} mm, sample {turns}, "
            f"row 0 at the {row0})"
        )

    @property
    def axial(self) -> bool:
        """Whether the rows are stacked along z in every view, so that the fast kernels apply."""
        return bool(np.all(np.abs(self.v[:, :2]) <= 1e-9 * _norm(self.v)[:, None]))

    @property
    def normal(self) -> Floats:
        """Unit normal of the detector that points away from the source, (views, 3)."""
        normal = np.cross(self.u, self.v)
        away = np.sign(_dot(normal, self.detector - self.source))
        return np.asarray(normal * (away / _norm(normal))[:, None])

    @property
    def source_to_detector(self) -> Floats:
        """Distance from the source to the detector's plane, (views,) [mm]."""
        return _dot(self.normal, self.detector - self.source)

    @property
    def source_to_axis(self) -> Floats:
        """Distance along `normal` from the source to the axis at its height, (views,) [mm]."""
        return -_dot(self.normal[:, :2], self.source[:, :2])

    @property
    def principal(self) -> Floats:
        """(column, row) of the foot of the perpendicular from the source, (views, 2) [pixel]."""
        foot = self.source + self.normal * self.source_to_detector[:, None] - self.detector
        basis = np.stack([self.u, self.v, self.normal], axis=2)
        return np.linalg.solve(basis, foot[:, :, None])[:, :2, 0] + self._centre

    @property
    def _centre(self) -> Floats:
        return np.array([(self.columns - 1) / 2, (self.rows - 1) / 2])

    def with_motion(self, motion: Motion) -> ConeBeamGeometry:
        """Absorb the motion of each view, so that no radiograph is resampled.

        A point that this geometry puts at pixel q, the returned one puts at
        ``c + magnification (q - c) + shift``, with c the detector's centre and q = (column, row);
        for a motion of the source, only if the point lies at the depth of the axis.

        Parameters
        ----------
        motion : Motion
            In pixels of this geometry's detector: absorb first, bin after.

        Returns
        -------
        ConeBeamGeometry
            With u / m, v / m and detector - (shift_u u + shift_v v) / m, or with the source moved.

        Raises
        ------
        InputError
            If it is of another number of views.
        """
        if isinstance(motion, RigidMotion):
            return ConeBeamGeometry(**absorb(self, motion), shape=self.shape)
        if motion.views != self.views:
            raise InputError(f"motion: found {motion.views} views, expected {self.views}")
        if motion.cause == "source":
            source = self.source + self.source_displacement(motion)
            return replace(self, source=source)
        u = self.u / motion.magnification[:, None]
        v = self.v / motion.magnification[:, None]
        detector = self.detector - motion.shift_u[:, None] * u - motion.shift_v[:, None] * v
        return ConeBeamGeometry(source=self.source, detector=detector, u=u, v=v, shape=self.shape)

    def source_displacement(self, motion: Motion) -> Floats:
        """Return how the source moved if that is what moved the radiographs.

        Parameters
        ----------
        motion : Motion
            Apparent motion of what lies at the depth of the axis, in pixels of this detector.

        Returns
        -------
        ndarray, (views, 3)
            Displacement (x, y, z) of the source [mm]: along the detector ``-shift pitch / (M' -
            1)``, the magnification taken about the principal point, and toward it until SDD / SOD
            has become M' = m SDD / SOD.
        """
        to_axis, to_detector = self.source_to_axis, self.source_to_detector
        magnified = motion.magnification * to_detector / to_axis
        lateral = np.stack([motion.shift_u, motion.shift_v], axis=1)
        lateral -= (1 - motion.magnification)[:, None] * (self.principal - self._centre)
        lateral /= (1 - magnified)[:, None]
        toward = (magnified * to_axis - to_detector) / (magnified - 1)
        return np.asarray(
            lateral[:, :1] * self.u + lateral[:, 1:] * self.v + toward[:, None] * self.normal
        )

    def binned(self, factor: int = 2) -> ConeBeamGeometry:
        """Return the geometry of radiographs averaged over blocks of pixels.

        The last rows and columns that fill no whole block are dropped and the centre of the
        detector moves with them, so that every pixel stays where it was.

        Parameters
        ----------
        factor : int
            Rows and columns of a block.

        Raises
        ------
        InputError
            If it is less than 1 or more than the detector has.
        """
        factor = whole("factor", factor)
        rows, columns = self.rows // factor, self.columns // factor
        if not rows or not columns:
            most = f"{min(self.shape)} to bin {self.rows} x {self.columns} pixels"
            raise InputError(f"factor: found {factor}, expected at most {most}")
        lost_u, lost_v = self.columns - columns * factor, self.rows - rows * factor
        return ConeBeamGeometry(
            source=self.source,
            detector=self.detector - 0.5 * (lost_u * self.u + lost_v * self.v),
            u=self.u * factor,
            v=self.v * factor,
            shape=(rows, columns),
        )

    def subset(self, index: slice | ArrayLike) -> ConeBeamGeometry:
        """Return some of the views.

        Parameters
        ----------
        index : slice, int, integers or boolean mask (views,)
            Which views, in that order.
        """
        chosen = selection(index)
        names = ("source", "detector", "u", "v")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    def projection_matrices(self) -> Floats:
        """Return the matrices that project points to pixels.

        Returns
        -------
        ndarray, (views, 3, 4)
            P with (a, b, g) = P (x, y, z, 1): column = a / g and row = b / g, 0-based. g is the
            depth of the point as a fraction of the detector's: 0 at the source, 1 on the detector.
        """
        rotation = self._to_pixels()
        return np.concatenate([rotation, -rotation @ self.source[:, :, None]], axis=2)

    def project(self, points: ArrayLike) -> Floats:
        """Project points to pixels.

        Parameters
        ----------
        points : array_like, (n, 3)
            Positions (x, y, z) [mm].

        Returns
        -------
        ndarray, (views, n, 2)
            (column, row), 0-based; NaN for a point that is not in front of the source.

        Raises
        ------
        InputError
            If the points are of another shape.
        """
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"points: found shape {points.shape}, expected (n, 3)")
        rotation = self._to_pixels()
        # Differences first: P (x, 1) would cancel digits where the source is far away.
        image = (points - self.source[:, None, :]) @ rotation.transpose(0, 2, 1)
        depth = image[..., 2:]
        return image[..., :2] / np.where(depth > 0, depth, np.nan)

    def _to_pixels(self) -> Floats:
        """K [u | v | detector - source]^-1: from a direction at the source to (a, b, g)."""
        basis = np.stack([self.u, self.v, self.detector - self.source], axis=2)
        inverse = np.linalg.inv(basis)
        inverse[:, :2] += self._centre[:, None] * inverse[:, 2:]
        return inverse

    def to_astra(self) -> Floats:
        """Return the vectors of ASTRA's ``cone_vec``: source, detector, u, v; (views, 12)."""
        return np.concatenate([self.source, self.detector, self.u, self.v], axis=1)

    @classmethod
    def from_astra(cls, vectors: ArrayLike, shape: tuple[int, int]) -> ConeBeamGeometry:
        """Build from the vectors of ASTRA's ``cone_vec``.

        Parameters
        ----------
        vectors : array_like, (views, 12)
            Source, detector, u and v of each view [mm].
        shape : (int, int)
            Rows and columns of the detector.

        Raises
        ------
        InputError
            If the vectors are of another shape, or no geometry.
        """
        numbers = np.asarray(vectors, dtype=np.float64)
        if numbers.ndim != 2 or numbers.shape[1] != 12:
            raise InputError(f"vectors: found shape {numbers.shape}, expected (views, 12)")
        source, detector, u, v = np.split(numbers, 4, axis=1)
        return cls(source=source, detector=detector, u=u, v=v, shape=shape)


def _refuse(bad: NDArray[np.bool_], found: str, expected: str) -> None:
    """Raise for the first view for which `bad` holds."""
    if bad.any():
        raise InputError(f"{found} in view {int(np.argmax(bad))}, expected {expected}")


def _norm(vectors: Floats) -> Floats:
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.sum(a * b, axis=-1))
