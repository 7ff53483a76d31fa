"""Rigid motion of the sample in six degrees of freedom a view: what alignment finds of it.

``python tools/rigid.py -o FOLDER`` simulates scans whose sample moves and turns in every view, in
closed form, aligns them by ``estimate="rigid"``, by shifts alone beside it, and prints a Markdown
table. ``--only NAME`` measures some of CASES, ``--seeds`` others. Each result is kept in
FOLDER/rigid.json as soon as it is there: started again, the tool goes on where it was stopped.

A voxel is 1 mm, and one pixel at the axis. Errors are those left once the sample has been moved and
scaled as a whole to fit best: mean absolute displacement of its points in u and v [pixel], standard
deviations over the views of the rotations about u, v and the beam [degree], and the same over what
the alignment says of them. "wobble" turns each view about u and the beam by up to so many degrees.

The competitor's case (TomoJAX, its documentation) is 64 pixels, 120 views, without noise, three
translations of +-1.5 pixel and rotations of +-0.3 degrees: it claims 0.004 to 0.07 pixel and 0.16
degrees (norm).
"""

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import clra
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.model.phantoms.perturbation import smooth_motion
from clra.model.rigid.rigid_gauge import between
from clra.model.rigid.rigid_motion import (
    RigidMotion,
    rotation_matrices,
    rotation_vectors,
    view_axes,
)

Floats = NDArray[np.float64]

HEAD = (
    "| case | views | before: u, v; rotations | shifts alone: u, v | rigid: u, v | rotations about "
    "u, v, beam | norm | error / sigma | time [s] |\n|---|---|---|---|---|---|---|---|---|"
)


@dataclass(frozen=True)
class Case:
    """A scan: its trajectory, size [pixel], views and motion."""

    trajectory: str = "circle"
    size: int = 64
    views: int = 120
    across: float = 3.0  # shifts along u and v, at most [mm]
    along: float = 0.0  # along the beam
    turn: float = 0.3  # about each axis, at most [degree]
    smooth: bool = False
    wobble: float = 0.0  # about u and the beam instead [degree]
    photons: float = 0.0  # a pixel of the open beam; 0 for no noise


CASES = {
    "competitor's": Case(across=1.5, along=1.5),
    "circle, 64": Case(),
    "circle, 128": Case(size=128, views=180),
    "circle, 128, 1e4 photons": Case(size=128, views=180, photons=1e4),
    "circle, drift": Case(along=1.5, smooth=True),
    "helix, 64": Case("helix", views=180),
    "space-filling, 64": Case("space-filling", views=180),
    "wobble 0.5, 160": Case(size=160, views=180, across=0, turn=0, wobble=0.5),
    "wobble 2, 160": Case(size=160, views=180, across=0, turn=0, wobble=2.0),
    "still, 64": Case(across=0, turn=0),
    "shifts only, 64": Case(turn=0),
}


