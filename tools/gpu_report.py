"""What a GPU does with clra, in eight minutes: ``python tools/gpu_report.py -o FOLDER``.

Self-test, speed of the kernels (with ASTRA beside them where it is installed), one iteration of
the paper's helix at half and at full resolution, filtered back-projection of 1440 radiographs of
1024^2 to 1024^3 voxels, and as many of the operators' tests as the time allows. Each step runs in a
process of its own, which is ended where it takes longer than its share; ``report.json`` and
``report.md`` are whole after every step. ``--scale 8`` rehearses with sizes divided by 8; with
``CLRA_PROFILE=gpu`` a CPU rehearses the kernels for GPUs.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Facts = dict[str, Any]
HERE = Path(__file__).parent


class Repeated:
    """Radiographs that repeat a few: a long scan that takes no memory."""

    def __init__(self, block: Floats, views: int) -> None:
        self._block = block
        self.shape, self.dtype, self.ndim = (views, *block.shape[1:]), block.dtype, 3

    def __len__(self) -> int:
        return int(self.shape[0])

    def __getitem__(self, views: Any) -> Floats:
        index = np.arange(self.shape[0])[views] % len(self._block)
        return np.asarray(self._block[index])


class Dropped:
    """Takes planes of a volume and forgets them."""

    def write(self, start: int, part: Floats) -> None:
        """Forget planes."""


def device(scale: int) -> Facts:
    """Which device, driver and kernels, and what the self-test says."""
    from clra.ops.runtime.devices import usable_device
    from clra.ops.runtime.profile import profile_of

    chosen = usable_device()
    return {
        "device": chosen.name.strip(),
        "driver": f"{chosen.platform.version.strip()}, {chosen.driver_version}",
        "memory [GB]": round(chosen.global_mem_size / 1e9, 1),
        "compute units": chosen.max_compute_units,
        "clock [MHz]": chosen.max_clock_frequency,
        "form of the kernels": profile_of(chosen).form,
        "self-test": "passed",
    }


def iteration(scale: int, level: int) -> Facts:
    """Time of one iteration of the paper's helix: filter, back-project, project, register."""
    from paper_sets import SAMPLE, VOXEL, geometry_of

    import clra
    from clra.methods.alignment.reprojection import registration_for, reproject_and_register
    from clra.methods.reconstruction.fbp import ramp_fbp
    from clra.model.phantoms.ellipsoids import porous
    from clra.ops.streaming.radiographs import Radiographs
    from clra.ops.streaming.stream import Stream

    geometry = geometry_of("helix", scale)
    if level > 1:
        geometry = geometry.binned(level)
    planes, across = (size // scale // level for size in SAMPLE)
    grid = clra.VolumeGrid(shape=(planes, across, across), voxel_size=VOXEL * scale * level)
    radius = 0.4 * across * grid.voxel_size
    sample = porous(radius, 2 * radius, seed=1, count=40)
    block = sample.line_integrals(geometry.subset(slice(0, 32)))
    scan = clra.Scan(Repeated(block, geometry.views), geometry)
    stream = Stream()
    radiographs = Radiographs(stream, scan, 1)
    registration = registration_for(stream, scan, radiographs, first=False, magnification=True)
    parts: dict[str, float] = {}
    for _ in range(2):  # the first one compiles
        start = time.perf_counter()
        volume = ramp_fbp(stream, radiographs, geometry, grid)
        stream.queue.finish()
        middle = time.perf_counter()
        reproject_and_register(
            stream, radiographs, volume, geometry, registration,
            magnification=np.ones(geometry.views), detector=geometry.shape,
        )  # fmt: skip
        end = time.perf_counter()
        parts = {"reconstruct [s]": middle - start, "project and register [s]": end - middle}
        del volume
    size = "x".join(map(str, grid.shape[::-1]))
    views, (rows, columns) = geometry.views, geometry.shape
    return {
        "size": f"{size}, {views} views of {rows}x{columns}",
        "iteration [s]": round(sum(parts.values()), 3),
        **{name: round(seconds, 3) for name, seconds in parts.items()},
    }


def fdk(scale: int) -> Facts:
    """Time filtered back-projection of a full circle."""
    import clra
    from clra.methods.reconstruction.fbp import ramp_fbp
    from clra.ops.streaming.radiographs import Radiographs
    from clra.ops.streaming.stream import Stream

    size, views = 1024 // scale, 1440 // scale
    geometry = clra.circular(
        views, source_to_axis=100.0, source_to_detector=150.0, pixel_size=0.15, shape=(size, size)
    )
    grid = clra.VolumeGrid(shape=(size, size, size), voxel_size=0.1 * math.sqrt(0.5))
    block = np.random.default_rng(0).random((16, size, size), np.float32)
    scan = clra.Scan(Repeated(block, views), geometry)
    stream = Stream()
    seconds = 0.0
    for _ in range(2):
        start = time.perf_counter()
        radiographs = Radiographs(stream, scan, 1)
        ramp_fbp(stream, radiographs, geometry, grid, target=Dropped())
        stream.queue.finish()
        seconds = time.perf_counter() - start
    return {
        "size": f"{size}^3, {views} views of {size}^2",
        "time, planes on the host [s]": round(seconds, 2),
        "voxel-views [G/s]": round(size**3 * views / seconds / 1e9, 1),
    }


def speed(scale: int) -> Facts:
    """Rates of ``bench.py``, with those of ASTRA where it is installed."""
    file = Path("bench.json")
    only = ("projectors", "filter", "registration")
    options = [part for name in only for part in ("--only", name)]
    command = [sys.executable, str(HERE / "bench.py"), *options, "--peer", "astra"]
    done = subprocess.run(
        [*command, "--repeats", "3", "--json", str(file)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(done.stderr.strip().splitlines()[-1])
    found: Facts = {}
    for one in json.loads(file.read_text())["results"]:
        rates = ", ".join(f"{name} {rate:.3g}" for name, rate in one["values"].items())
        found[f"{one['name']}, {one['size']} [{one['unit']}]"] = rates
    return found


def tests(scale: int) -> Facts:
    """How many of the operators' tests pass."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "tests/ops"],
        cwd=HERE.parent, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return {"pytest tests/ops": done.stdout.strip().splitlines()[-1]}


# What is done, and its share of the time [s] at full size.
STEPS: dict[str, tuple[Callable[[int], Facts], float]] = {
    "device": (device, 40),
    "kernels": (speed, 100),
    "iteration at half resolution": (lambda scale: iteration(scale, 2), 60),
    "iteration at full resolution": (lambda scale: iteration(scale, 1), 120),
    "filtered back-projection": (fdk, 80),
    "tests": (tests, 600),
}


def attempt(name: str, scale: int, seconds: float, folder: Path) -> Facts:
    """Run a step in a process of its own."""
    command = [sys.executable, str(Path(__file__).resolve()), "--step", name, "--scale", str(scale)]
    paths = [str(HERE.parent), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, timeout=seconds,
            capture_output=True, text=True, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return {"failed": f"not done within {seconds:.0f} s"}
    if done.returncode:
        return {"failed": (done.stderr.strip().splitlines() or ["no message"])[-1]}
    facts: Facts = json.loads(done.stdout.strip().splitlines()[-1])
    return facts


def markdown(results: dict[str, Facts]) -> str:
    """Return the report as tables."""
    lines = ["# clra on a GPU", ""]
    for name, facts in results.items():
        lines += [f"## {name.capitalize()}", "", "| what | value |", "|---|---|"]
        lines += [f"| {what} | {value} |" for what, value in facts.items()]
        lines.append("")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("gpu_report"), metavar="FOLDER")
    parser.add_argument("--minutes", type=float, default=8.0, help="for all steps")
    parser.add_argument("--scale", type=int, default=1, help="divides sizes and views")
    parser.add_argument("--skip", action="append", default=[], choices=STEPS, metavar="STEP")
    parser.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.step:
        print(json.dumps(STEPS[given.step][0](given.scale)))
        return 0
    given.output.mkdir(parents=True, exist_ok=True)
    end = time.monotonic() + 60 * given.minutes
    results: dict[str, Facts] = {}
    for name, (_, share) in STEPS.items():
        if name in given.skip:
            continue
        left = end - time.monotonic()
        begun = time.monotonic()
        if left < 5:
            results[name] = {"failed": "no time left"}
        else:
            results[name] = attempt(name, given.scale, min(share, left), given.output)
            results[name]["step took [s]"] = round(time.monotonic() - begun, 1)
        (given.output / "report.json").write_text(json.dumps(results, indent=1) + "\n")
        (given.output / "report.md").write_text(markdown(results))
        print(f"{name}: {results[name]}", flush=True)
    return int(any("failed" in facts for facts in results.values()))


if __name__ == "__main__":
    sys.exit(main())
