"""Noise and texture: the paper's scans with counted photons, of its spheres and of a sandstone.

``CLRA_TEST_DATA=DATA python tools/rock.py --scale 4 -o FOLDER`` aligns twelve scans at a quarter of
the paper's size: {helix, space-filling} x {random, smooth} motions and magnifications of 1 +- 0.002
of

- the stack of spheres in closed form, as ``reproduce_figure3.py`` makes it, moved by up to 10
  pixels;
- a Berea sandstone, DATA/rock/berea_200.npz: its 200^3 voxels, mirrored, fill the cylinder of the
  paper's phantom, as large as half a pixel seen at the axis, whatever the scale: grains of about 14
  pixels. itk-rtk projects them (Joseph) from where source and detector really stood; at a quarter
  of the size by 2 x 2 rays a pixel, whose transmissions are averaged. Alignment itself reconstructs
  from at most half of the detector's resolution, with voxels four times as large. The motion is of
  -10 to 8 pixels over the scale;
- the same with voxels and grains half as large: a quarter of the resolution loses them.

The open beam has 10 000 photons a pixel; line integrals reach 2 and 2.7. Photons are counted as
the radiographs are read, with random numbers of the view, so that nothing is written twice: FOLDER
holds the radiographs without noise, and rock.json each result as soon as it is there. Started
again, the tool goes on where it was stopped. ``--sample spheres`` needs neither DATA nor itk-rtk
and can use the files that ``reproduce_figure3.py`` left, at any scale.
"""

import argparse
import json
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from bench_peers import Rtk
from numpy.typing import NDArray
from paper_sets import MOTIONS, SETS, SHIFT, VOXEL, geometry_of, moved_scan, surfaces
from paper_sets import SAMPLE as SIZE
from reproduce_figure3 import HEAD, row

import clra
from clra.app.simulation import counted
from clra.model.gauge.gauge import Gauge, sample_points, without_gauge
from clra.model.grid import VolumeGrid, default_grid
from clra.model.scan import Projections

SAMPLES = ("spheres", "berea", "fine berea")
PHOTONS, SPREAD = 1e4, 0.002
# The spheres' too: shifted by 10 pixels it is not cut off.
RADIUS = 0.97 * SIZE[1] / 2 * VOXEL
ATTENUATION = 2.5 / (2 * RADIUS)  # of the grains: 2.5 through the axis without pores
CHUNK = 216  # views that itk-rtk projects at a time


class Counted:
    """Radiographs (views, rows, columns) measured by counting photons, as they are read."""

    def __init__(self, projections: Projections) -> None:
        self.shape = projections.shape
        self._projections = projections

    def __getitem__(self, views: slice) -> NDArray[np.float32]:
        """Return some views, always the same."""
        start, stop, _ = views.indices(self.shape[0])
        images = np.array(self._projections[start:stop])

        def count(view: int) -> None:
            images[view - start] = counted(images[view - start], PHOTONS, seed=(1, view))

        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            list(pool.map(count, range(start, stop)))
        return images


