"""How much of a drift of the source a shift and a magnification explain, and how much is parallax.

``python tools/source_drift.py`` simulates a porous sample in the geometry of the paper's scan of
wood (source to axis 2.8823 mm, to the detector 315.5 mm, fan 67 degrees), by closed form, from
where the source really was; aligns it with ``estimate="shift+scale"`` and ``"source"``; and
prints the residual of the re-projection (median over the views, in the band that is registered)
as a Markdown table. "true" is the residual with the true geometry: the reconstruction's own, which
hides the motion's. It is given for ramp-filtered back-projection and for the same corrected once by
what its re-projections lack. Detectors are square, or flat, where the cone is so low that
ramp-filtered back-projection leaves little. In micrometres, a drift is that of the source if its
pixels are those of the paper's detector.
"""

import numpy as np

import clra
from clra.methods.alignment.reprojection import (
    registration_for,
    reproject_and_register,
    with_margin,
)
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.methods.reconstruction.fitted_fbp import fitted_fbp
from clra.model.gauge.gauge import Gauge, sample_points, without_gauge
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import porous
from clra.model.phantoms.perturbation import smooth_motion
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import Volume

DETECTOR, SOURCE, DETECTOR = 422.56, 2.8823, 315.5  # mm
PAPER_PIXEL = 139.0  # um
# Rows, columns, views, largest shift at the depth of the axis [pixel]
CASES = [(160, 160, 360, 4.0), (160, 160, 360, 8.0), (80, 320, 600, 4.0), (80, 320, 600, 12.0)]
HEAD = (
    "| detector | drift [pixel] | [um] | left by ramp-FBP: true, shift+scale, source | ratio | "
    "corrected: true, shift+scale, source | ratio | error of shift+scale, u, v | of source |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


def drifting(rows: int, columns: int, views: int, shift: float) -> clra.Scan:
    """Return a scan whose source drifts; its truth is the apparent motion."""
    pixel = DETECTOR / columns
    height = 0.5 * rows * pixel * SOURCE / DETECTOR
    detector = {"source_to_axis": SOURCE, "source_to_detector": DETECTOR, "pixel_size": pixel}
    geometry = clra.space_filling(views, z_step=height / views, shape=(rows, columns), **detector)
    grid = default_grid(geometry)
    drift = smooth_motion(views, seed=2, shift=(-shift, shift), magnification=0.004)
    truth = without_gauge(drift, geometry, [sample_points(grid)]).caused_by("source")
    sample = porous(0.45 * grid.shape[1] * grid.voxel_size, 2.2 * height, 3, count=600)
    radiographs = sample.line_integrals(geometry.with_motion(truth), oversample=2)
    return clra.Scan(radiographs, geometry, truth=truth)


def residuals(scan: clra.Scan, motion: clra.Motion) -> tuple[float, float]:
    """Return what two volumes leave of the radiographs: ramp-FBP, and the same corrected."""
    stream = Stream()
    geometry = scan.geometry.with_motion(motion)
    radiographs = Radiographs(stream, scan, 1)
    grid = with_margin(default_grid(scan.geometry))
    volume = ramp_fbp(stream, radiographs, geometry, grid, stage="reconstructing")
    left = [_left(stream, scan, radiographs, volume, motion)]
    used = np.ones(scan.geometry.shape, np.bool_)
    volume = fitted_fbp(
        stream, radiographs, geometry, grid,
        positive=True, terms=1, used=used, valid_views=np.ones(scan.views, np.bool_),
        circle=True, stage="reconstructing",
    )  # fmt: skip
    left.append(_left(stream, scan, radiographs, volume, motion))
    return left[0], left[1]


def _left(
    stream: Stream, scan: clra.Scan, radiographs: Radiographs, volume: Volume, motion: clra.Motion
) -> float:
    """Median residual of the radiographs, registered with a volume's re-projections."""
    registration = registration_for(stream, scan, radiographs, first=True, magnification=True)
    found = reproject_and_register(
        stream,
        radiographs,
        volume,
        scan.geometry.with_motion(motion),
        registration,
        magnification=motion.magnification,
        detector=scan.geometry.shape,
    )
    return float(np.median(found.residual))


def row(rows: int, columns: int, views: int, shift: float) -> str:
    """Return a line of the table."""
    scan = drifting(rows, columns, views, shift)
    assert scan.truth is not None
    gauge = Gauge(scan.geometry, sample_points(default_grid(scan.geometry)))
    left, errors = [residuals(scan, scan.truth)], []
    for estimate in ("shift+scale", "source"):
        found = clra.align(scan, schedule="4QR-4HR-1FR", estimate=estimate).motion
        left.append(residuals(scan, found))
        error = gauge.error(found, scan.truth)
        errors.append(f"{error.gauge_free_u:.3f}, {error.gauge_free_v:.3f}")
    numbers = [
        f"{', '.join(f'{value:.4f}' for value in values)} | {values[2] / values[1]:.2f}"
        for values in zip(*left, strict=True)
    ]
    moved = shift * PAPER_PIXEL / (DETECTOR / SOURCE - 1)
    return (
        f"| {rows} x {columns}, {views} views | {shift:g} | {moved:.0f} | "
        f"{' | '.join(numbers)} | {' | '.join(errors)} |"
    )


def main() -> None:
    print(HEAD)
    for case in CASES:
        print(row(*case), flush=True)


if __name__ == "__main__":
    main()
