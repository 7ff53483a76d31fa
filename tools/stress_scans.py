"""Simulated scans with anything wrong in them: the stage and detector in the laboratory's frame.

Nothing here uses clra's motions or trajectories. Source and detector stand still in the laboratory,
the sample is turned, lifted and moved; phantoms of ellipsoids are integrated in closed form along
the true rays. The truth is what is seen: points of the sample are projected by the geometry that is
reported and by the true one, and the shift and magnification that map one image to the other best
are fitted view by view. What they leave is the part of the motion that no alignment by shifts and
magnifications can find.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import clra
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.model.phantoms.wood import wood

Floats = NDArray[np.float64]

# Source to axis and magnification at the axis, in widths of the field of view: a half fan of 9
# degrees, as in a laboratory scanner close to its source.
_TO_AXIS, _TO_DETECTOR = 3.2, 16.0
_FIELD = 1.0  # width of the field of view at the axis [mm]
PARALLEL = 2000.0
"""Widths of the field of view to the source, and again to the detector, of a parallel beam."""


@dataclass(frozen=True)
class Stage:
    """What really stood where in each view; arrays of one value a view where nothing else is said.

    Attributes
    ----------
    shape : (int, int)
        Rows and columns of the detector.
    angle : ndarray
        Turn of the source about the sample, as clra's trajectories count it [rad].
    height : ndarray
        Rise of source and detector against the sample [pixel at the axis].
    shift : ndarray, (views, 2)
        Shift of the image along columns and rows [pixel].
    magnification : ndarray
        Of the image about the detector's centre.
    tilt : ndarray, (views, 2)
        Turn of the sample about the columns' direction and about the beam [rad].
    along : ndarray
        Shift of the sample along the beam [width of the field of view].
    size : ndarray
        Of the sample, relative to the first view's; its attenuation stays.
    offset : float
        Columns by which the axis is seen beside the detector's centre.
    parallel : bool
        Whether the source is far away.
    """

    shape: tuple[int, int]
    angle: Floats
    height: Floats
    shift: Floats
    magnification: Floats
    tilt: Floats
    along: Floats
    size: Floats
    offset: float = 0.0
    parallel: bool = False

    @classmethod
    def of(cls, shape: tuple[int, int], angle: Floats, height: Floats | float = 0.0) -> Stage:
        """Return a stage on which nothing moves but the rotation, and the lift."""
        views = len(angle)
        return cls(
            shape,
            np.asarray(angle, dtype=np.float64),
            np.zeros(views) + height,
            np.zeros((views, 2)),
            np.ones(views),
            np.zeros((views, 2)),
            np.zeros(views),
            np.ones(views),
        )

    @property
    def pixel(self) -> float:
        """Pixel seen at the axis [mm]."""
        return _FIELD / self.shape[1]

    def still(self) -> Stage:
        """Return the stage as the operator assumes it to be: nothing moves by mistake."""
        calm = Stage.of(self.shape, self.angle, self.height)
        return replace(calm, parallel=self.parallel)

    def geometry(self) -> clra.ConeBeamGeometry:
        """Return source and detector seen from the sample, lengths in its own size."""
        views = len(self.angle)
        to_axis, to_detector = (
            (PARALLEL, 2 * PARALLEL) if self.parallel else (_TO_AXIS, _TO_DETECTOR)
        )
        pitch = self.pixel * to_detector / to_axis
        # In the laboratory: x along the columns, y along the beam, z up.
        step = pitch / self.magnification
        aside = (self.shift + np.array([self.offset, 0.0])) * step[:, None]
        source = np.tile([0.0, -to_axis * _FIELD, 0.0], (views, 1))
        centre = np.stack(
            [-aside[:, 0], np.full(views, (to_detector - to_axis) * _FIELD), -aside[:, 1]], axis=1
        )
        columns = np.stack([step, 0 * step, 0 * step], axis=1)
        rows = np.stack([0 * step, 0 * step, step], axis=1)
        # A point P of the sample stands at T R P size + moved; a laboratory point X is seen at
        # R^-1 T^-1 (X - moved) / size.
        moved = np.stack([0 * self.along, self.along * _FIELD, -self.height * self.pixel], axis=1)
        back = np.einsum(
            "vij,vjk->vik", _about_z(self.angle), _tilted(self.tilt).transpose(0, 2, 1)
        )
        back /= self.size[:, None, None]

        def seen(vectors: Floats) -> Floats:
            return np.einsum("vij,vj->vi", back, vectors)

        return clra.ConeBeamGeometry(
            source=seen(source - moved),
            detector=seen(centre - moved),
            u=seen(columns),
            v=seen(rows),
            shape=self.shape,
        )


def radiographs(stage: Stage, phantom: Ellipsoids) -> NDArray[np.float32]:
    """Return the line integrals along the true rays."""
    return np.asarray(
        phantom.line_integrals(stage.geometry()) * stage.size[:, None, None], dtype=np.float32
    )


@dataclass(frozen=True)
class Truth:
    """What a perfect alignment finds, one row a view.

    Attributes
    ----------
    values : ndarray, (views, 3)
        Shift along u and v [pixel] and magnification.
    beyond : float
        RMS of what they leave of the displacements of points of the sample [pixel].
    """

    values: Floats
    beyond: float

    @property
    def motion(self) -> clra.Motion:
        """As clra's type."""
        u, v, m = self.values.T
        return clra.Motion(shift_u=u, shift_v=v, magnification=m)


