"""Phantoms of ellipsoids, whose line integrals have a closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.validation import column, positive, vectors, whole

Floats = NDArray[np.float64]


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Ellipsoids:
    """Ellipsoids with axes along x, y, z; where they overlap, their attenuations add.

    Parameters
    ----------
    centres : array_like, (n, 3)
        Positions (x, y, z) [mm].
    semi_axes : array_like, (n, 3) or (n,)
        Half extents along x, y, z, or the radii of spheres [mm].
    attenuation : array_like, (n,)
        What each ellipsoid adds inside it [1/mm]; may be negative.

    Raises
    ------
    InputError
        If lengths disagree, a number is not finite or a semi-axis is not positive.
    """

    centres: Floats
    semi_axes: Floats
    attenuation: Floats

    def __init__(self, centres: ArrayLike, semi_axes: ArrayLike, attenuation: ArrayLike) -> None:
        axes = np.asarray(semi_axes, dtype=np.float64)
        if axes.ndim == 1:
            axes = np.repeat(axes[:, None], 3, axis=1)
        object.__setattr__(self, "centres", vectors("centres", centres, "ellipsoids"))
        object.__setattr__(self, "semi_axes", vectors("semi_axes", axes, "ellipsoids"))
        object.__setattr__(self, "attenuation", column("attenuation", attenuation, "ellipsoids"))
        for name in ("semi_axes", "attenuation"):
            found = len(getattr(self, name))
            if found != len(self):
                raise InputError(f"{name}: found {found} ellipsoids, expected {len(self)}")
        if self.semi_axes.min() <= 0:
            raise InputError(f"semi_axes: found {self.semi_axes.min()}, expected positive lengths")

    def __len__(self) -> int:
        """Return the number of ellipsoids."""
        return len(self.centres)

    def __repr__(self) -> str:
        """Summarise number and extent."""
        low = (self.centres - self.semi_axes).min(axis=0)
        high = (self.centres + self.semi_axes).max(axis=0)
        extent = " x ".join(f"{size:.4g}" for size in high - low)
        return f"Ellipsoids({len(self)} in {extent} mm)"

    def scaled(self, factor: float) -> Ellipsoids:
        """Return the same phantom with lengths in another unit; line integrals stay the same.

        Parameters
        ----------
        factor : float
            Lengths are multiplied by it, attenuations divided.
        """
        factor = positive("factor", factor)
        return Ellipsoids(self.centres * factor, self.semi_axes * factor, self.attenuation / factor)

    def line_integrals(
        self,
        geometry: ConeBeamGeometry,
        start: int = 0,
        stop: int | None = None,
        *,
        oversample: int = 1,
    ) -> NDArray[np.float32]:
        """Integrate the attenuation along the rays to the pixels.

        Only the pixels in each projection's bounding box are touched, so that hundreds of small
        ellipsoids are quick.

        Parameters
        ----------
        geometry : ConeBeamGeometry
            Where source and detector stood. A ray is the whole line through source and pixel.
        start, stop : int
            Range of views; all of them if not given.
        oversample : int
            Rays a pixel along each side, averaged; 1 is the ray through the pixel's centre.

        Returns
        -------
        ndarray of float32, (stop - start, rows, columns)
            Closed-form line integrals, computed in float64.

        Raises
        ------
        InputError
            If an ellipsoid reaches the plane through a source parallel to its detector.
        """
        oversample = whole("oversample", oversample)
        chosen = geometry.subset(slice(start, stop))
        matrices = chosen.projection_matrices()[:, :, :3]
        images = np.empty((chosen.views, *chosen.shape), dtype=np.float32)
        for view in range(chosen.views):
            image = np.zeros(chosen.shape)
            centres = self.centres - chosen.source[view]
            projection, boxes = self._shadows(matrices[view], centres, chosen.shape)
            hit, scaled, length = _quadratics(
                centres, projection[:, 2], chosen.u[view], chosen.v[view], self.semi_axes
            )
            for n in np.flatnonzero((boxes[:, 1] > boxes[:, 0]).all(axis=1)):
                (i0, j0), (i1, j1) = boxes[n]
                column = _fine(i0, i1, oversample) - projection[n, 0]
                row = _fine(j0, j1, oversample)[:, None] - projection[n, 1]
                chords = _chords(column, row, hit[n], scaled[n], length[n])
                if oversample > 1:
                    blocks = chords.reshape(j1 - j0, oversample, i1 - i0, oversample)
                    chords = blocks.mean(axis=(1, 3))
                image[j0:j1, i0:i1] += self.attenuation[n] * chords
            images[view] = image
        return images

    def _shadows(
        self, to_pixels: Floats, centres: Floats, shape: tuple[int, int]
    ) -> tuple[Floats, NDArray[np.int_]]:
        """Return (column, row, depth) of each centre and the pixels ((i0, j0), (i1, j1)) it covers.

        The bounds are those of the image of the dual quadric, taken about the image of the centre.
        """
        projection = centres @ to_pixels.T
        with np.errstate(divide="ignore", invalid="ignore"):
            projection[:, :2] /= projection[:, 2:]
        depth_axes = to_pixels[2] * self.semi_axes
        clear = projection[:, 2] ** 2 - np.sum(depth_axes**2, axis=1)
        if (projection[:, 2] <= 0).any() or (clear <= 0).any():
            raise InputError("an ellipsoid reaches the plane of a source: move it or the source")
        boxes = np.empty((len(self), 2, 2), dtype=np.int_)
        for k, size in enumerate(shape[::-1]):
            axes = (to_pixels[k] - projection[:, k, None] * to_pixels[2]) * self.semi_axes
            middle = -np.sum(axes * depth_axes, axis=1)
            spread = np.sqrt(middle**2 + clear * np.sum(axes**2, axis=1))
            low = projection[:, k] + (middle - spread) / clear
            high = projection[:, k] + (middle + spread) / clear
            boxes[:, 0, k] = np.clip(np.floor(low + 0.5), 0, size)
            boxes[:, 1, k] = np.clip(np.floor(high + 0.5) + 1, 0, size)
        return projection, boxes

    def volume(self, grid: VolumeGrid, *, oversample: int = 2) -> NDArray[np.float32]:
        """Average the attenuation over each voxel.

        Parameters
        ----------
        grid : VolumeGrid
            Where to.
        oversample : int
            Lines a voxel along y and along z; along x the overlap is exact.

        Returns
        -------
        ndarray of float32, (nz, ny, nx)
            Mean attenuation [1/mm].
        """
        oversample = whole("oversample", oversample)
        size = grid.voxel_size
        volume = np.zeros(grid.shape, dtype=np.float32)
        corner = np.array(grid.centre) - size / 2 * np.array(grid.shape[::-1])
        limits = np.array(grid.shape[::-1])
        for centre, axes, attenuation in zip(
            self.centres, self.semi_axes, self.attenuation, strict=True
        ):
            # In voxels from the grid's corner: voxel i reaches from i to i + 1.
            middle, half = (centre - corner) / size, axes / size
            low = np.clip(np.floor(middle - half), 0, limits).astype(int)
            high = np.clip(np.ceil(middle + half), 0, limits).astype(int)
            if (high <= low).any():
                continue
            x = np.arange(low[0], high[0])
            y = (_fine(low[1], high[1], oversample) + 0.5 - middle[1]) / half[1]
            for k in range(low[2], high[2]):
                z = (_fine(k, k + 1, oversample) + 0.5 - middle[2]) / half[2]
                inside = np.maximum(1 - z[:, None] ** 2 - y**2, 0.0)
                reach = half[0] * np.sqrt(inside)[..., None]
                overlap = np.minimum(x + 1, middle[0] + reach) - np.maximum(x, middle[0] - reach)
                parts = np.maximum(overlap, 0.0).mean(axis=0)
                rows = parts.reshape(high[1] - low[1], oversample, len(x)).mean(axis=1)
                volume[k, low[1] : high[1], low[0] : high[0]] += attenuation * rows
        return volume


def _fine(start: int, stop: int, parts: int) -> Floats:
    """Centres of `parts` equal parts of each pixel from `start` to `stop - 1`, in pixels."""
    return start - 0.5 + (np.arange((stop - start) * parts) + 0.5) / parts


def _quadratics(
    centres: Floats, depth: Floats, u: Floats, v: Floats, axes: Floats
) -> tuple[Floats, Floats, Floats]:
    """Coefficients, (n, 6), of what `_chords` needs of each ellipsoid in a view.

    centres: from the source [mm], at `depth` of the detector's. The ray to the pixel (column, row),
    counted from the projection of a centre, is r = centre / depth + column u + row v. Divided by
    the semi-axes (primed) it passes the centre of the unit sphere at |centre' x r'| / |r'|, in
    which centre' x centre' = 0 is left out: nothing cancels, however far the source is.
    """
    o, a, b = centres / axes, u / axes, v / axes
    missed = _square(np.zeros_like(o), np.cross(o, a), np.cross(o, b))
    scaled = _square(o / depth[:, None], a, b)
    length = _square(centres / depth[:, None], u + 0 * o, v + 0 * o)
    return scaled - missed, scaled, length


def _square(base: Floats, u: Floats, v: Floats) -> Floats:
    """Coefficients of |base + column u + row v|^2 for 1, column, row and their products."""
    pairs = [(base, base), (base, u), (base, v), (u, u), (u, v), (v, v)]
    return np.stack([np.sum(x * y, axis=1) for x, y in pairs], axis=1) * [1, 2, 2, 1, 2, 1]


def _chords(column: Floats, row: Floats, hit: Floats, scaled: Floats, length: Floats) -> Floats:
    """Lengths 2 sqrt(hit / scaled) |r| / |r'| inside one ellipsoid, (j, i) [mm]."""
    chords = _polynomial(column, row, hit)
    np.maximum(chords, 0.0, out=chords)
    chords *= _polynomial(column, row, length)
    np.sqrt(chords, out=chords)
    chords /= _polynomial(column, row, scaled)
    chords *= 2.0
    return chords


