"""The paper's simulation, its Figures 1 to 3, what is past it, and what each part is worth.

``python tools/reproduce_figure3.py --scale 1 -o FOLDER`` is the paper's size (3456 radiographs, we
take 928 x 512); ``--scale 4`` has a quarter of the views, rows and columns. Four scans, {helix,
space-filling} x {random, smooth}, of a stack of three spheres in closed form, with motions of -10
to 8 pixels of either detector, without what a movement of the sample would explain. FR, 1QR-1HR and
2QR-2HR run with the paper's estimator (shifts only) and with ours, beside our ``auto``. Each run is
kept in FOLDER/runs.json as soon as it is done: started again, the tool goes on where it was
stopped. ``--estimator`` and ``--schedules`` choose some; at full size leave 4FR to a GPU or a long
evening. Radiographs are written to FOLDER once and mapped: 6.6 GB a scan at full size.

``--ablation`` runs ``auto`` without one part of the solver after the other, magnifications of 1 +-
0.002 estimated too.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

from draw_figure3 import draw
from paper_sets import SETS, errors, moved_scan, rest

import clra
from clra.methods.alignment.options import Solver

SCHEDULES = ("4FR", "1QR-1HR", "2QR-2HR", "auto")
ABLATION: dict[str, dict[str, Any]] = {
    "everything": {},
    "phase correlation": {"solver": Solver(estimator="phase-correlation")},
    "no Anderson": {"solver": Solver(memory=0)},
    "gauge not anchored": {"gauge": "free"},
    "no circle": {"solver": Solver(circle=False)},
    "bias left in": {"solver": Solver(unbias=False)},
    "magnification from the start": {"solver": Solver(shifts_first=False)},
    "no prior": {"solver": Solver(spread=0.0)},
    "prior 1e-3": {"solver": Solver(spread=1e-3)},
}
HEAD = (
    "| run | raw u | raw v | gauge-free u | gauge-free v | magnification | time |\n"
    "|---|---|---|---|---|---|---|"
)


def run(scan: clra.Scan, schedule: str, estimate: str, options: dict[str, Any]) -> dict[str, Any]:
    """Align once; errors after each iteration and at the end."""
    started = time.perf_counter()
    result = clra.align(scan, schedule=schedule, estimate=estimate, **options)
    keys = ("level", "mae_u", "mae_v", "gauge_free_u", "gauge_free_v")
    return {
        "iterations": [{key: getattr(step, key) for key in keys} for step in result.history],
        "seconds": time.perf_counter() - started,
        **errors(result.motion, scan.truth, scan.geometry),
        "rest": rest(result.motion, scan.truth, scan.geometry),
    }


def main() -> None:
    """Run what is missing, print tables and check the paper's claims, draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--schedules", default=",".join(SCHEDULES))
    parser.add_argument("--estimator", choices=("ours", "paper", "both"), default="both")
    parser.add_argument("--seed", type=int, default=1, help="of the motions")
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

    def scan_of(trajectory: str, motion: str, magnification: float) -> clra.Scan:
        which = trajectory, motion, options.scale, magnification
        return moved_scan(*which, options.output, options.seed)

    size = f"{options.scale}" + f" seed {options.seed}" * (options.seed != 1)
    print(HEAD)
    for trajectory, motion in SETS:
        name = f"{size} {trajectory} {motion}"
        if options.ablation:
            scan = scan_of(trajectory, motion, 0.002)
            for part, switched in ABLATION.items():
                ensure(f"{name} {part}", scan, "auto", "shift+scale", switched)
            continue
        scan = scan_of(trajectory, motion, 0.0)
        for schedule in options.schedules.split(","):
            if options.estimator != "ours" and schedule != "auto":
                paper = {"solver": Solver.paper(), "gauge": "free"}
                ensure(f"{name} paper {schedule}", scan, schedule, "shift", paper)
            if options.estimator != "paper":
                ensure(f"{name} ours {schedule}", scan, schedule, "shift", {})
        if options.estimator != "paper" and "auto" in options.schedules:
            scan = scan_of(trajectory, motion, 0.002)
            ensure(f"{name} ours with magnification auto", scan, "auto", "shift+scale", {})
    if not options.ablation:
        print("", *claims(runs, size), "", *left(runs, f"{size} "), sep="\n")
        scans = {which: scan_of(*which, 0.0) for which in SETS}
        draw(runs, size, scans, options.output / f"figure3-{size.replace(' ', '-')}.png")