def nominal(case: Case) -> clra.ConeBeamGeometry:
    """Return the geometry without motion: one pixel at the axis is a voxel."""
    n = case.size
    scanner: dict[str, Any] = {
        "source_to_axis": 2.5 * n,
        "source_to_detector": 3.75 * n,
        "pixel_size": 1.5,
        "shape": (n // 2 + n // 8 if case.trajectory != "circle" else n + n // 4, n + n // 4),
    }
    step = 0.75 * n / (case.views - 1)
    if case.trajectory == "circle":
        return clra.circular(case.views, **scanner)
    if case.trajectory == "helix":
        turns = 6 * np.pi / case.views
        return clra.helix(case.views, angle_step=turns, z_step=step, **scanner)
    return clra.space_filling(case.views, z_step=step, angle_step=np.radians(15.264), **scanner)


def balls(case: Case, seed: int) -> Ellipsoids:
    """Return forty balls in a cylinder, none in another."""
    random = np.random.default_rng(seed)
    radius, height = 0.36 * case.size, case.size * (0.75 if case.trajectory == "circle" else 1.15)
    centres, radii = np.empty((0, 3)), np.empty(0)
    while len(radii) < 40:
        r = radius * random.uniform(0.06, 0.2)
        away, angle = (radius - r) * np.sqrt(random.random()), 2 * np.pi * random.random()
        z = random.uniform(r - height / 2, height / 2 - r)
        centre = np.array([away * np.cos(angle), away * np.sin(angle), z])
        if (np.linalg.norm(centres - centre, axis=1) > r + radii).all():
            centres, radii = np.vstack([centres, centre]), np.append(radii, r)
    return Ellipsoids(centres, radii, random.uniform(0.5, 1.5, 40))


def true_motion(case: Case, seed: int) -> RigidMotion:
    """Return the motion of a case."""
    random = np.random.default_rng(1000 + seed)
    size = np.array([case.across, case.across, case.along, *np.radians([case.turn] * 3)])
    if case.wobble:
        size[[3, 5]] = np.radians(case.wobble)
    if not case.smooth:
        return RigidMotion.of(nominal(case), size * random.uniform(-1, 1, (case.views, 6)))
    curves = [smooth_motion(case.views, shift=(-1.0, 1.0), seed=seed + k) for k in range(3)]
    unit = np.stack([c for one in curves for c in (one.shift_u, one.shift_v)], axis=1)
    return RigidMotion.of(nominal(case), size * unit)


def simulated(case: Case, seed: int) -> tuple[clra.Scan, clra.ConeBeamGeometry, Ellipsoids]:
    """Return a scan as it is told, the geometry it really had, and its sample."""
    ideal, phantom = nominal(case), balls(case, seed)
    true = ideal.with_motion(true_motion(case, seed))
    images = phantom.line_integrals(true, oversample=2)
    images *= np.float32(2.5 / images.max())
    if case.photons:
        counts = np.random.default_rng(seed).poisson(case.photons * np.exp(-images))
        images = -np.log(np.maximum(counts, 1) / case.photons).astype(np.float32)
    return clra.Scan(images, ideal, name="simulated"), true, phantom


def score(
    estimate: clra.ConeBeamGeometry, true: clra.ConeBeamGeometry, phantom: Ellipsoids
) -> dict[str, Any]:
    """Compare what geometries see of the sample, which may be moved and scaled as a whole."""
    random = np.random.default_rng(3)
    directions = random.normal(size=(600, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    which = np.arange(600) % len(phantom)
    points = phantom.centres[which] + phantom.semi_axes[which, :1] * directions
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
    turn = rotation_matrices(moved[None, 3:6])[0]
    axes = np.swapaxes(view_axes(true), 1, 2) @ (turn.T @ view_axes(estimate))
    rotations = np.degrees(rotation_vectors(axes))
    return {
        "u": float(u),
        "v": float(v),
        "shifts": shifts.std(axis=0).tolist(),
        "rotations": rotations.std(axis=0).tolist(),
        "norm": float(np.sqrt(np.mean(np.sum(rotations**2, axis=1)))),
    }


def measured(case: Case, seed: int) -> dict[str, Any]:
    """Align one scan by shifts alone and by rigid motion."""
    scan, true, phantom = simulated(case, seed)
    tall = case.size if case.trajectory == "circle" else int(1.4 * case.size)
    grid = clra.VolumeGrid(shape=(tall, case.size + 4, case.size + 4), voxel_size=1.0)
    shifts = clra.align(scan, estimate="shift", grid=grid)
    started = time.perf_counter()
    rigid = clra.align(scan, estimate="rigid", grid=grid)
    seconds = time.perf_counter() - started
    found = scan.geometry.with_motion(rigid.motion)
    errors = score(found, true, phantom)
    size = between(true, found).magnification.std()
    spread = [*errors["shifts"], size, *np.radians(errors["rotations"])]
    sigma = np.sqrt(np.nanmean(rigid.sigma**2, axis=0))
    ratio = np.array(spread[: len(sigma)]) / sigma
    return {
        "before": score(scan.geometry, true, phantom),
        "shifts": score(scan.geometry.with_motion(shifts.motion), true, phantom),
        "rigid": errors,
        "error over sigma": ratio.tolist(),
        "seconds": seconds,
    }


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
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--only", action="append", choices=CASES, default=[])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--views", type=int, help="instead of each case's own")
    options = parser.parse_args()
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