def _polynomial(column: Floats, row: Floats, c: Floats) -> Floats:
    """Value of a quadratic at column (i,) and row (j, 1)."""
    value: Floats = (c[4] * row) * column
    value += c[0] + column * (c[1] + column * c[3])
    value += row * (c[2] + row * c[5])
    return value


def three_spheres(radius: float, height: float) -> Ellipsoids:
    """Return a stack of three spheres, each of two concentric attenuations.

    The phantom of the paper's simulations, whose compositions the paper leaves open; the largest
    line integral is about 2.

    Parameters
    ----------
    radius, height : float
        Of the cylinder, centred on the origin, that the stack fits in [mm]. The paper's is
        240 x 1248 voxels of 0.004544 mm.
    """
    size = 0.97 * min(positive("radius", radius), positive("height", height) / 6)
    shells = np.array([1.0, 1.3, 0.8])
    cores = np.array([1.7, 0.7, 2.2])
    core_size = np.array([0.55, 0.6, 0.45])
    z = np.array([-1.0, 0.0, 1.0]) * height / 3
    largest = np.max(2 * size * (shells + core_size * (cores - shells)))
    return Ellipsoids(
        np.tile(np.stack([0 * z, 0 * z, z], axis=1), (2, 1)),
        np.concatenate([np.full(3, size), core_size * size]),
        np.concatenate([shells, cores - shells]) * (2.0 / largest),
    )


def porous(radius: float, height: float, seed: int = 0, *, count: int = 400) -> Ellipsoids:
    """Return a cloud of small spheres of many sizes: texture everywhere.

    Parameters
    ----------
    radius, height : float
        Of the cylinder, centred on the origin, that holds the spheres [mm].
    seed : int
        Of the random numbers.
    count : int
        Number of spheres.
    """
    radius, height = positive("radius", radius), positive("height", height)
    count = whole("count", count)
    random = np.random.default_rng(seed)
    sizes = min(radius, height / 2) * np.exp(random.uniform(math.log(0.04), math.log(0.2), count))
    angle = random.uniform(0, 2 * math.pi, count)
    distance = (radius - sizes) * np.sqrt(random.random(count))
    z = (height / 2 - sizes) * random.uniform(-1, 1, count)
    weight = random.uniform(0.5, 1.5, count)
    # The mean over the cylinder times its diameter is the mean line integral through the axis.
    mean = np.sum(weight * 4 / 3 * math.pi * sizes**3) / (math.pi * radius**2 * height)
    return Ellipsoids(
        np.stack([distance * np.cos(angle), distance * np.sin(angle), z], axis=1),
        sizes,
        weight / (mean * 2 * radius),
    )
