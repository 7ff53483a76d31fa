"""The paper's simulation, its Figures 1 and 3, what is past it, and what each part is worth.

``python tools/reproduce_figure3.py --scale 1 -o FOLDER`` is the paper's size (3456 radiographs, we
take 928 x 512); ``--scale 4`` a quarter of it in every respect. Four scans, {helix, space-filling}
x {random, smooth}, of a stack of three spheres in closed form, with motions of -10 to 8 pixels over
the scale, without what a movement of the sample would explain. FR, 1QR-1HR and 2QR-2HR run with the
paper's estimator (shifts only) and with ours, beside our ``auto``. Each run is kept in
FOLDER/runs.json as soon as it is done: started again, the tool goes on where it was stopped.
``--estimator`` and ``--schedules`` choose some. Radiographs are written to FOLDER once and mapped.

``--ablation`` runs ``auto`` without one part of the solver after the other, magnifications of 1 +-
0.002 estimated too.
"""

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

import clra
from clra.methods.solver import Solver
from clra.model.gauge import Gauge, sample_points, without_gauge
from clra.model.grid import VolumeGrid, default_grid
from clra.model.motion import Motion
from clra.model.perturbation import random_motion, smooth_motion
from clra.model.phantom import three_spheres
from clra.model.trajectory import PAPER

VIEWS, VOXEL, SAMPLE = 3456, 0.004544, (1248, 480)  # planes and columns of the phantom
SPHERES = three_spheres(SAMPLE[1] / 2 * VOXEL, SAMPLE[0] * VOXEL)
MOTIONS = {"random": random_motion, "smooth": smooth_motion}
SETS = [(t, m) for t in ("helix", "space-filling") for m in MOTIONS]
SCHEDULES = ("4FR", "1QR-1HR", "2QR-2HR", "auto")
COST = {"FR": 1.0, "HR": 1 / 4, "QR": 1 / 16, "ER": 1 / 64}  # of an iteration, as the paper counts
ABLATION: dict[str, dict[str, Any]] = {
    "everything": {},
    "phase correlation": {"estimator": "phase-correlation"},
    "no Anderson": {"memory": 0},
    "gauge not anchored": {"gauge": "free"},
    "no circle": {"circle": False},
    "bias left in": {"unbias": False},
    "magnification from the start": {"shifts_first": False},
    "no prior": {"spread": 0.0},
    "prior 1e-3": {"spread": 1e-3},
}


