"""How much of a drift of the source a shift and a magnification explain, and how much is parallax.

``python tools/source_drift.py`` simulates a porous sample in the geometry of the paper's scan of
wood (source to axis 2.8823 mm, to the panel 315.5 mm, fan 67 degrees), by closed form, from where
the source really was; aligns it with ``estimate="shift+scale"`` and ``"source"``; and prints the
residual of the re-projection (median over the views, in the band that is registered) as a Markdown
table. "true" is the residual with the true geometry: the reconstruction's own. Panels are square,
or flat, where the cone is so low that ramp-filtered back-projection leaves little.
"""

import clra
from clra.model.gauge import Gauge, sample_points, without_gauge
from clra.model.grid import default_grid
from clra.model.perturbation import smooth_motion
from clra.model.phantom import porous

PANEL, SOURCE, DETECTOR = 422.56, 2.8823, 315.5  # mm
# Rows, columns, views, largest shift at the depth of the axis [pixel]
CASES = [(160, 160, 360, 4.0), (160, 160, 360, 8.0), (240, 240, 600, 6.0), (80, 320, 600, 8.0)]
HEAD = (
    "| panel | drift [pixel] | true | shift+scale | source | excess left | error of shift+scale | "
    "of source [pixel] |\n|---|---|---|---|---|---|---|---|"
)


def drifting(rows: int, columns: int, views: int, shift: float) -> clra.Scan:
    """Return a scan whose source drifts; its truth is the apparent motion."""
    pixel = PANEL / columns
    height = 0.5 * rows * pixel * SOURCE / DETECTOR
    panel = {"source_to_axis": SOURCE, "source_to_detector": DETECTOR, "pixel_size": pixel}
    geometry = clra.space_filling(views, z_step=height / views, shape=(rows, columns), **panel)
    grid = default_grid(geometry)
    drift = smooth_motion(views, seed=2, shift=(-shift, shift), magnification=0.004)
    truth = without_gauge(drift, geometry, [sample_points(grid)]).caused_by("source")
    sample = porous(0.45 * grid.shape[1] * grid.voxel_size, 2.2 * height, 3, count=600)
    radiographs = sample.line_integrals(geometry.with_motion(truth), oversample=2)
    return clra.Scan(radiographs, geometry, truth=truth)


def residual(scan: clra.Scan, motion: clra.Motion, estimate: str) -> float:
    """Return what is left of the radiographs with a motion, at full resolution."""
    once = clra.align(scan, schedule="1FR", estimate=estimate, motion=motion)
    return once.history[0].residual


def row(rows: int, columns: int, views: int, shift: float) -> str:
    scan = drifting(rows, columns, views, shift)
    assert scan.truth is not None
    gauge = Gauge(scan.geometry, sample_points(default_grid(scan.geometry)))
    left, errors = {"true": residual(scan, scan.truth, "source")}, []
    for estimate in ("shift+scale", "source"):
        found = clra.align(scan, schedule="4QR-4HR-1FR", estimate=estimate).motion
        left[estimate] = residual(scan, found, estimate)
        error = gauge.error(found, scan.truth)
        errors.append(f"{error.gauge_free_u:.3f}, {error.gauge_free_v:.3f}")
    excess = (left["source"] - left["true"]) / (left["shift+scale"] - left["true"])
    percent = 100 * max(excess, 0.0)
    numbers = " | ".join(f"{value:.4f}" for value in left.values())
    return (
        f"| {rows} x {columns}, {views} views | {shift:g} | {numbers} | {percent:.1f} % | "
        f"{' | '.join(errors)} |"
    )


def main() -> None:
    print(HEAD)
    for case in CASES:
        print(row(*case), flush=True)


if __name__ == "__main__":
    main()
