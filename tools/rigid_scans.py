"""Scans whose sample moves and turns in every view: balls in closed form, or a real sandstone."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bench_peers import Rtk
from numpy.typing import NDArray

import clra
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.model.phantoms.perturbation import smooth_motion
from clra.model.rigid.rigid_motion import RigidMotion

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """A scan: its trajectory, size [pixel], views and motion."""

    trajectory: str = "circle"
    size: int = 64
    views: int = 120
    across: float = 3.0  # shifts along u and v, at most [mm]
    along: float = 0.0  # along the beam
    turn: float = 0.3  # about each axis, at most [degree]
    smooth: bool = False
    wobble: float = 0.0  # about u and the beam instead [degree]
    photons: float = 0.0  # a pixel of the open beam; 0 for no noise
    rock: bool = False  # instead of balls


CASES = {
    "competitor's": Case(across=1.5, along=1.5),
    "circle, 64": Case(),
    "circle, 128": Case(size=128, views=180),
    "circle, 128, 1e4 photons": Case(size=128, views=180, photons=1e4),
    "circle, drift": Case(along=1.5, smooth=True),
    "helix, 64": Case("helix", views=180),
    "space-filling, 64": Case("space-filling", views=180),
    "wobble 0.5, 160": Case(size=160, views=180, across=0, turn=0, wobble=0.5),
    "wobble 2, 160": Case(size=160, views=180, across=0, turn=0, wobble=2.0),
    "rock, 96": Case(size=96, views=180, rock=True),
    "rock, 192": Case(size=192, views=240, rock=True),
    "still, 64": Case(across=0, turn=0),
    "shifts only, 64": Case(turn=0),
}


def nominal(case: Case) -> clra.ConeBeamGeometry:
    """Return the geometry without motion: one pixel at the axis is a voxel."""
    n = case.size
    scanner: dict[str, Any] = {
        "source_to_axis": 2.5 * n,
        "source_to_detector": 3.75 * n,
        "pixel_size": 1.5,
        "shape": (n // 2 + n // 8 if case.trajectory != "circle" else n + n // 4, n + n // 4),
    }
    step = 0.75 * n / (case.views - 1)
    if case.trajectory == "circle":
        return clra.circular(case.views, **scanner)
    if case.trajectory == "helix":
        turns = 6 * np.pi / case.views
        return clra.helix(case.views, angle_step=turns, z_step=step, **scanner)
    return clra.space_filling(case.views, z_step=step, angle_step=np.radians(15.264), **scanner)


def balls(case: Case, seed: int) -> Ellipsoids:
    """Return forty balls in a cylinder, none in another."""
    random = np.random.default_rng(seed)
    radius, height = 0.36 * case.size, case.size * (0.75 if case.trajectory == "circle" else 1.15)
    centres, radii = np.empty((0, 3)), np.empty(0)
    while len(radii) < 40:
        r = radius * random.uniform(0.06, 0.2)
        away, angle = (radius - r) * np.sqrt(random.random()), 2 * np.pi * random.random()
        z = random.uniform(r - height / 2, height / 2 - r)
        centre = np.array([away * np.cos(angle), away * np.sin(angle), z])
        if (np.linalg.norm(centres - centre, axis=1) > r + radii).all():
            centres, radii = np.vstack([centres, centre]), np.append(radii, r)
    return Ellipsoids(centres, radii, random.uniform(0.5, 1.5, 40))


def true_motion(case: Case, seed: int) -> RigidMotion:
    """Return the motion of a case."""
    random = np.random.default_rng(1000 + seed)
    size = np.array([case.across, case.across, case.along, *np.radians([case.turn] * 3)])
    if case.wobble:
        size[[3, 5]] = np.radians(case.wobble)
    if not case.smooth:
        return RigidMotion.of(nominal(case), size * random.uniform(-1, 1, (case.views, 6)))
    curves = [smooth_motion(case.views, shift=(-1.0, 1.0), seed=seed + k) for k in range(3)]
    unit = np.stack([c for one in curves for c in (one.shift_u, one.shift_v)], axis=1)
    return RigidMotion.of(nominal(case), size * unit)


def rock(case: Case) -> tuple[clra.VolumeGrid, NDArray[np.float32], Floats]:
    """Return a cylinder of Berea sandstone in voxels of half a pixel, and points of its grains.

    Raises
    ------
    FileNotFoundError
        If CLRA_TEST_DATA names no folder that holds rock/berea_200.npz.
    """
    data = Path(os.environ.get("CLRA_TEST_DATA", "")) / "rock" / "berea_200.npz"
    grains = ~np.load(data)["im"]
    n = 2 * round(0.72 * case.size)
    grid = clra.VolumeGrid(shape=(n, n, n), voxel_size=0.5)
    more = [(0, max(0, n - m)) for m in grains.shape]
    grains = np.pad(grains, more, mode="symmetric")[:n, :n, :n]
    x, y, z = grid.coordinates()
    grains &= np.hypot(x, y[:, None]) < 0.36 * case.size
    k, j, i = (a[:: max(1, len(a) // 600)] for a in np.nonzero(grains))
    return grid, grains.astype(np.float32), np.stack([x[i], y[j], z[k]], axis=1)


def rock_projections(true: clra.ConeBeamGeometry, case: Case) -> NDArray[np.float32]:
    """Project the sandstone by itk-rtk (Joseph), 2 x 2 rays a pixel whose lengths are averaged."""
    grid, grains, _ = rock(case)
    fine = clra.ConeBeamGeometry(
        source=true.source,
        detector=true.detector,
        u=true.u / 2,
        v=true.v / 2,
        shape=(2 * true.rows, 2 * true.columns),
    )
    images = np.empty((true.views, *true.shape), np.float32)
    for start in range(0, true.views, 60):
        lengths = Rtk().forward(fine.subset(slice(start, start + 60)), grid, grains)()()
        blocks = lengths.reshape(-1, true.rows, 2, true.columns, 2)
        images[start : start + 60] = blocks.mean(axis=(2, 4))
    return images


def simulated(case: Case, seed: int) -> tuple[clra.Scan, clra.ConeBeamGeometry, Floats]:
    """Return a scan as it is told, the geometry it really had, and points of its sample."""
    ideal = nominal(case)
    true = ideal.with_motion(true_motion(case, seed))
    if case.rock:
        images, points = rock_projections(true, case), rock(case)[2]
    else:
        phantom = balls(case, seed)
        images, points = phantom.line_integrals(true, oversample=2), surface(phantom)
    images *= np.float32(2.5 / images.max())
    if case.photons:
        counts = np.random.default_rng(seed).poisson(case.photons * np.exp(-images))
        images = -np.log(np.maximum(counts, 1) / case.photons).astype(np.float32)
    return clra.Scan(images, ideal, name="simulated"), true, points


def surface(phantom: Ellipsoids) -> Floats:
    """Return points of the surfaces of balls."""
    directions = np.random.default_rng(3).normal(size=(600, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    which = np.arange(600) % len(phantom)
    return np.asarray(phantom.centres[which] + phantom.semi_axes[which, :1] * directions)