def geometry_of(trajectory: str, scale: int) -> clra.ConeBeamGeometry:
    """Return the paper's trajectory with `scale` times larger pixels and as much fewer views."""
    rows, columns = PAPER["shape"]
    panel = {
        **PAPER,
        "shape": (rows // scale, columns // scale),
        "pixel_size": PAPER["pixel_size"] * scale,
        "z_step": PAPER["z_step"] * scale,
    }
    if trajectory == "helix":
        return clra.helix(VIEWS // scale, angle_step=math.radians(0.5 * scale), **panel)
    return clra.space_filling(VIEWS // scale, **panel)


def surfaces(count: int = 1500) -> np.ndarray:
    """Points on the spheres, where their edges are."""
    direction = np.random.default_rng(0).normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    chosen = np.arange(count) % len(SPHERES.centres)
    return SPHERES.centres[chosen] + direction * SPHERES.semi_axes[chosen]


def moved_scan(
    trajectory: str, motion: str, scale: int, magnification: float, folder: Path
) -> clra.Scan:
    """Return one of the sets, its radiographs on disk."""
    geometry = geometry_of(trajectory, scale)
    span = (-10 / scale, 8 / scale)
    drawn = MOTIONS[motion](geometry.views, seed=1, shift=span, magnification=magnification)
    clouds = [sample_points(default_grid(geometry)), surfaces()]
    truth = without_gauge(drawn, geometry, clouds, magnification > 0)
    path = folder / f"{trajectory}-{motion}-{scale}-{magnification:g}.npy"
    if not path.exists():
        shape = (geometry.views, *geometry.shape)
        partial = path.with_suffix(".partial")
        images = np.lib.format.open_memmap(partial, "w+", np.float32, shape)
        moved = geometry.with_motion(truth)
        for start in range(0, geometry.views, 32):
            stop = min(start + 32, geometry.views)
            images[start:stop] = SPHERES.line_integrals(moved, start, stop)
        images.flush()
        partial.rename(path)
    return clra.Scan(np.load(path, mmap_mode="r"), geometry, name=path.stem, truth=truth)


def errors(motion: Motion, truth: Motion, geometry: clra.ConeBeamGeometry) -> dict[str, float]:
    """Mean absolute errors, raw and gauge-free, and deviations; pixels."""
    found, true = (Motion(shift_u=m.shift_u, shift_v=m.shift_v) for m in (motion, truth))
    error = Gauge(geometry, surfaces(), magnification=False).error(found, true)
    names = ("mae_u", "mae_v", "std_u", "std_v", "gauge_free_u", "gauge_free_v")
    row = {name: getattr(error, name) for name in names}
    return row | {"mae_m": float(np.abs(motion.magnification - truth.magnification).mean())}


def run(scan: clra.Scan, schedule: str, estimate: str, options: dict[str, Any]) -> dict[str, Any]:
    """Align once; errors after each iteration and at the end."""
    gauge = options.get("gauge", "anchored")
    parts = {name: value for name, value in options.items() if name != "gauge"}
    started = time.perf_counter()
    result = clra.align(
        scan, schedule=schedule, estimate=estimate, gauge=gauge, solver=Solver(**parts)
    )
    keys = ("level", "mae_u", "mae_v")
    return {
        "iterations": [{key: getattr(step, key) for key in keys} for step in result.history],
        "seconds": time.perf_counter() - started,
        **errors(result.motion, scan.truth, scan.geometry),
    }


def main() -> None:
    """Run what is missing, print tables and check the paper's claims, draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--schedules", default=",".join(SCHEDULES))
    parser.add_argument("--estimator", choices=("ours", "paper", "both"), default="both")
    parser.add_argument("--ablation", action="store_true")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    kept = options.output / "runs.json"
    runs: dict[str, Any] = json.loads(kept.read_text()) if kept.exists() else {}

    def ensure(key: str, scan: clra.Scan, *arguments: Any) -> None:
        if key not in runs:
            runs[key] = run(scan, *arguments)
            kept.with_suffix(".new").write_text(json.dumps(runs, indent=1))
            kept.with_suffix(".new").replace(kept)
        print(row(key, runs[key]), flush=True)

    print(HEAD)
    for trajectory, motion in SETS:
        name = f"{options.scale} {trajectory} {motion}"
        if options.ablation:
            scan = moved_scan(trajectory, motion, options.scale, 0.002, options.output)
            for part, switched in ABLATION.items():
                ensure(f"{name} {part}", scan, "auto", "shift+scale", switched)
            continue
        scan = moved_scan(trajectory, motion, options.scale, 0.0, options.output)
        for schedule in options.schedules.split(","):
            if options.estimator != "ours" and schedule != "auto":
                paper = {"estimator": "phase-correlation", "memory": 0, "unbias": False}
                paper |= {"circle": False, "gauge": "free"}
                ensure(f"{name} paper {schedule}", scan, schedule, "shift", paper)
            if options.estimator != "paper":
                ensure(f"{name} ours {schedule}", scan, schedule, "shift", {})
        if options.estimator != "paper":
            scan = moved_scan(trajectory, motion, options.scale, 0.002, options.output)
            ensure(f"{name} ours with magnification auto", scan, "auto", "shift+scale", {})
    if not options.ablation:
        for line in claims(runs, options.scale):
            print(line)
        draw(runs, options.scale, options.output / f"figure3-{options.scale}.png")


HEAD = (
    "| run | raw u | raw v | gauge-free u | gauge-free v | magnification | time |\n"
    "|---|---|---|---|---|---|---|"
)


def row(key: str, found: dict[str, Any]) -> str:
    """Return a line of the table."""
    shifts = ("mae_u", "mae_v", "gauge_free_u", "gauge_free_v")
    numbers = " | ".join(f"{found[name]:.3f}" for name in shifts)
    return f"| {key} | {numbers} | {found['mae_m']:.1e} | {found['seconds']:.0f} s |"


def claims(runs: dict[str, Any], scale: int) -> list[str]:
    """Say which of the paper's claims hold with its own estimator."""

    def mae(trajectory: str, motion: str, schedule: str, after: int = -1) -> float:
        found = runs.get(f"{scale} {trajectory} {motion} paper {schedule}")
        if found is None:
            return math.nan
        step = found["iterations"][after]
        return float(step["mae_u"] + step["mae_v"]) / 2

    space = [mae("space-filling", motion, "1QR-1HR") for motion in MOTIONS]
    helix = [mae("helix", motion, "2QR-2HR") for motion in MOTIONS]
    cheap = [mae(*which, "1QR-1HR") - mae(*which, "4FR", 1) for which in SETS]
    said = {
        f"space-filling does not care which motion it is: {space[0]:.2f} and {space[1]:.2f}": max(
            space
        )
        < 1.5 * min(space),
        f"smooth converges slower than random on a helix: {helix[1]:.2f} and {helix[0]:.2f}": helix[
            1
        ]
        > helix[0],
        f"1QR-1HR beats two FR iterations on {sum(c < 0 for c in cheap)} of 4 sets": all(
            c < 0 for c in cheap
        ),
    }
    return [f"{'holds' if holds else 'does not hold'}: {text}" for text, holds in said.items()]


def draw(runs: dict[str, Any], scale: int, path: Path) -> None:
    """Draw the paper's Figures 1 and 3."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 4, figsize=(15, 6.4), layout="constrained")
    grid = VolumeGrid(shape=(312, 1, 120), voxel_size=4 * VOXEL)
    axes[0, 0].imshow(SPHERES.volume(grid)[:, 0], cmap="gray", aspect="equal")
    axes[0, 0].set_title("Fig. 1a: x-z slice", fontsize=9)
    axes[0, 0].axis("off")
    drawn = axes[0, 1:3].ravel()
    for axis, (name, made) in zip(drawn, MOTIONS.items(), strict=True):
        moved = made(VIEWS // scale, seed=1)
        axis.plot(moved.shift_u, lw=0.6, label="u")
        axis.plot(moved.shift_v, lw=0.6, label="v")
        axis.set_title(f"Fig. 1: {name} motion, pixels", fontsize=9)
    axes[0, 3].axis("off")
    styles = {"4FR": "k", "1QR-1HR": "C0", "2QR-2HR": "C1", "auto": "C2"}
    plots = [(t, c) for t in ("helix", "space-filling") for c in "uv"]
    for axis, (trajectory, component) in zip(axes[1], plots, strict=True):
        for motion, dash in zip(MOTIONS, ("-", "--"), strict=True):
            for who, width in (("paper", 1.6), ("ours", 0.8)):
                for schedule, colour in styles.items():
                    found = runs.get(f"{scale} {trajectory} {motion} {who} {schedule}")
                    if found is None:
                        continue
                    steps = found["iterations"]
                    cost = np.cumsum([COST[step["level"]] for step in steps])
                    mae = [step[f"mae_{component}"] for step in steps]
                    axis.plot(cost, mae, dash, color=colour, lw=width, marker=".", ms=4)
                    deviation = found[f"std_{component}"]
                    axis.errorbar(cost[-1], mae[-1], deviation, color=colour, lw=width, capsize=2)
                    if axis is axes[1, 0]:
                        label = f"{who} {schedule} {motion}"
                        axes[0, 3].plot([], [], dash, color=colour, lw=width, label=label)
        axis.set(yscale="log", xlabel="cost, FR iterations", ylim=(3e-3, 6))
        axis.set_title(f"Fig. 3: {trajectory}, MAE in {component}, pixels", fontsize=9)
    axes[0, 3].legend(fontsize=7, loc="center", ncols=2)
    figure.savefig(path, dpi=75)


if __name__ == "__main__":
    main()