def cylinder(scale: int, sample: str) -> VolumeGrid:
    """Return the grid of a rock: of the paper's phantom's size, voxels of 1/2 or 1/4 of a pixel."""
    parts = 4 if sample == "fine berea" else 2
    planes, columns = (parts * n // scale for n in SIZE)
    return VolumeGrid(shape=(planes, columns, columns), voxel_size=VOXEL * scale / parts)


def berea(grid: VolumeGrid) -> NDArray[np.bool_]:
    """Return where the grains are, (z, y, x)."""
    path = Path(os.environ.get("CLRA_TEST_DATA", "")) / "rock" / "berea_200.npz"
    if not path.is_file():
        sys.exit(f"CLRA_TEST_DATA: found no {path}, expected a folder that holds rock/{path.name}")
    grains = ~np.load(path)["im"]
    more = [(0, n - m) for n, m in zip(grid.shape, grains.shape, strict=True)]
    grains = np.pad(grains, more, mode="symmetric")
    x, y, _ = grid.coordinates()
    grains &= np.hypot(x, y[:, None]) < RADIUS
    return grains


def split(geometry: clra.ConeBeamGeometry, motion: clra.Motion, parts: int) -> Any:
    """Return the geometry with the motion absorbed and each pixel cut in `parts` x `parts`.

    All pixels are of one size, as RTK wants them: a magnification moves the detector along its
    rays.
    """
    moved, farther = geometry.with_motion(motion), motion.magnification[:, None]
    return clra.ConeBeamGeometry(
        source=moved.source,
        detector=moved.source + farther * (moved.detector - moved.source),
        u=moved.u * farther / parts,
        v=moved.v * farther / parts,
        shape=(geometry.rows * parts, geometry.columns * parts),
    )


def project(
    geometry: clra.ConeBeamGeometry, motion: clra.Motion, grid: VolumeGrid, parts: int, path: Path
) -> None:
    """Write a rock's radiographs, line integrals without noise; the file appears whole."""
    fine, grains, projector = split(geometry, motion, parts), berea(grid), Rtk()
    partial = path.with_suffix(".partial")
    shape = (geometry.views, *geometry.shape)
    images = np.lib.format.open_memmap(partial, "w+", np.float32, shape)
    for start in range(0, geometry.views, CHUNK):
        print(f"{path.stem}: projecting view {start} of {geometry.views}", file=sys.stderr)
        chosen = slice(start, start + CHUNK)
        lengths = projector.forward(fine.subset(chosen), grid, grains)()()
        transmitted = np.exp(-ATTENUATION * lengths)
        blocks = transmitted.reshape(-1, geometry.rows, parts, geometry.columns, parts)
        images[chosen] = -np.log(blocks.mean(axis=(2, 4)))
    images.flush()
    partial.rename(path)


def rock_scan(sample: str, trajectory: str, motion: str, scale: int, folder: Path) -> clra.Scan:
    """Return a moved scan of a rock, its radiographs on disk."""
    geometry, grid = geometry_of(trajectory, scale), cylinder(scale, sample)
    span = SHIFT[0] / scale, SHIFT[1] / scale
    drawn = MOTIONS[motion](geometry.views, seed=1, shift=span, magnification=SPREAD)
    clouds = [sample_points(default_grid(geometry)), sample_points(grid, seed=1)]
    truth = without_gauge(drawn, geometry, clouds)
    path = folder / f"{sample}-{trajectory}-{motion}-{scale}-{SPREAD:g}.npy".replace(" ", "-")
    if not path.exists():
        project(geometry, truth, grid, scale // 2, path)
    return clra.Scan(np.load(path, mmap_mode="r"), geometry, name=path.stem, truth=truth)


def run(sample: str, trajectory: str, motion: str, scale: int, folder: Path) -> dict[str, float]:
    """Align one scan with counted photons."""
    if sample == "spheres":
        scan, points = moved_scan(trajectory, motion, scale, SPREAD, folder), surfaces()
    else:
        scan = rock_scan(sample, trajectory, motion, scale, folder)
        points = sample_points(cylinder(scale, sample))
    noisy = clra.Scan(Counted(scan.projections), scan.geometry, name=scan.name, truth=scan.truth)
    started = time.perf_counter()
    found = clra.align(noisy).motion
    seconds = time.perf_counter() - started
    error = Gauge(scan.geometry, points, magnification=False).error(found, scan.truth)
    return {**error.means(), "seconds": seconds}


def main() -> None:
    """Run what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=int, choices=(1, 2, 4), default=4)
    parser.add_argument("--sample", choices=(*SAMPLES, "all"), default="all")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    if options.scale == 1 and options.sample != "spheres":
        parser.error(
            "--scale 1: expected --sample spheres: the rock has no finer voxels than these"
        )
    options.output.mkdir(parents=True, exist_ok=True)
    kept = options.output / "rock.json"
    runs: dict[str, Any] = json.loads(kept.read_text()) if kept.exists() else {}
    print(HEAD)
    for sample in SAMPLES if options.sample == "all" else (options.sample,):
        for trajectory, motion in SETS:
            key = f"{options.scale} {sample} {trajectory} {motion}"
            if key not in runs:
                runs[key] = run(sample, trajectory, motion, options.scale, options.output)
                kept.with_suffix(".new").write_text(json.dumps(runs, indent=1))
                kept.with_suffix(".new").replace(kept)
            print(row(key, runs[key]), flush=True)


if __name__ == "__main__":
    main()
