"""The paper's Section 3.2 scaled down: multigrid reconstruction without and with alignment inside.

``python tools/imgr_small.py`` reconstructs a simulated space-filling scan (SOD 7.068 mm, SDD 335.6
mm, a twelfth of the paper's pixels and views) of two porous rocks end to end in an aluminium tube,
and prints errors and times as a Markdown table. Motions of up to 2 pixels in u and 1 in v and
magnifications of 0.999 to 1.001, half jitter and half drift, 10000 photons a pixel. The rocks are
the Berea sandstone in the folder ``CLRA_TEST_DATA``, as it is and enlarged, or made here by a
random field; radiographs are made from voxels and pixels half as large. ``--pictures FOLDER``
writes the slices of the paper's Figure 6 and the curves of its Figure 7.

``--overhead`` measures instead what alignment adds to the time, without motion, at 192 and 1024
columns.
"""

import argparse
import os
import statistics
import time
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

import clra
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.methods.reconstruction.imgr import imgr
from clra.methods.reconstruction.osem_tr import OrderedSubsets
from clra.model.gauge.gauge import Gauge, sample_points, without_gauge
from clra.model.grid import VolumeGrid, default_grid
from clra.model.motion import Motion
from clra.model.phantoms.perturbation import random_motion, smooth_motion
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.slab_projector import SlabProjector, constant_volume, volume_from
from clra.ops.streaming.stream import Stream

PIXEL, COLUMNS, VIEWS, PLANES = 0.139, 2304, 4858, 5428  # the paper's
PHOTONS = 1e4
SANDSTONE, CARBONATE, ALUMINIUM = 0.25, 0.32, 0.30  # 1/mm: a transmission of 0.15 or more
ROCK, TUBE = 0.80, (0.84, 0.92)  # radii as parts of the field of view's


def scan_geometry(columns: int, views: int, rows: int | None = None) -> clra.ConeBeamGeometry:
    pixel = PIXEL * COLUMNS / columns
    voxel = pixel * 7.068 / 335.6
    travel = PLANES / COLUMNS * columns * voxel if rows is None else rows * voxel
    return clra.space_filling(
        views,
        z_step=travel / views,
        source_to_axis=7.068,
        source_to_detector=335.6,
        pixel_size=pixel,
        shape=(rows or columns, columns),
    )


def pores() -> np.ndarray:
    """Where a rock is void, cubic, one fifth of it."""
    folder = os.environ.get("CLRA_TEST_DATA")
    if folder:
        return np.load(Path(folder) / "rock" / "berea_200.npz")["im"]
    field = gaussian_filter(np.random.default_rng(0).normal(size=(200, 200, 200)), 4, mode="wrap")
    return field > np.quantile(field, 0.8)


def sample(grid: VolumeGrid, length: float) -> np.ndarray:
    """Attenuation of the two rocks in their tube [1/mm]; the upper pores are half as large."""
    void = pores()
    size = len(void)

    def mirrored(n: int, enlarged: int) -> np.ndarray:
        index = np.arange(n) // enlarged % (2 * size)
        return np.minimum(index, 2 * size - 1 - index)

    x, y, z = grid.coordinates()
    reach = 0.5 * grid.shape[2] * grid.voxel_size
    radius = np.hypot(*np.meshgrid(x, y)) / reach
    rock = radius < ROCK
    tube = (radius > TUBE[0]) & (radius < TUBE[1])
    values = np.zeros(grid.shape, np.float32)
    for plane in np.flatnonzero(np.abs(z - grid.centre[2]) < length / 2):
        upper = z[plane] > grid.centre[2]
        index = [mirrored(n, 1 if upper else 2) for n in grid.shape]
        solid = ~void[index[0][plane]][np.ix_(index[1], index[2])]
        values[plane] = rock * solid * (SANDSTONE if upper else CARBONATE) + tube * ALUMINIUM
    return values


def measured(geometry: clra.ConeBeamGeometry, fine: VolumeGrid, values: np.ndarray) -> np.ndarray:
    """Count photons and return line integrals; a pixel is the mean transmission of 2 x 2 rays."""
    stream = Stream()
    rays = clra.ConeBeamGeometry(
        source=geometry.source,
        detector=geometry.detector,
        u=geometry.u / 2,
        v=geometry.v / 2,
        shape=(2 * geometry.rows, 2 * geometry.columns),
    )
    volume = volume_from(stream, fine, values)
    project = SlabProjector(stream, volume, rays)
    random = np.random.default_rng(1)
    out = np.empty((geometry.views, *geometry.shape), np.float32)
    for chunk in stream.chunks(geometry.views, 4 * rays.rows * rays.columns):
        integrals = stream.empty((chunk.stop - chunk.start, *rays.shape))
        project(integrals, chunk)
        passed = np.exp(-stream.download(integrals).astype(np.float64))
        n = len(passed)
        passed = passed.reshape(n, geometry.rows, 2, geometry.columns, 2).mean(axis=(2, 4))
        out[chunk] = np.log(PHOTONS / np.maximum(random.poisson(PHOTONS * passed), 0.5))
    return out


