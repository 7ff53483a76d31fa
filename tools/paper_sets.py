"""The scans of the paper's simulation, at its own size or a part of it.

Four sets, {helix, space-filling} x {random, smooth}, of a stack of three spheres, 480 x 480 x 1248
voxels, in closed form: 3456 radiographs, of 928 x 512 pixels since the paper does not tell.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import clra
from clra.model.gauge.gauge import Gauge, sample_points, without_gauge
from clra.model.grid import default_grid
from clra.model.motion import Motion
from clra.model.phantoms.ellipsoids import three_spheres
from clra.model.phantoms.perturbation import random_motion, smooth_motion
from clra.model.trajectory import PAPER

VIEWS, VOXEL, SAMPLE = 3456, 0.004544, (1248, 480)  # planes and columns of the phantom
SPHERES = three_spheres(SAMPLE[1] / 2 * VOXEL, SAMPLE[0] * VOXEL)
MOTIONS = {"random": random_motion, "smooth": smooth_motion}
SETS = [(t, m) for t in ("helix", "space-filling") for m in MOTIONS]
SHIFT = -10.0, 8.0  # pixels, of whatever detector


def geometry_of(trajectory: str, scale: int) -> clra.ConeBeamGeometry:
    """Return the paper's trajectory with `scale` times larger pixels and as much fewer views."""
    rows, columns = PAPER["shape"]
    detector = {
        **PAPER,
        "shape": (rows // scale, columns // scale),
        "pixel_size": PAPER["pixel_size"] * scale,
        "z_step": PAPER["z_step"] * scale,
    }
    if trajectory == "helix":
        return clra.helix(VIEWS // scale, angle_step=math.radians(0.5 * scale), **detector)
    return clra.space_filling(VIEWS // scale, **detector)


def surfaces(count: int = 1500) -> NDArray[np.float64]:
    """Points on the spheres, where their edges are."""
    direction = np.random.default_rng(0).normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    chosen = np.arange(count) % len(SPHERES.centres)
    return SPHERES.centres[chosen] + direction * SPHERES.semi_axes[chosen]


def true_motion(
    geometry: clra.ConeBeamGeometry, motion: str, magnification: float, seed: int
) -> Motion:
    """Draw a motion, and take out what a movement of the sample would explain."""
    drawn = MOTIONS[motion](geometry.views, seed=seed, shift=SHIFT, magnification=magnification)
    clouds = [sample_points(default_grid(geometry)), surfaces()]
    return without_gauge(drawn, geometry, clouds, magnification > 0)


def project(images: NDArray[np.float32], geometry: clra.ConeBeamGeometry) -> None:
    """Fill `images` with radiographs of the spheres, a few at a time."""
    for start in range(0, geometry.views, 32):
        stop = min(start + 32, geometry.views)
        images[start:stop] = SPHERES.line_integrals(geometry, start, stop)


def moved_scan(
    trajectory: str, motion: str, scale: int, magnification: float, folder: Path, seed: int = 1
) -> clra.Scan:
    """Return one of the sets, its radiographs on disk."""
    geometry = geometry_of(trajectory, scale)
    truth = true_motion(geometry, motion, magnification, seed)
    name = f"{trajectory}-{motion}-{scale}-{magnification:g}" + f"-{seed}" * (seed != 1)
    path = folder / f"{name}.npy"
    if not path.exists():
        shape = (geometry.views, *geometry.shape)
        partial = path.with_suffix(".partial")
        images = np.lib.format.open_memmap(partial, "w+", np.float32, shape)
        project(images, geometry.with_motion(truth))
        images.flush()
        partial.rename(path)
    return clra.Scan(np.load(path, mmap_mode="r"), geometry, name=name, truth=truth)


def errors(motion: Motion, truth: Motion, geometry: clra.ConeBeamGeometry) -> dict[str, float]:
    """Mean absolute errors, raw and gauge-free, and deviations; pixels."""
    found, true = (Motion(shift_u=m.shift_u, shift_v=m.shift_v) for m in (motion, truth))
    error = Gauge(geometry, surfaces(), magnification=False).error(found, true)
    names = ("mae_u", "mae_v", "std_u", "std_v", "gauge_free_u", "gauge_free_v")
    row = {name: getattr(error, name) for name in names}
    return row | {"mae_m": float(np.abs(motion.magnification - truth.magnification).mean())}


def rest(motion: Motion, truth: Motion, geometry: clra.ConeBeamGeometry) -> dict[str, Any]:
    """Split an error into movements of the sample and slow and fast motions.

    Root mean squares over the views: of each gauge mode [pixel]; and of what lies beside them, by
    cycles a scan (below 4, to 40, above), of u, v [pixel] and of the magnification.
    """
    error = Motion(
        shift_u=motion.shift_u - truth.shift_u,
        shift_v=motion.shift_v - truth.shift_v,
        magnification=1 + motion.magnification - truth.magnification,
    )
    fit = Gauge(geometry, surfaces(), magnification=False).fit(error)
    power = np.abs(np.fft.fft(fit.remainder, axis=0) / motion.views) ** 2
    cycles = np.abs(np.fft.fftfreq(motion.views) * motion.views)
    bands = np.digitize(cycles, [4, 40])
    found = [np.sqrt(power[bands == band].sum(axis=0)) for band in range(3)]
    return {"modes": fit.rms_by_mode, "bands": np.array(found).T.tolist()}
