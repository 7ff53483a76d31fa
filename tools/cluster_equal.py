"""Compare what workers of a cluster make with what one process makes.

    python tools/cluster_equal.py

The paper's helix and space-filling trajectories at a quarter of their size, from a file, on 2 and 4
worker processes of this machine. Volumes: norm of the difference over the norm. Motions: largest
difference of any view, in u and v [pixel] and magnification, or rotation [degree].
"""

import argparse
import math
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from paper_sets import SPHERES, geometry_of, true_motion

import clra
from clra.app.simulation import simulated_scan
from clra.methods.reconstruction.iterative import Multigrid
from clra.methods.reconstruction.osem_tr import OrderedSubsets

SEED, MAGNIFICATION = 1, 1e-3
WORK: dict[str, Callable[..., Any]] = {
    "align, auto": lambda scan, **on: clra.align(scan, quality=False, **on),
    "align, imgr": lambda scan, **on: clra.align(scan, method="imgr", quality=False, **on),
    "align, rigid": lambda scan, **on: clra.align(scan, estimate="rigid", quality=False, **on),
    "fbp": lambda scan, **on: clra.reconstruct(scan, motion=scan.truth, **on),
    "katsevich": lambda scan, **on: clra.reconstruct(scan, "katsevich", motion=scan.truth, **on),
    "osem-tr": lambda scan, **on: clra.reconstruct(
        scan, "osem-tr", motion=scan.truth, options=OrderedSubsets(passes=1), **on
    ),
    "imgr": lambda scan, **on: clra.reconstruct(
        scan, "imgr", motion=scan.truth, options=Multigrid(cycles=1), **on
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=int, default=4, help="of the paper's size")
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 4])
    parser.add_argument("--trajectories", nargs="+", default=["helix", "space-filling"])
    parser.add_argument("--only", nargs="+", default=list(WORK), choices=list(WORK))
    options = parser.parse_args()
    counts = [f"{count} workers" for count in options.workers]
    print("| trajectory | work | " + " | ".join(counts) + " |")
    print("|---|---|" + len(counts) * "---|")
    here = Path.cwd()
    with tempfile.TemporaryDirectory(dir=here, prefix="clra-equal-") as folder:
        os.chdir(folder)
        for trajectory in options.trajectories:
            geometry = geometry_of(trajectory, options.scale)
            truth = true_motion(geometry, "random", MAGNIFICATION, SEED)
            made = simulated_scan(geometry, SPHERES, truth, name=trajectory)
            clra.write_scan(f"{trajectory}.nxs", made)
            scan = clra.read_scan(f"{trajectory}.nxs")
            for name in options.only:
                if name == "katsevich" and trajectory != "helix":
                    continue
                alone = WORK[name](scan)
                told = [
                    difference(alone, WORK[name](scan, cluster=f"local:{count}"))
                    for count in options.workers
                ]
                print(f"| {trajectory} | {name} | " + " | ".join(told) + " |", flush=True)
        os.chdir(here)


def difference(alone: Any, shared: Any) -> str:
    """Tell how two volumes or two alignments differ."""
    if isinstance(alone, np.ndarray):
        return f"{np.linalg.norm(shared - alone) / np.linalg.norm(alone):.1e}"
    names = ["shift_u", "shift_v", "magnification"]
    if alone.motion.cause == "sample":
        names[2] = "rotation"
    apart = [getattr(shared.motion, n) - getattr(alone.motion, n) for n in names]
    u, v, other = (float(np.abs(difference).max()) for difference in apart)
    if names[2] == "rotation":
        other = math.degrees(other)
    return f"{u:.1e}, {v:.1e}; {other:.1e}"


if __name__ == "__main__":
    main()