def row(key: str, found: dict[str, Any]) -> str:
    """Return a line of the table."""
    shifts = ("mae_u", "mae_v", "gauge_free_u", "gauge_free_v")
    numbers = " | ".join(f"{found[name]:.3f}" for name in shifts)
    return f"| {key} | {numbers} | {found['mae_m']:.1e} | {found['seconds']:.0f} s |"


def left(runs: dict[str, Any], start: str) -> list[str]:
    """Return a table of what our default leaves: of the sample's movements, and slow and fast."""
    head = "| what is left | largest modes | u, slow, fast, faster | v | magnification |"
    lines = [head, "|---|---|---|---|---|"]
    for key, found in runs.items():
        if key.startswith(start) and key.endswith("ours with magnification auto"):
            modes = sorted(found["rest"]["modes"].items(), key=lambda mode: -mode[1])[:2]
            told = ", ".join(f"{name} {rms:.3f}" for name, rms in modes)
            u, v, m = found["rest"]["bands"]
            shifts = " | ".join(", ".join(f"{part:.3f}" for part in band) for band in (u, v))
            grown = ", ".join(f"{part:.1e}" for part in m)
            lines.append(f"| {key} | {told} | {shifts} | {grown} |")
    return lines


def claims(runs: dict[str, Any], size: str) -> list[str]:
    """Say which of the paper's claims hold with its own estimator, as far as it was run.

    By the raw errors and by those without the gauge: where a motion is smooth, the estimator
    moves the sample as a whole, which no later iteration takes back.
    """

    def means(measure: str, schedule: str, after: int | None = None) -> list[float]:
        """Mean of u and v for each set, at the end or after some iterations."""
        found = [runs[f"{size} {t} {m} paper {schedule}"] for t, m in SETS]
        last = [one if after is None else one["iterations"][after - 1] for one in found]
        return [float(one[f"{measure}_u"] + one[f"{measure}_v"]) / 2 for one in last]

    def alike(measure: str) -> tuple[str, bool]:
        random, smooth = means(measure, "1QR-1HR")[2:]
        return f"{random:.3f}, {smooth:.3f}", max(random, smooth) < 1.5 * min(random, smooth)

    def slower(measure: str) -> tuple[str, bool]:
        random, smooth = means(measure, "2QR-2HR")[:2]
        return f"{random:.3f}, {smooth:.3f}", smooth > random

    def cheaper(measure: str) -> tuple[str, bool]:
        pairs = list(zip(means(measure, "1QR-1HR"), means(measure, "4FR", 2), strict=True))
        told = "; ".join(f"{cheap:.2f}, {dear:.2f}" for cheap, dear in pairs)
        return told, all(cheap < dear for cheap, dear in pairs)

    said = []
    for text, claim in (
        ("space-filling, 1QR-1HR: random and smooth end alike", alike),
        ("helix, 2QR-2HR: smooth ends above random", slower),
        ("1QR-1HR ends below two FR iterations on each set", cheaper),
    ):
        try:
            judged = {
                name: claim(key) for name, key in (("raw", "mae"), ("gauge-free", "gauge_free"))
            }
        except KeyError as missing:
            said.append(f"{text}: not known without {missing}")
            continue
        parts = [
            f"{name} {'yes' if holds else 'no'} ({told})" for name, (told, holds) in judged.items()
        ]
        said.append(f"{text}: {', '.join(parts)}")
    return said


if __name__ == "__main__":
    main()
