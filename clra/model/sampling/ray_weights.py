"""Weights of rays that a circular scan measures twice: short scans and offset detectors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.model.geometry import ConeBeamGeometry
from clra.model.sampling.angular_coverage import covered, holes, is_circle
from clra.model.sampling.field_of_view import is_offset, side_distances

Floats = NDArray[np.float64]

# Part of the detector's width over which an offset detector's weight rises, at most: a longer rise
# counts the noise of rays that both sides see less evenly, a shorter one is an edge to the filter.
_RISE = 0.2
# Part of the views whose near side may lie nearer than is reckoned with.
_NEARER = 0.02
# What rounding leaves of a length that is 0.
_ABRUPT = 1e-9


@dataclass(frozen=True, eq=False)
class RayWeights:
    """Weights that add up to 1 over the two rays that measure the same line.

    ``w = c(b) d(s) / (c(b) d(s) + c(b') d(-s))`` for a ray from the source at angle b that passes
    the axis at distance s; b' is where its line meets the circle again. c rises smoothly from the
    ends of the arc [1]_, with the overlap beyond half a turn much as Parker's weights [2]_ do; d
    rises smoothly from the near side of an offset detector, as in [3]_. A line that is measured
    once has weight 1.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of a circle or an arc.
    missing : ndarray, (holes, 2)
        Where an arc has no views: start and width [rad], angles as in
        :func:`clra.model.sampling.angular_coverage.holes`.
    covered : float
        Part of the turn that has views [rad].
    near : float
        Distance from the axis to the near side of an offset detector [mm]; infinite if it is not
        offset.
    rise : float
        Distance over which d rises [mm].
    far_sign : float
        1 if the far side is counter-clockwise of the axis as the source sees it, -1 if clockwise.

    References
    ----------
    .. [1] F. Noo et al., "Image reconstruction from fan-beam projections on less than a short
       scan", Phys. Med. Biol. 47, 2525 (2002).
    .. [2] D. L. Parker, "Optimal short scan convolution reconstruction for fan beam CT", Med. Phys.
       9, 254 (1982).
    .. [3] G. Wang, "X-ray micro-CT with a displaced detector array", Med. Phys. 29, 1634 (2002).
    """

    geometry: ConeBeamGeometry
    missing: Floats
    covered: float
    near: float = math.inf
    rise: float = 1.0
    far_sign: float = 1.0

    @property
    def beyond(self) -> tuple[int, int]:
        """Columns left and right of an offset detector that it lacks to be centred on the axis."""
        if math.isinf(self.near):
            return 0, 0
        geometry = self.geometry
        beside = geometry.source * [0, 0, 1]
        matrices = geometry.projection_matrices()
        foot = np.einsum("vij,vj->vi", matrices[:, :, :3], beside) + matrices[:, :, 3]
        axis = foot[:, 0] / foot[:, 2]
        left, right = axis + 0.5, geometry.columns - 0.5 - axis
        lacking = math.ceil(max(left.max() - right.min(), right.max() - left.min()) - _ABRUPT)
        return (max(0, lacking), 0) if np.median(left) < np.median(right) else (0, max(0, lacking))

    def at(self, columns: ArrayLike, views: slice | None = None) -> Floats:
        """Return the weights of some columns.

        Parameters
        ----------
        columns : array_like, (n,)
            Places along the detector's rows [pixel].
        views : slice, optional
            All by default.

        Returns
        -------
        ndarray, (views, n)
            From 0 to 1.
        """
        here = self.geometry if views is None else self.geometry.subset(views)
        place = np.asarray(columns, np.float64) - (here.columns - 1) / 2
        row = here.principal[:, 1] - (here.rows - 1) / 2
        middle = here.detector + row[:, None] * here.v - here.source
        ray = middle[:, None, :2] + place[:, None] * here.u[:, None, :2]
        x, y = here.source[:, 0, None], here.source[:, 1, None]
        # Angle from the way to the axis to the ray, counter-clockwise.
        fan = np.arctan2(-x * ray[..., 1] + y * ray[..., 0], -x * ray[..., 0] - y * ray[..., 1])
        distance = np.hypot(x, y) * np.sin(fan)
        angle = np.arctan2(x, -y)
        this = self._from_ends(angle) * self._from_side(distance)
        other = self._from_ends(angle + math.pi + 2 * fan) * self._from_side(-distance)
        return np.asarray(this / np.maximum(this + other, np.finfo(np.float64).tiny))

    def subset(self, index: slice | ArrayLike) -> RayWeights:
        """Return the weights of some of the views, which stay what they are among all."""
        return replace(self, geometry=self.geometry.subset(index))

    def _from_ends(self, angle: Floats) -> Floats:
        """c: 0 where there are no views."""
        depth = np.full(angle.shape, math.inf)
        for start, width in self.missing:
            inside = (angle - start) % (2 * math.pi) - width
            depth = np.minimum(depth, np.minimum(inside, 2 * math.pi - width - inside))
        return _rise(depth, self.covered - math.pi)

    def _from_side(self, distance: Floats) -> Floats:
        """d: 0 beyond the near side."""
        return _rise(self.near + self.far_sign * distance, self.rise)


def ray_weights(geometry: ConeBeamGeometry) -> RayWeights | None:
    """Return the weights of a scan's rays, if they are not all alike.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of any trajectory.

    Returns
    -------
    RayWeights or None
        None of what is no circle, of whole circles whose detector sees equally far on both sides
        of the axis, and of less than half a circle.
    """
    if geometry.views < 2 or not is_circle(geometry):
        return None
    missing, angle = holes(geometry), covered(geometry)
    if is_offset(geometry):
        sides = side_distances(geometry)
        far = int(np.median(sides, axis=0).argmax())
        near = float(np.quantile(sides[:, 1 - far], _NEARER))
        rise = min(2 * near, _RISE * float(np.median(sides.sum(axis=1))))
        x, y = geometry.source[:, 0], geometry.source[:, 1]
        turns = np.median(np.sign(y * geometry.u[:, 0] - x * geometry.u[:, 1]))
        return RayWeights(geometry, missing, angle, near, rise, float(turns) * (2 * far - 1))
    if not len(missing) or angle < math.pi:
        return None
    return RayWeights(geometry, missing, angle)


def widened(geometry: ConeBeamGeometry, left: int, right: int) -> ConeBeamGeometry:
    """Return the geometry of a detector with more columns before the first and after the last."""
    if not left and not right:
        return geometry
    return ConeBeamGeometry(
        source=geometry.source,
        detector=geometry.detector + 0.5 * (right - left) * geometry.u,
        u=geometry.u,
        v=geometry.v,
        shape=(geometry.rows, geometry.columns + left + right),
    )


def _rise(depth: Floats, over: float) -> Floats:
    """Rise smoothly from 0 to 1."""
    part = np.clip(depth / max(over, _ABRUPT), 0.0, 1.0)
    return np.asarray(np.sin(0.5 * math.pi * part) ** 2)
