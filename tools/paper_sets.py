"""Align the paper's four simulated scans and print the errors as a Markdown table.

``python tools/paper_sets.py --scale 1`` is the paper's size (3456 radiographs, we take 928 x 512,
7 GB of host memory a set); ``--scale 4`` is a quarter of it in every respect. The sample is the
stack of three spheres, its radiographs are closed forms. Motions, random or smooth, of -10 to 8
pixels and magnifications of 1 +- 0.002, freed of what a movement of the sample would explain.
"""

import argparse
import math
import time

import numpy as np

import clra
from clra.model.gauge import Gauge, sample_points, without_gauge
from clra.model.grid import default_grid
from clra.model.motion import Motion
from clra.model.perturbation import random_motion, smooth_motion
from clra.model.phantom import three_spheres
from clra.model.trajectory import PAPER

VIEWS, VOXEL, SAMPLE = 3456, 0.004544, (1248, 480)  # planes and columns of the phantom
MOTIONS = {"random": random_motion, "smooth": smooth_motion}
HEAD = (
    "| trajectory | motion | QR iterations | raw u | raw v | gauge-free u | gauge-free v | "
    "magnification | time |\n|---|---|---|---|---|---|---|---|---|"
)


def geometry_of(trajectory: str, scale: int) -> clra.ConeBeamGeometry:
    rows, columns = PAPER["shape"]
    panel = {
        **PAPER,
        "shape": (rows // scale, columns // scale),
        "pixel_size": PAPER["pixel_size"] * scale,
        "z_step": PAPER["z_step"] * scale,
    }
    views = VIEWS // scale
    if trajectory == "helix":
        return clra.helix(views, angle_step=math.radians(0.5 * scale), **panel)
    return clra.space_filling(views, **panel)


def surfaces(count: int = 1500) -> np.ndarray:
    """Points on the spheres, where their edges are."""
    spheres = three_spheres(SAMPLE[1] / 2 * VOXEL, SAMPLE[0] * VOXEL)
    direction = np.random.default_rng(0).normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    chosen = np.arange(count) % len(spheres.centres)
    return spheres.centres[chosen] + direction * spheres.semi_axes[chosen]


def row(trajectory: str, motion: str, scale: int, schedule: str) -> str:
    geometry = geometry_of(trajectory, scale)
    moved = MOTIONS[motion](geometry.views, seed=1, shift=(-10, 8), magnification=0.002)
    points = surfaces()
    clouds = [sample_points(default_grid(geometry)), points]
    truth = without_gauge(moved, geometry, clouds)
    spheres = three_spheres(SAMPLE[1] / 2 * VOXEL, SAMPLE[0] * VOXEL)
    scan = clra.Scan(spheres.line_integrals(geometry.with_motion(truth)), geometry, truth=truth)
    started = time.perf_counter()
    result = clra.align(scan, schedule=schedule)
    seconds = time.perf_counter() - started
    error = Gauge(geometry, points, magnification=False).error(
        Motion(shift_u=result.motion.shift_u, shift_v=result.motion.shift_v),
        Motion(shift_u=truth.shift_u, shift_v=truth.shift_v),
    )
    magnification = np.abs(result.motion.magnification - truth.magnification).mean()
    coarse = sum(entry.level == "QR" for entry in result.history)
    return (
        f"| {trajectory} | {motion} | {coarse} | {error.mae_u:.3f} | {error.mae_v:.3f} | "
        f"{error.gauge_free_u:.3f} | {error.gauge_free_v:.3f} | {magnification:.1e} | "
        f"{seconds:.0f} s |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--schedule", default="auto")
    options = parser.parse_args()
    print(HEAD)
    for trajectory in ("space-filling", "helix"):
        for motion in MOTIONS:
            print(row(trajectory, motion, options.scale, options.schedule), flush=True)


if __name__ == "__main__":
    main()
