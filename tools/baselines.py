"""Drift correction by a reference scan beside re-projection alignment, and one after the other.

``python tools/baselines.py`` simulates the paper's helix and space-filling scan at a quarter of
their size (``--scale``): a smooth motion of -10 to 8 pixels and 1 +- 0.002, with a jitter of 1
pixel on top, as it is (with its gauge), and a reference scan of every twelfth view in which nothing
moved. It prints raw mean absolute errors as a Markdown table.
"""

import argparse

import numpy as np
from paper_sets import SAMPLE, VOXEL, geometry_of

import clra
from clra.model.phantoms.ellipsoids import three_spheres
from clra.model.phantoms.perturbation import random_motion, smooth_motion

EVERY = 12
HEAD = (
    "| trajectory | motion | no correction | reference alone | alignment alone | alignment after "
    "the reference |\n|---|---|---|---|---|---|"
)


def errors(motion: clra.Motion, truth: clra.Motion) -> str:
    u, v = (np.abs(getattr(motion, n) - getattr(truth, n)).mean() for n in ("shift_u", "shift_v"))
    return f"{u:.3f}, {v:.3f}"


def row(trajectory: str, jitter: float, scale: int) -> str:
    geometry = geometry_of(trajectory, scale)
    truth = smooth_motion(geometry.views, seed=1, shift=(-10, 8), magnification=0.002)
    truth = truth.then(random_motion(geometry.views, seed=5, shift=(-jitter, jitter)))
    spheres = three_spheres(SAMPLE[1] / 2 * VOXEL, SAMPLE[0] * VOXEL)
    scan = clra.Scan(spheres.line_integrals(geometry.with_motion(truth)), geometry)
    still = geometry.subset(slice(0, None, EVERY))
    reference = clra.Scan(spheres.line_integrals(still), still, name="reference")
    found = [
        clra.Motion.identity(scan.views),
        clra.align(scan, method="reference", reference=reference).motion,
        clra.align(scan).motion,
        clra.align(scan, reference=reference).motion,
    ]
    numbers = " | ".join(errors(motion, truth) for motion in found)
    moved = f"drift, jitter of {jitter:g} pixel" if jitter else "drift"
    return f"| {trajectory} | {moved} | {numbers} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=int, default=4)
    options = parser.parse_args()
    print(HEAD)
    for trajectory in ("helix", "space-filling"):
        for jitter in (0.0, 1.0):
            print(row(trajectory, jitter, options.scale), flush=True)


if __name__ == "__main__":
    main()
