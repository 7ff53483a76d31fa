"""Measure work on 1, 2 and 4 workers pinned to a core each, beside what `clra info` plans for them.

    python tools/cluster_times.py

A helix, from a file on the local disk. Four workers on two cores take twice as long for each task:
they are tested while all of them work, and the plan counts with what each then gets of a core.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

import clra
from clra.app.planning.cluster_plan import plans
from clra.app.planning.live_workers import live_workers
from clra.app.simulation import paper_like, sample, simulated_scan
from clra.methods.execution.worker_facts import PATIENCE


@contextmanager
def workers(count: int, folder: Path) -> Iterator[str]:
    """Start a scheduler and workers, each on one core; yield the scheduler's file."""
    cores = sorted(os.sched_getaffinity(0))
    file = folder / f"scheduler-{count}.json"
    environment = {**os.environ, "POCL_MAX_PTHREAD_COUNT": "1", "POCL_CPU_MAX_CU_COUNT": "1"}
    with ExitStack() as stack:
        words = ["dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
        commands = [[*words, "--scheduler-file", str(file)]]
        words = ["dask_worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-nanny"]
        words += ["--no-dashboard", "--memory-limit", "0", "--local-directory", str(folder)]
        commands += count * [words]
        for number, (name, *rest) in enumerate(commands):
            core = str(cores[(number - 1) % len(cores)])
            pinned = ["taskset", "-c", core] if number else []
            command = [*pinned, sys.executable, "-m", f"distributed.cli.{name}", *rest]
            process = subprocess.Popen(
                command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            stack.callback(process.wait)
            stack.callback(process.terminate)
            started = time.monotonic()
            while not file.exists() and time.monotonic() - started < PATIENCE:
                time.sleep(0.1)
        yield str(file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--columns", type=int, default=256, help="of the detector")
    parser.add_argument("--views", type=int, default=960)
    options = parser.parse_args()
    size = options.columns
    geometry = paper_like("helix", options.views, (size, size))
    u, v = np.random.default_rng(1).normal(0, 1, (2, options.views))
    truth = clra.Motion(shift_u=u, shift_v=v, magnification=np.ones(options.views))
    schedule = "auto"
    print("| workers | work | planned [s] | measured [s] | planned / measured |")
    print("|---|---|---|---|---|")
    with tempfile.TemporaryDirectory(dir=".", prefix="clra-times-") as name:
        os.chdir(name)
        made = simulated_scan(geometry, sample("spheres", geometry), truth, name="helix")
        clra.write_scan("scan.nxs", made)
        del made
        scan = clra.read_scan("scan.nxs")
        for count in (1, 2, 4):
            with workers(count, Path.cwd()) as scheduler:
                _wait_for(scheduler, count)
                there = live_workers(scheduler, geometry)
                planned = {plan.work.split(",")[0]: plan for plan in plans(geometry, there)}
                for work in planned:
                    started = time.perf_counter()
                    if work == "align":
                        result = clra.align(
                            scan, schedule=schedule, quality=False, cluster=scheduler
                        )
                        levels = [entry.level for entry in result.history]
                        print(f"<!-- {' '.join(levels)} -->")
                    else:
                        clra.reconstruct(scan, work, motion=truth, cluster=scheduler)
                    took = time.perf_counter() - started
                    said = planned[work].seconds
                    row = (str(count), planned[work].work, f"{said:.1f}", f"{took:.1f}")
                    print("| " + " | ".join([*row, f"{said / took:.2f}"]) + " |", flush=True)
        os.chdir("..")


def _wait_for(scheduler: str, count: int) -> None:
    """Wait until all workers are there."""
    from distributed import Client

    with Client(scheduler_file=scheduler, set_as_default=False) as client:
        client.wait_for_workers(count, timeout=60)


if __name__ == "__main__":
    main()
