"""Time clra, and peers beside it: ``python tools/bench.py --peer rtk --json bench.json``.

Software takes turns run by run, in one process with as many threads, so that what else the machine
does meets all alike: compare the ratios. Each is run once to warm up; medians are given. G/s are
1e9 voxels times views a second, whatever share of them a detector sees. The JSON file has the time
of every run, and the processors' time, which a busy machine disturbs less.
"""

import argparse
import json
import platform
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyopencl as cl
from bench_cases import CASES, LONG, Bench, Case, Value
from bench_first_use import first_use
from bench_host import host
from bench_peers import PEERS, Peer, threads

from clra.ops.runtime.devices import create_context


def measured(case: Case, repeats: int) -> Value:
    """Run each software in turns; rates from the medians of the times."""
    seconds: dict[str, list[float]] = {name: [] for name in case.runs}
    processor: dict[str, list[float]] = {name: [] for name in case.runs}
    for run in case.runs.values():
        run()
    for _ in range(repeats):
        for name, run in case.runs.items():
            start, start_processor = time.perf_counter(), time.process_time()
            run()
            seconds[name].append(time.perf_counter() - start)
            processor[name].append(time.process_time() - start_processor)
    rates = {name: case.work / statistics.median(times) for name, times in seconds.items()}
    return Value(case.name, case.size, case.unit, rates, seconds, processor)


def row(value: Value, peers: Sequence[str]) -> str:
    """Line of the table; where rates are compared, with the ratio."""
    cells = [value.name, value.size, value.unit, number(value.values["clra"])]
    for peer in peers:
        if peer not in value.values:
            cells += ["", "", ""]
            continue
        ratio = value.values["clra"] / value.values[peer]
        cells += [number(value.values[peer]), f"{ratio:.2f}", ""]
        if value.processor_seconds:
            clra, other = (
                statistics.median(value.processor_seconds[name]) for name in ("clra", peer)
            )
            cells[-1] = f"{other / clra:.2f}"
    return f"| {' | '.join(cells)} |"


def number(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def head(peers: Sequence[str]) -> str:
    cells = ["case", "size", "unit", "clra"]
    for peer in peers:
        cells += [peer, f"clra / {peer}", "by processor time"]
    return f"| {' | '.join(cells)} |\n|{'---|' * len(cells)}"


def machine(device: cl.Device) -> dict[str, Any]:
    return {
        "device": device.name.strip(),
        "driver": f"{device.platform.version.strip()}, {device.driver_version}",
        "threads": threads(),
        "python": platform.python_version(),
        "system": platform.platform(),
    }


def found(names: Sequence[str]) -> list[Peer]:
    """Peers that are installed; a line for each that is not."""
    peers = []
    for name in names:
        try:
            peers.append(PEERS[name]())
        except RuntimeError as error:
            print(f"{name}: skipped, {error}", file=sys.stderr)
    return peers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    short = CASES | {"first-use": first_use, "host": host}
    everything = short | LONG
    parser.add_argument("--only", action="append", choices=everything, metavar="NAME", default=[])
    parser.add_argument("--long", action="store_true", help=f"also {', '.join(LONG)}")
    parser.add_argument("--peer", action="append", choices=PEERS, default=[])
    parser.add_argument("--device", help="as clra's commands take it")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path, metavar="FILE", help="where to write all times")
    given = parser.parse_args()
    names = given.only or [*short, *(LONG if given.long else ())]
    peers = found(given.peer)
    columns = [peer.name for peer in peers]
    context = create_context(given.device)  # kept: not every driver's queues keep theirs
    queue = cl.CommandQueue(context)
    about = machine(queue.device)
    print(f"{about['device']}, {about['driver']}, {about['threads']} threads\n")
    print(head(columns), flush=True)
    results = []
    for name in names:
        for case in everything[name](Bench(queue, peers)):
            value = measured(case, given.repeats) if isinstance(case, Case) else case
            print(row(value, columns), flush=True)
            results.append(vars(value))
            if given.json:  # whole after each case: long runs get interrupted
                text = json.dumps({"machine": about, "results": results}, indent=1)
                given.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
