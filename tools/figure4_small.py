"""The paper's Figures 4 and 5 scaled down: align a double helix, reconstruct exactly.

``python tools/figure4_small.py --scale 16 -o FOLDER`` takes two minutes on two cores, ``--scale 8``
half an hour. The scan is the paper's in proportion: 14136 views of 3040 x 3040 pixels over the
scale, source to axis 2.8823 mm, to detector 315.5 mm, a fan of 67.6 degrees, and a travel that
makes the volume 5240 planes over the scale. The radiographs of the wood are closed forms. Their
motion is a stage's: drift and jitter of up to 4 pixels in u, 3 in v and magnifications of 1 +-
0.001, the same on the way back, without what a movement of the sample would explain.

Prints errors of the motion after each iteration, and of Katsevich's volume uncorrected, corrected
as estimated and corrected as known. A folder gets scan.nxs, motion.h5, report.html and volumes.
"""

import argparse
import math
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import numpy as np

import clra
from clra.app.annotations import annotated
from clra.app.report.html_report import write_report
from clra.app.report.summary import findings_of
from clra.io.alignment_file import write_alignment
from clra.io.scan_files import write_scan
from clra.io.volumes.volume_files import write_volume
from clra.methods.alignment.result import AlignmentResult
from clra.model.gauge.gauge import sample_points, without_gauge
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.model.phantoms.perturbation import random_motion, smooth_motion
from clra.model.phantoms.wood import wood

VIEWS, PIXELS, PIXEL, PLANES = 7068, 3040, 0.139, 5240  # a helix; along a side; mm; of the volume
SOURCE_TO_AXIS, SOURCE_TO_DETECTOR = 2.8823, 315.5  # mm
# Pitch [mm]: the Tam-Danielsson window leaves a tenth of the rows for the motion. Radius of the
# core [mm]: a tenth of the field of view is left beside it.
PITCH, RADIUS = 3.4, 1.45
SHIFT_U, SHIFT_V, MAGNIFICATION, JITTER = 4.0, 2.6, 1e-3, 0.15
CORES = 2


def geometry_of(scale: int) -> clra.ConeBeamGeometry:
    """Return the paper's double helix with fewer views and pixels."""
    views = VIEWS // scale
    z_step = PLANES * PIXEL * SOURCE_TO_AXIS / SOURCE_TO_DETECTOR / views
    return clra.double_helix(
        views,
        angle_step=2 * math.pi * z_step / PITCH,
        z_step=z_step,
        source_to_axis=SOURCE_TO_AXIS,
        source_to_detector=SOURCE_TO_DETECTOR,
        pixel_size=PIXEL * scale,
        shape=(PIXELS // scale, PIXELS // scale),
    )


def stage_motion(geometry: clra.ConeBeamGeometry, seed: int = 1) -> clra.Motion:
    """Drift and jitter of a stage that does on the way back what it did on the way there."""
    half = geometry.views // 2
    there = []
    for largest in (SHIFT_U, SHIFT_V):
        parts = []
        for kind, part in ((smooth_motion, 1 - JITTER), (random_motion, JITTER)):
            reach, scale = part * largest, part * MAGNIFICATION
            parts.append(kind(half, seed=seed, shift=(-reach, reach), magnification=scale))
        there.append(parts[0].then(parts[1]))
    u, v = there
    mirrored = clra.Motion(
        shift_u=_and_back(u.shift_u),
        shift_v=_and_back(v.shift_v),
        magnification=_and_back(u.magnification),
    )
    grid = default_grid(geometry)
    return without_gauge(mirrored, geometry, [sample_points(grid, seed=k) for k in range(3)])


def _and_back(values: np.ndarray) -> np.ndarray:
    return np.concatenate([values, values[::-1]])


def core_of(geometry: clra.ConeBeamGeometry) -> Ellipsoids:
    """Return wood as tall as the volume, its fibres at least seven voxels wide."""
    grid = default_grid(geometry)
    fibre = max(0.045, 7 * grid.voxel_size / (2 * RADIUS))
    return wood(RADIUS, grid.shape[0] * grid.voxel_size, fibre=fibre)


def radiographs(sample: Ellipsoids, geometry: clra.ConeBeamGeometry) -> np.ndarray:
    """Line integrals of all views, computed on several cores."""
    images = np.empty((geometry.views, *geometry.shape), np.float32)
    ends = np.linspace(0, geometry.views, 8 * CORES + 1).astype(int)
    with ProcessPoolExecutor(CORES, mp_context=get_context("spawn")) as pool:
        parts = [pool.submit(sample.line_integrals, geometry, a, b) for a, b in pairwise(ends)]
        for (a, b), part in zip(pairwise(ends), parts, strict=True):
            images[a:b] = part.result()
    return images


def rmse(volume: np.ndarray, truth: np.ndarray, held: np.ndarray) -> float:
    """Root mean square error over some voxels [1/mm]."""
    return float(np.sqrt(np.mean((volume[held] - truth[held]) ** 2)))


def keep(folder: Path, scan: clra.Scan, result: AlignmentResult) -> None:
    """Write the scan, the motion and the report."""
    folder.mkdir(parents=True, exist_ok=True)
    write_scan(folder / "scan.nxs", scan)
    result = annotated(result, scan)
    write_alignment(folder / "motion.h5", result)
    write_report(folder / "report.html", findings_of(result, scan))


def main() -> None:
    """Run it and print two Markdown tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=int, default=16)
    parser.add_argument("--schedule", default="4QR-2HR")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    geometry = geometry_of(options.scale)
    motion, sample = stage_motion(geometry), core_of(geometry)
    images = radiographs(sample, geometry.with_motion(motion))
    scan = clra.Scan(images, geometry, name="wood", truth=motion)
    result = clra.align(scan, schedule=options.schedule)
    print("| iteration | raw u | raw v | gauge-free u | gauge-free v | magnification | time |")
    print("|---|---|---|---|---|---|---|")
    for step in result.history:
        print(
            f"| {step.level} {step.iteration} | {step.mae_u:.3f} | {step.mae_v:.3f} | "
            f"{step.gauge_free_u:.3f} | {step.gauge_free_v:.3f} | {step.mae_m:.1e} | "
            f"{step.seconds:.1f} s |"
        )
    if options.output:
        keep(options.output, scan, result)
    grid = default_grid(geometry)
    truth, best = sample.volume(grid), None
    print("\n| motion | RMSE, 1/mm | from the volume with the true one, 1/mm | time |")
    print("|---|---|---|---|")
    for name, known in (("true", motion), ("estimated", result.motion), ("uncorrected", None)):
        started = time.perf_counter()
        volume = clra.reconstruct(scan, "katsevich", grid, motion=known)
        seconds = time.perf_counter() - started
        best = volume if best is None else best
        held = best != 0  # where the scan holds the pi-interval
        errors = [rmse(volume, other, held) for other in (truth, best)]
        print(f"| {name} | {errors[0]:.4f} | {errors[1]:.4f} | {seconds:.1f} s |", flush=True)
        if options.output:
            write_volume(options.output / f"{name}.h5", volume, grid)


if __name__ == "__main__":
    main()