def apparent(
    reported: clra.ConeBeamGeometry, actual: clra.ConeBeamGeometry, points: Floats
) -> Truth:
    """Fit the shift and magnification that map the reported image of points to the true one."""
    ideal, seen = _image(reported, points), _image(actual, points)
    middle = ideal.mean(axis=1, keepdims=True)
    spread = ideal - middle
    m = np.sum(spread * (seen - seen.mean(axis=1, keepdims=True)), axis=(1, 2))
    m /= np.sum(spread**2, axis=(1, 2))
    shift = (seen - m[:, None, None] * ideal).mean(axis=1)
    left = seen - m[:, None, None] * ideal - shift[:, None]
    beyond = float(np.sqrt(np.mean(left**2) * 2))
    # A magnification that no stage has: the geometry itself is another.
    usable = np.maximum(m, 0.1)
    return Truth(np.column_stack([shift, usable]), beyond)


def _image(geometry: clra.ConeBeamGeometry, points: Floats) -> Floats:
    """Columns and rows of points from the detector's centre, (views, points, 2)."""
    images = np.empty((geometry.views, len(points), 2))
    for view in range(geometry.views):
        source = geometry.source[view]
        basis = np.stack(
            [geometry.u[view], geometry.v[view], source - geometry.detector[view]], axis=1
        )
        # The ray t (point - source) = detector - source + column u + row v.
        a, b, c = np.linalg.solve(basis, (points - source).T)
        images[view] = np.stack([-a / c, -b / c], axis=1)
    return images


def cylinder_points(radius: float, height: float, count: int = 400) -> Floats:
    """Return points of the cylinder that the sample fills [mm]."""
    random = np.random.default_rng(0)
    angle, distance = 2 * np.pi * random.random(count), radius * np.sqrt(random.random(count))
    z = height * (random.random(count) - 0.5)
    return np.stack([distance * np.cos(angle), distance * np.sin(angle), z], axis=1)


def phantom(name: str, radius: float, height: float, seed: int) -> Ellipsoids:
    """Return a sample: "balls", "rock" (grains and pores in a body) or "wood"."""
    if name == "wood":
        return wood(radius, height, seed, fibre=0.12)
    random = np.random.default_rng([seed, 7])
    count, largest = (90, 0.2) if name == "balls" else (220, 0.16)
    sizes = radius * np.exp(random.uniform(np.log(0.05), np.log(largest), count))
    axes = sizes[:, None] * (1 if name == "balls" else random.uniform(0.6, 1.4, (count, 3)))
    axes = np.broadcast_to(axes, (count, 3))
    reach = axes.max(axis=1)
    angle, distance = 2 * np.pi * random.random(count), np.sqrt(random.random(count))
    inside = 0.82 * radius if name == "rock" else radius
    distance *= inside - reach
    half = (0.8 if name == "rock" else 1.0) * height / 2 - reach
    centres = np.stack(
        [
            distance * np.cos(angle),
            distance * np.sin(angle),
            np.maximum(half, 0) * random.uniform(-1, 1, count),
        ],
        axis=1,
    )
    if name == "balls":
        weight = random.uniform(1.0, 3.0, count) / radius
    else:
        weight = random.choice([-0.5, 0.5, 1.5], count) / (2 * radius)
        centres = np.concatenate([[[0.0, 0.0, 0.0]], centres])
        axes = np.concatenate([[[radius, 0.96 * radius, 0.6 * height]], axes])
        weight = np.concatenate([[1.0 / (2 * radius)], weight])
    return Ellipsoids(centres, axes, weight)


def flattened(body: Ellipsoids, part: float) -> Ellipsoids:
    """Squeeze a sample along y, and let it attenuate the more: as thick across, it is opaque."""
    if part == 1:
        return body
    squeeze = np.array([1.0, part, 1.0])
    return Ellipsoids(body.centres * squeeze, body.semi_axes * squeeze, body.attenuation / part)


def exposed(photons: float, exposures: float, views: int, seed: int) -> Floats:
    """Return the open beam's photons of each view, (views, 1, 1)."""
    random = np.random.default_rng([seed, 9])
    return np.asarray(photons * exposures ** random.uniform(-0.5, 0.5, (views, 1, 1)))


def counted(integrals: Floats, photons: Floats, seed: int) -> NDArray[np.float32]:
    """Return transmissions of which each pixel's open beam has so many photons."""
    random = np.random.default_rng([seed, 3])
    return np.asarray(random.poisson(photons * np.exp(-integrals)) / photons, dtype=np.float32)


@dataclass(frozen=True)
class Case:
    """A scan to be aligned, and what is right about it.

    Attributes
    ----------
    scan : Scan
        As it is reported: its geometry may be wrong.
    truth : Truth
        Of the reported geometry.
    points : ndarray, (n, 3)
        Of the sample.
    causes : tuple of str
        Codes of findings of which one should be named; empty where nothing is wrong.
    options : dict
        Of the alignment, beyond its defaults.
    """

    scan: clra.Scan
    truth: Truth
    points: Floats
    causes: tuple[str, ...] = ()
    options: dict[str, Any] = field(default_factory=dict)


def _about_z(angle: Floats) -> Floats:
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    rows = [[c, -s, zero], [s, c, zero], [zero, zero, zero + 1]]
    return np.moveaxis(np.array(rows), 2, 0)


def _tilted(tilt: Floats) -> Floats:
    """Turn about the columns' direction x, then about the beam y; (views, 3, 3)."""
    (cx, cy), (sx, sy) = np.cos(tilt.T), np.sin(tilt.T)
    zero, one = np.zeros_like(cx), np.ones_like(cx)
    about_x = np.array([[one, zero, zero], [zero, cx, -sx], [zero, sx, cx]])
    about_y = np.array([[cy, zero, sy], [zero, one, zero], [-sy, zero, cy]])
    return np.einsum("ijv,jkv->vik", about_y, about_x)
