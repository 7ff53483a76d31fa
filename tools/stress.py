"""Stress benchmark: alignment of scans with anything wrong in them, against closed-form truths.

``python tools/stress.py run -o FOLDER`` aligns every kind of scan with the default options, writes
FOLDER/stress.json, one entry a scan as soon as it is there, and FOLDER/stress.md, a line a scan,
and prints a line a kind and what becomes of the verdicts; started again it goes on where it was
stopped. ``--kinds 'circle*' tilt-3 --seeds 1 2 3 --size 128`` chooses. ``list`` tells the kinds.

``export KIND SEED FOLDER`` writes the same scan as files for other programs: scan.nx (NXtomo),
radiographs.npy (line integrals), geometry.csv (source, detector centre, column step and row step of
each view [mm]). ``score KIND SEED RESULT.csv`` measures what a program found, with the columns
``view, u, v`` and, where it has it, ``m``: the shift of the image toward higher columns and rows
[pixel of the full detector] and its magnification.

Errors are means of absolute values over the views, raw and gauge-free (without what a movement of
the sample as a whole explains); "beyond" is the part of the true motion that shifts and
magnifications cannot express. A geometry that is so wrong that no motion mends it has no error: any
alignment of it is wrong.
"""

import argparse
import csv
import fnmatch
import json
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stress_kinds import KINDS
from stress_scans import Case
from stress_table import by_kind, conclusions, table

import clra
from clra.model.gauge.gauge import Gauge

Floats = NDArray[np.float64]

# Displacement that no motion explains, and magnification, beyond which the reported geometry is
# another scan's [pixel, factor].
_BEYOND, _SCALED = 3.0, 1.2
# Views below which nothing is said of how their errors differ.
_ENOUGH = 60
# Variance of the logarithm of a length whose two components are normal and alike in all views.
_OF_EQUAL = np.pi**2 / 24


def hopeless(case: Case) -> bool:
    """Whether the reported geometry is so wrong that no motion mends it."""
    scale = float(np.median(case.truth.values[:, 2]))
    return case.truth.beyond > _BEYOND or not 1 / _SCALED < scale < _SCALED


def differences(case: Case, found: clra.Motion) -> tuple[Floats, Floats]:
    """Estimate minus truth in u, v and m, (views, 3) each: as it is, and gauge-free."""
    raw = np.stack([found.shift_u, found.shift_v, found.magnification], axis=1) - case.truth.values
    wrong = clra.Motion(shift_u=raw[:, 0], shift_v=raw[:, 1], magnification=1 + raw[:, 2])
    gauge = Gauge(case.scan.geometry, case.points, magnification=True)
    return raw, gauge.fit(wrong).remainder


def errors_of(case: Case, found: clra.Motion) -> dict[str, Any]:
    """Compare a motion with the truth."""
    measured: dict[str, Any] = {"beyond": case.truth.beyond}
    if hopeless(case):
        return measured
    raw, free = (np.abs(table).mean(axis=0) for table in differences(case, found))
    for axis, name in enumerate("uvm"):
        measured[f"raw_{name}"] = float(raw[axis])
        measured[f"free_{name}"] = float(free[axis])
    measured["error"] = max(measured["free_u"], measured["free_v"])
    return measured


def run(name: str, seed: int, size: int, options: dict[str, Any]) -> dict[str, Any]:
    """Align one scan and measure all there is."""
    entry: dict[str, Any] = {"kind": name, "seed": seed, "size": size}
    started = time.process_time()
    try:
        case = KINDS[name].case(seed, size)
    except clra.errors.InputError as refused:
        return {**entry, "refused": str(refused), "causes": KINDS[name].causes}
    entry |= {"causes": case.causes, "views": case.scan.views}
    entry |= {f"still_{k}": v for k, v in errors_of(case, _nothing(case)).items()}
    entry["making"] = round(time.process_time() - started, 2)
    started = time.process_time()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            result = clra.align(case.scan, **{**case.options, **options})
        except clra.errors.InputError as refused:
            return {**entry, "refused": str(refused)}
    entry["seconds"] = round(time.process_time() - started, 2)
    entry["said"] = sorted({str(w.message) for w in told if issubclass(w.category, UserWarning)})
    entry |= errors_of(case, result.motion)
    entry["confidence"] = float(np.median(result.confidence))
    entry["rejected"] = len(result.flagged)
    entry |= _uncertainty(case, result)
    quality = getattr(result, "quality", None)
    if quality is not None:
        entry["verdict"] = quality.verdict
        entry["quality"] = quality.as_dict()
    entry["codes"] = [finding.code for finding in getattr(result, "warnings", ())]
    return entry


def _nothing(case: Case) -> clra.Motion:
    return clra.Motion.identity(case.scan.views)


