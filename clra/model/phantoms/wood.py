"""A phantom like wood: hollow fibres along z, vessels among them, rays across."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.model.validation import positive

Floats = NDArray[np.float64]

# Lengths in diameters, the part of the radius that is wall, and the part of the fibres' room that
# vessels take, which are so many times as wide.
_LENGTHS, _WALL, _VESSELS, _WIDER = (5.0, 12.0), 0.4, 0.04, 1.9
# Rays: cells across the fibres, in one direction as in a core taken far from the pith. A row of
# them on every so many fibres in height.
_RAY_LENGTHS, _RAYS = (4.0, 9.0), 0.15


def wood(radius: float, height: float, seed: int = 0, *, fibre: float = 0.045) -> Ellipsoids:
    """Return a core of wood.

    Each cell is a spindle with a lumen: an ellipsoid that adds the wall's attenuation and one
    inside that takes it away again. Fibres and vessels stand along z in columns, their ends at
    random heights; rays lie along x.

    Parameters
    ----------
    radius, height : float
        Of the cylinder, centred on the origin, that holds the cells [mm].
    seed : int
        Of the random numbers.
    fibre : float
        Diameter of a fibre as a part of the core's. Those of beech, 20 micrometres, would be a
        150th of a core of 3 mm; the default survives a quarter of the resolution at which the core
        is 300 voxels wide. The number of cells goes with its inverse cube.
    """
    radius, height = positive("radius", radius), positive("height", height)
    random = np.random.default_rng(seed)
    width = 2 * radius * positive("fibre", fibre)
    cells = [_column(x, y, w, height, random) for x, y, w in _sites(radius, width, random)]
    rays = _rays(radius, height, width, random)
    outer = np.concatenate([*cells, rays])
    centres, axes = outer[:, :3], outer[:, 3:]
    wall = _WALL * axes.min(axis=1, keepdims=True)
    density = random.uniform(0.8, 1.2, len(outer))
    # The mean over the cylinder times its diameter is the mean line integral through the axis.
    volumes = 4 / 3 * math.pi * (axes.prod(axis=1) - (axes - wall).prod(axis=1))
    mean = np.sum(density * volumes) / (math.pi * radius**2 * height)
    density /= mean * 2 * radius
    return Ellipsoids(
        np.concatenate([centres, centres]),
        np.concatenate([axes, axes - wall]),
        np.concatenate([density, -density]),
    )


def _sites(
    radius: float, width: float, random: np.random.Generator
) -> list[tuple[float, float, float]]:
    """(x, y, diameter) of the columns: a jittered hexagonal lattice, some of it vessels."""
    reach = math.ceil(radius / width) + 1
    i, j = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    places = width * np.column_stack([i + 0.5 * j, math.sqrt(0.75) * j])
    places = places + random.uniform(-0.1, 0.1, places.shape) * width
    sizes = np.where(random.random(len(places)) < _VESSELS, _WIDER, 0.9) * width
    sites: list[tuple[float, float, float]] = []
    # The widest first: a vessel takes the room of the fibres about it.
    for (x, y), size in sorted(zip(places, sizes, strict=True), key=lambda site: -site[1]):
        clear = all(math.hypot(x - a, y - b) >= 0.45 * (size + w) for a, b, w in sites)
        if clear and math.hypot(x, y) + 0.5 * size <= radius:
            sites.append((float(x), float(y), float(size)))
    return sites


def _column(x: float, y: float, width: float, height: float, random: np.random.Generator) -> Floats:
    """(x, y, z, semi-axes) of the cells of one column, end on end from a random height."""
    cells = []
    z = -0.5 * height - random.random() * _LENGTHS[0] * width
    while z < 0.5 * height:
        length = random.uniform(*_LENGTHS) * width
        if z >= -0.5 * height and z + length <= 0.5 * height:
            cells.append((x, y, z + 0.5 * length, 0.5 * width, 0.5 * width, 0.5 * length))
        z += length
    return np.array(cells).reshape(-1, 6)


def _rays(radius: float, height: float, width: float, random: np.random.Generator) -> Floats:
    """(x, y, z, semi-axes) of the ray cells, thrown at random."""
    count = round(_RAYS * (radius / width) ** 2 * height / (_LENGTHS[0] * width))
    half = (
        0.5
        * width
        * np.column_stack(
            [random.uniform(*_RAY_LENGTHS, count), np.full(count, 0.6), np.full(count, 1.2)]
        )
    )
    angle, distance = 2 * math.pi * random.random(count), np.sqrt(random.random(count))
    # Both ends of a cell stay inside.
    room = np.sqrt(np.maximum((radius - half[:, 1]) ** 2 - half[:, 0] ** 2, 0.0))
    y = distance * np.sin(angle) * room
    x = distance * np.cos(angle) * (radius - half[:, 0])
    inside = np.hypot(np.abs(x) + half[:, 0], np.abs(y) + half[:, 1]) <= radius
    z = (0.5 * height - half[:, 2]) * random.uniform(-1, 1, count)
    return np.asarray(np.column_stack([x, y, z, half])[inside])