def moved(geometry: clra.ConeBeamGeometry, grid: VolumeGrid) -> Motion:
    """Motion as in the paper's Figure 7, freed of what a movement of the sample would explain."""
    views = geometry.views
    options = {"shift": (-1.0, 1.0), "magnification": 5e-4}
    both = random_motion(views, seed=0, **options).then(smooth_motion(views, seed=1, **options))
    halved = Motion(
        shift_u=both.shift_u, shift_v=both.shift_v / 2, magnification=both.magnification
    )
    clouds = [sample_points(grid, seed=seed) for seed in range(2)]
    return without_gauge(halved, geometry, clouds)


class Trial:
    """One scan, and what reconstructions of it come to."""

    def __init__(self, columns: int, views: int, length: float) -> None:
        self.geometry = scan_geometry(columns, views)
        self.grid = default_grid(self.geometry)
        self.motion = moved(self.geometry, self.grid)
        whole = self.grid.padded(round(0.35 * self.grid.shape[0]))
        nz, ny, nx = whole.shape
        fine = VolumeGrid(
            shape=(2 * nz, 2 * ny, 2 * nx), voxel_size=whole.voxel_size / 2, centre=whole.centre
        )
        height = length * self.grid.shape[0] * self.grid.voxel_size
        values = sample(fine, height)
        radiographs = measured(self.geometry.with_motion(self.motion), fine, values)
        coarse = values.reshape(nz, 2, ny, 2, nx, 2).mean(axis=(1, 3, 5))
        margin = (nz - self.grid.shape[0]) // 2
        self.truth = coarse[margin : nz - margin]
        self.scan = clra.Scan(radiographs, self.geometry, truth=self.motion)
        x, y, z = self.grid.coordinates()
        self.inside = np.hypot(*np.meshgrid(x, y)) < 0.97 * x[-1]
        # Planes at the ends are seen by half of the views.
        self.planes = np.abs(z - self.grid.centre[2]) < 0.45 * self.grid.voxel_size * len(z)

    def error(self, volume: np.ndarray) -> float:
        """RMS error over RMS attenuation."""
        lack = (volume - self.truth)[self.planes][:, self.inside]
        return float(
            np.sqrt(np.mean(lack**2) / np.mean(self.truth[self.planes][:, self.inside] ** 2))
        )


def fbp(stream: Stream, scan: clra.Scan, motion: Motion | None, grid: VolumeGrid) -> np.ndarray:
    geometry = scan.geometry if motion is None else scan.geometry.with_motion(motion)
    return ramp_fbp(stream, Radiographs(stream, scan, 1), geometry, grid).to_host()


def timed(work):
    started = time.perf_counter()
    result = work()
    return result, time.perf_counter() - started


def compare(trial: Trial, pictures: Path | None) -> None:
    stream, osem = Stream(), OrderedSubsets(i0=PHOTONS)
    scan, grid, truth = trial.scan, trial.grid, trial.motion
    quarter = scan.subset(slice(None, None, 4)), truth.subset(slice(None, None, 4))
    print(
        f"{scan.views} views of {scan.geometry.rows} x {scan.geometry.columns}, volume {grid.shape}"
    )
    print("| reconstruction | RMSE | time [s] |\n|---|---|---|")
    volumes = {}

    def row(name, work, volume_of=lambda found: found):
        found, seconds = timed(work)
        volumes[name] = volume_of(found)
        print(f"| {name} | {trial.error(volumes[name]):.4f} | {seconds:.1f} |", flush=True)
        return found, seconds

    def host(found):
        return found.volume.to_host()

    fbp(stream, scan.subset(slice(0, 8)), None, grid.binned(8))  # builds kernels
    row("ramp-FBP, motion ignored", lambda: fbp(stream, scan, None, grid))
    _, back = row("ramp-FBP, true motion", lambda: fbp(stream, scan, truth, grid))
    row("IMGR without alignment", lambda: imgr(stream, scan, grid, osem=osem), host)
    options = {"align": True, "truth": truth, "osem": osem}
    aligned, with_ra = row("IMGR with alignment", lambda: imgr(stream, scan, grid, **options), host)
    exact = {"motion": truth, "osem": osem}
    _, once = row("IMGR, true motion", lambda: imgr(stream, scan, grid, **exact), host)
    few, motion = quarter
    row("ramp-FBP, true motion, a quarter of the views", lambda: fbp(stream, few, motion, grid))
    exact = {"motion": motion, "osem": osem}
    row("IMGR, true motion, a quarter of the views", lambda: imgr(stream, few, grid, **exact), host)
    project = SlabProjector(stream, constant_volume(stream, grid, 0.1), scan.geometry)

    def forward():
        for chunk in stream.chunks(scan.views, 4 * scan.geometry.rows * scan.geometry.columns):
            project(stream.empty((chunk.stop - chunk.start, *scan.geometry.shape)), chunk)
            stream.queue.finish()

    _, ahead = timed(forward)
    print(
        f"\none ramp-FBP {back:.1f} s, one projection {ahead:.1f} s: IMGR takes {once:.1f} s, ",
        end="",
    )
    print(
        f"{once / (3 * back + ahead):.2f} of three ramp-FBP and a projection; {with_ra:.1f} aligned"
    )
    print("\n| cycle, level | misfit | MAE u | MAE v | gauge-free u, v | magnification |")
    print("|---|---|---|---|---|---|")
    for i in aligned.alignment.history:
        print(
            f"| {i.iteration} {i.level} | {i.misfit:.3g} | {i.mae_u:.3f} | {i.mae_v:.3f} | "
            f"{i.gauge_free_u:.3f}, {i.gauge_free_v:.3f} | {i.mae_m:.1e} |"
        )
    start = Gauge(scan.geometry, sample_points(grid)).error(Motion.identity(scan.views), truth)
    print(f"\nbefore: {start.mae_u:.2f} in u, {start.mae_v:.2f} in v, {start.mae_m:.1e}")
    if pictures is not None:
        draw(pictures, trial, volumes, aligned.motion)


