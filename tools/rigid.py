"""Rigid motion of the sample in six degrees of freedom a view: what alignment finds of it.

``python tools/rigid.py -o FOLDER`` simulates scans whose sample moves and turns in every view,
aligns them by ``estimate="rigid"``, by shifts alone beside it, and prints a Markdown table.
``--only NAME`` measures some of CASES, ``--seeds`` others. Each result is kept in FOLDER/rigid.json
as soon as it is there: started again, the tool goes on where it was stopped. ``--cost`` prints the
processor time of an iteration instead. Balls are projected in closed form; "rock" is a real
sandstone (CLRA_TEST_DATA/rock), projected by itk-rtk.

A voxel is 1 mm, and one pixel at the axis. Errors are those left once the sample has been moved and
scaled as a whole to fit best: mean absolute displacement of its points in u and v [pixel], standard
deviations over the views of the rotations about u, v and the beam [degree], and, in the order u, v,
magnification and rotations, the same over the root mean square of the standard errors: 0 for what
was rightly taken as none. "wobble" turns each view about u and the beam by up to so many degrees.

The competitor's case (TomoJAX, its documentation) is 64 pixels, 120 views, without noise, three
translations of +-1.5 pixel and rotations of +-0.3 degrees: it claims 0.004 to 0.07 pixel and 0.16
degrees (norm).
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rigid_scans import CASES, Case, simulated

import clra
from clra.methods.alignment.level import Level
from clra.methods.alignment.options import Solver
from clra.methods.alignment.region import Region
from clra.methods.alignment.rigid.rigid_level import RigidLevel
from clra.model.rigid.rigid_gauge import between
from clra.model.rigid.rigid_motion import (
    RigidMotion,
    rotation_matrices,
    rotation_vectors,
    view_axes,
)
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

HEAD = (
    "| case | views | before: u, v; rotations | shifts alone: u, v | rigid: u, v | rotations about "
    "u, v, beam | norm | error / sigma | CPU time [s] |\n|---|---|---|---|---|---|---|---|---|"
)


def score(
    estimate: clra.ConeBeamGeometry, true: clra.ConeBeamGeometry, points: Floats
) -> dict[str, Any]:
    """Compare what geometries see of the sample, which may be moved and scaled as a whole."""
    middle, seen = points.mean(axis=0), true.project(points)
    half = np.array([true.columns, true.rows]) / 2
    inside = (np.abs(seen - half + 0.5) < half).all(axis=2)
    moved = np.zeros(7)

    def image(by: Floats) -> Floats:
        turn = rotation_matrices(by[None, 3:6])[0]
        return estimate.project(np.exp(by[6]) * (points - middle) @ turn.T + middle + by[:3])

    for _ in range(6):
        columns = [
            ((image(moved + h) - image(moved - h)) / 2e-4)[inside].ravel() for h in 1e-4 * np.eye(7)
        ]
        error = (image(moved) - seen)[inside].ravel()
        moved -= np.linalg.lstsq(np.stack(columns, axis=1), error, rcond=1e-10)[0]
    apart = np.where(inside[..., None], image(moved) - seen, np.nan)
    shifts = np.nanmean(apart, axis=1)
    u, v = np.nanmean(np.abs(shifts), axis=0)
    # The sample stays where it is instead, and source and detector move.
    turn, scale = rotation_matrices(moved[None, 3:6])[0], np.exp(moved[6])
    source, detector = (
        (a - middle - moved[:3]) @ turn / scale + middle
        for a in (estimate.source, estimate.detector)
    )
    same = clra.ConeBeamGeometry(
        source=source,
        detector=detector,
        u=estimate.u @ turn / scale,
        v=estimate.v @ turn / scale,
        shape=estimate.shape,
    )
    nearer = np.sum((same.source - true.source) * true.normal, axis=1) / true.source_to_axis
    rotations = np.degrees(rotation_vectors(np.swapaxes(view_axes(true), 1, 2) @ view_axes(same)))
    return {
        "u": float(u),
        "v": float(v),
        "six": [*shifts.std(axis=0), nearer.std(), *np.radians(rotations.std(axis=0))],
        "rotations": rotations.std(axis=0).tolist(),
        "norm": float(np.sqrt(np.mean(np.sum(rotations**2, axis=1)))),
    }


def measured(case: Case, seed: int) -> dict[str, Any]:
    """Align one scan by shifts alone and by rigid motion."""
    scan, true, points = simulated(case, seed)
    grid = grid_of(case)
    shifts = clra.align(scan, estimate="shift", grid=grid)
    started = time.process_time()
    rigid = clra.align(scan, estimate="rigid", grid=grid)
    seconds = time.process_time() - started
    errors = score(scan.geometry.with_motion(rigid.motion), true, points)
    sigma = np.sqrt(np.nanmean(rigid.sigma**2, axis=0))
    return {
        "before": score(scan.geometry, true, points),
        "shifts": score(scan.geometry.with_motion(shifts.motion), true, points),
        "rigid": errors,
        "error over sigma": (np.array(errors["six"])[: len(sigma)] / sigma).tolist(),
        "seconds": seconds,
    }


def grid_of(case: Case) -> clra.VolumeGrid:
    """Return where to reconstruct."""
    tall = case.size if case.trajectory == "circle" else int(1.4 * case.size)
    return clra.VolumeGrid(shape=(tall, case.size + 4, case.size + 4), voxel_size=1.0)


def cost(case: Case, repeats: int = 3) -> tuple[float, float]:
    """Return processor times of an iteration by shift and magnification, and of a rigid one [s]."""
    scan, true, _ = simulated(case, 1)
    stream, grid, valid = Stream(None), grid_of(case), np.ones(case.views, np.bool_)
    truth, none = between(scan.geometry, true), np.ones(case.views)
    plain = Level(stream, scan, Region(grid, grid), Solver(), 1)
    rigid = RigidLevel(stream, scan, grid, Solver(), 1, (0, 1, 2, 3, 4, 5), np.zeros(6))
    level = RigidMotion.of(scan.geometry, truth.table * [1, 1, 1, 0, 0, 0])

    def by_shift() -> None:
        plain.residual_motion(
            level.caused_by("detector"),
            none,
            valid_views=valid,
            first=False,
            magnification=True,
            measure=False,
            title="shift",
        )

    def by_rigid() -> None:
        rigid.step(truth, valid_views=valid, measure=False, title="rigid")

    times = []
    for iterate in (by_shift, by_rigid):
        iterate()  # kernels are built
        started = time.process_time()
        for _ in range(repeats):
            iterate()
        times.append((time.process_time() - started) / repeats)
    return times[0], times[1]


def row(name: str, result: dict[str, Any]) -> str:
    """Line of the table."""
    before, shifts, rigid = (result[key] for key in ("before", "shifts", "rigid"))
    cells = [
        name,
        str(result["views"]),
        f"{before['u']:.2f}, {before['v']:.2f}; {before['norm']:.2f}",
        f"{shifts['u']:.3f}, {shifts['v']:.3f}",
        f"{rigid['u']:.4f}, {rigid['v']:.4f}",
        ", ".join(f"{angle:.3f}" for angle in rigid["rotations"]),
        f"{rigid['norm']:.3f}",
        ", ".join(f"{ratio:.1f}" for ratio in result["error over sigma"]),
        f"{result['seconds']:.0f}",
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("."), metavar="FOLDER")
    parser.add_argument("--only", action="append", choices=CASES, default=[])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--views", type=int, help="instead of each case's own")
    parser.add_argument("--cost", action="store_true", help="Time an iteration of each case.")
    options = parser.parse_args()
    if options.cost:
        print("| case | shift+scale [s] | rigid [s] | ratio |\n|---|---|---|---|")
        for name in options.only or CASES:
            one, other = cost(CASES[name])
            print(f"| {name} | {one:.2f} | {other:.2f} | {other / one:.1f} |", flush=True)
        return
    options.output.mkdir(parents=True, exist_ok=True)
    kept = options.output / "rigid.json"
    results = json.loads(kept.read_text()) if kept.is_file() else {}
    print(HEAD)
    for name in options.only or CASES:
        case = CASES[name] if options.views is None else replace(CASES[name], views=options.views)
        for seed in options.seeds:
            key = f"{name}, seed {seed}, {case.views} views"
            if key not in results:
                results[key] = {**measured(case, seed), "views": case.views}
                kept.write_text(json.dumps(results, indent=1) + "\n")
            print(row(name, results[key]), flush=True)


if __name__ == "__main__":
    main()