def _uncertainty(case: Case, result: Any) -> dict[str, float]:
    """RMS error over RMS sigma in u, v and m; how errors differ between views, and sigma with them.

    Lengths of (u, v), each relative to its RMS. "differs" is the standard deviation of the
    logarithm of what normal errors have beyond that of equal ones; it counts where some views'
    errors are twice those of others. "rank" is the rank correlation of error and sigma.
    """
    if hopeless(case):
        return {}
    free = differences(case, result.motion)[1]
    used = np.ones(case.scan.views, np.bool_)
    used[list(result.flagged)] = False
    wrong, sigma = np.abs(free[used]), result.sigma[used, :3]
    measured = {}
    known = np.isfinite(sigma).all(axis=0) & (sigma > 0).any(axis=0) & (wrong > 0).any(axis=0)
    sizes = [np.sqrt(np.mean(table**2, axis=0)) for table in (wrong, sigma)]
    for axis, name in enumerate("uvm"):
        if known[axis]:
            measured[f"ratio_{name}"] = float(sizes[0][axis] / sizes[1][axis])
    if known[:2].all() and len(wrong) >= _ENOUGH:
        lengths = [
            np.hypot(*(table[:, :2] / size[:2]).T)
            for table, size in zip((wrong, sigma), sizes, strict=True)
        ]
        beyond = np.var(np.log(np.maximum(lengths[0], 1e-9))) - _OF_EQUAL
        measured["differs"] = float(np.sqrt(max(beyond, 0.0)))
        measured["rank"] = _rank_correlation(*lengths)
    return measured


def _rank_correlation(a: Floats, b: Floats) -> float:
    ranks = [np.argsort(np.argsort(values)) for values in (a, b)]
    return float(np.corrcoef(*ranks)[0, 1]) if np.ptp(a) > 0 and np.ptp(b) > 0 else 0.0


def _write(path: Path, text: str) -> None:
    """Replace a file in one step."""
    fresh = path.with_name(path.name + ".new")
    fresh.write_text(text)
    fresh.replace(path)


def run_all(arguments: argparse.Namespace) -> int:
    """Run what is chosen and is not there yet."""
    store = Path(arguments.output) / "stress.json"
    store.parent.mkdir(parents=True, exist_ok=True)
    entries = json.loads(store.read_text()) if store.exists() else []
    done = {(entry["kind"], entry["seed"], entry["size"]) for entry in entries}
    options = json.loads(arguments.options)
    for name in chosen(arguments.kinds):
        for seed in arguments.seeds:
            if (name, seed, arguments.size) in done:
                continue
            entries.append(run(name, seed, arguments.size, options))
            _write(store, json.dumps(entries, indent=1))
            print(table(entries[-1:]).splitlines()[-1], file=sys.stderr, flush=True)
    _write(store.with_suffix(".md"), table(entries))
    print(f"{by_kind(entries)}\n{conclusions(entries)}")
    return 0


def chosen(patterns: list[str]) -> list[str]:
    """Return the names of kinds that match any of the patterns."""
    names = [name for name in KINDS if any(fnmatch.fnmatch(name, p) for p in patterns)]
    if not names:
        raise SystemExit(f"kinds: found {patterns}, expected some of {', '.join(KINDS)}")
    return names


def export(arguments: argparse.Namespace) -> int:
    """Write a scan for other programs."""
    scan = KINDS[arguments.kind].case(arguments.seed, arguments.size).scan
    folder = Path(arguments.folder)
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "radiographs.npy", scan.read(0, scan.views))
    names = [f"{vector}_{axis}" for vector in ("source", "detector", "u", "v") for axis in "xyz"]
    np.savetxt(
        folder / "geometry.csv",
        scan.geometry.to_astra(),
        delimiter=",",
        header=",".join(names),
        comments="",
    )
    # Here, so that nothing else needs h5py.
    from clra.io import scan_files

    scan_files.write_scan(folder / "scan.nx", scan)
    return 0


def score(arguments: argparse.Namespace) -> int:
    """Measure what another program found."""
    case = KINDS[arguments.kind].case(arguments.seed, arguments.size)
    values = np.tile([0.0, 0.0, 1.0], (case.scan.views, 1))
    with open(arguments.result, newline="") as file:
        for row in csv.DictReader(file):
            values[int(row["view"])] = [float(row["u"]), float(row["v"]), float(row.get("m") or 1)]
    u, v, m = values.T
    found = clra.Motion(shift_u=u, shift_v=v, magnification=m)
    print(json.dumps(errors_of(case, found), indent=1))
    return 0


def main(given: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="names of the kinds")
    running = commands.add_parser("run", help="align and measure")
    running.add_argument("-o", "--output", default="stress", metavar="FOLDER")
    running.add_argument("--kinds", nargs="+", default=["*"], help="names, with * and ?")
    running.add_argument("--seeds", nargs="+", type=int, default=[1])
    running.add_argument("--options", default="{}", help="of clra.align, JSON")
    exporting = commands.add_parser("export", help="write a scan for other programs")
    scoring = commands.add_parser("score", help="measure another program's result")
    for command in (exporting, scoring):
        command.add_argument("kind", choices=list(KINDS))
        command.add_argument("seed", type=int)
    exporting.add_argument("folder")
    scoring.add_argument("result", help="CSV with view, u, v and m")
    for command in (running, exporting, scoring):
        command.add_argument("--size", type=int, default=128, help="columns of the detector")
    arguments = parser.parse_args(given)
    if arguments.command == "list":
        print("\n".join(KINDS))
        return 0
    calls = {"run": run_all, "export": export, "score": score}
    return calls[arguments.command](arguments)


if __name__ == "__main__":
    sys.exit(main())