def draw(folder: Path, trial: Trial, volumes: dict[str, np.ndarray], motion: Motion) -> None:
    from matplotlib.figure import Figure

    folder.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(10, 5.2), layout="constrained")
    names = ("IMGR without alignment", "IMGR with alignment")
    for axes, name in zip(figure.subplots(1, 2), names, strict=True):
        plane = volumes[name][3 * trial.grid.shape[0] // 4]
        axes.imshow(plane, cmap="gray", vmin=-0.02, vmax=0.4)
        axes.set_title(name)
        axes.axis("off")
    figure.savefig(folder / "figure6.png", dpi=110)
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name in ("shift_u", "shift_v"):
        left.plot(getattr(motion, name), lw=0.7, label=name)
    left.set(xlabel="view", ylabel="pixel")
    left.legend()
    right.plot(motion.magnification, lw=0.7)
    right.set(xlabel="view", ylabel="magnification")
    figure.savefig(folder / "figure7.png", dpi=110)


def overhead(columns: int, rows: int, views: int, rounds: int) -> None:
    """Time of IMGR without and with registration, in turn; without motion."""
    geometry = scan_geometry(columns, views, rows)
    grid = default_grid(geometry)
    stream = Stream()
    values = sample(grid, 10 * rows * grid.voxel_size)
    project = SlabProjector(stream, volume_from(stream, grid, values), geometry)
    integrals = np.empty((views, rows, columns), np.float32)
    for chunk in stream.chunks(views, 4 * rows * columns):
        part = stream.empty((chunk.stop - chunk.start, rows, columns))
        project(part, chunk)
        integrals[chunk] = stream.download(part)
    counts = np.random.default_rng(0).poisson(PHOTONS * np.exp(-integrals.astype(float)))
    scan = clra.Scan(np.log(PHOTONS / np.maximum(counts, 0.5)).astype(np.float32), geometry)
    osem = OrderedSubsets(i0=PHOTONS)
    seconds = {False: [], True: []}
    for number in range(rounds + 1):
        for align in (False, True):
            _, took = timed(lambda a=align: imgr(stream, scan, grid, align=a, cycles=1, osem=osem))
            if number:  # the first builds kernels
                seconds[align].append(took)
    without, with_ra = (statistics.median(seconds[align]) for align in (False, True))
    per_pixel = (with_ra - without) / (views * rows * columns)
    print(
        f"| {columns} | {views} of {rows} | {without:.2f} | {with_ra:.2f} | "
        f"{100 * (with_ra / without - 1):.0f} % | {1e9 * per_pixel:.0f} |",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--columns", type=int, default=192, help="of the detector")
    parser.add_argument(
        "--length", type=float, default=0.95, help="of the sample, in grids' heights"
    )
    parser.add_argument("--pictures", type=Path, metavar="FOLDER")
    parser.add_argument("--overhead", action="store_true")
    asked = parser.parse_args()
    if asked.overhead:
        print("| columns | views of rows | without [s] | with [s] | more | ns a pixel |")
        print("|---|---|---|---|---|---|")
        overhead(192, 192, 240, 5)
        overhead(384, 384, 120, 3)
        overhead(1024, 128, 90, 3)
        return
    compare(Trial(asked.columns, VIEWS * asked.columns // COLUMNS, asked.length), asked.pictures)


if __name__ == "__main__":
    main()
