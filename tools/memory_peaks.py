"""Measure the memory that methods take, and hold it against their budgets.

``python tools/memory_peaks.py`` simulates a helical scan (closed form), then runs each method in a
process of its own, from file to file: once to import and build kernels, on a small part of the
scan, then under the budgets. What counts on the host is the largest resident size above the one
before, on the device the sum of all buffers that live at a time. Beside them stands what ``clra
info`` predicts. Volumes and motions have to agree with those made without budgets.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

METHODS = ("fbp", "katsevich", "align", "imgr")
HEAD = (
    "| method | host budget | host peak | predicted | device budget | device peak | predicted | "
    "differs by |\n|---|---|---|---|---|---|---|---|"
)


def simulate(path: Path, views: int, detector: tuple[int, int]) -> None:
    from clra.app.simulation import paper_like, sample, simulated_motion, simulated_scan
    from clra.io.scan_files import write_scan

    geometry = paper_like("helix", views, detector)
    truth = simulated_motion("both", geometry, shift=(-3, 3), magnification=0.0, seed=0)
    write_scan(path, simulated_scan(geometry, sample("spheres", geometry), truth, name="peaks"))


def child(method: str, scan_path: Path, out: Path, host: int | None, device: int | None) -> None:
    """Run one method and print its peaks."""
    import ctypes
    import gc

    from clra.app.console import Memory

    if host:
        Memory(max_host_memory=str(host)).limits()  # as the command line does
    live = _count_buffers()
    import clra
    from clra.io.volumes.volume_files import open_volume
    from clra.methods.reconstruction.reconstruct import reconstruct_into
    from clra.model.grid import default_grid

    scan = clra.read_scan(scan_path)
    limits = {"max_host_memory": host, "max_device_memory": device}

    def run(scan: clra.Scan, name: Path, **limits: int | None) -> None:
        if method == "align":
            result = clra.align(scan, schedule="2QR-1HR", estimate="shift", **limits)
            clra.write_alignment(name, result)
        else:
            grid = default_grid(scan.geometry)
            with open_volume(name, grid) as target:
                # Multigrid iteration aligns on the way.
                reconstruct_into(target, scan, method, grid, align=method == "imgr", **limits)

    small = scan.subset(slice(0, scan.views // 4))
    run(small, out.with_name(f"small-{out.name}"))
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    live[:] = [0, 0]
    Path("/proc/self/clear_refs").write_text("5")
    before = _status("VmRSS")
    run(scan, out, **limits)
    print(json.dumps({"host": _status("VmHWM") - before, "device": live[1]}))


def _count_buffers() -> list[int]:
    """Make every OpenCL buffer that is not the host's own memory count."""
    import pyopencl as cl

    live = [0, 0]

    class Counted(cl.Buffer):
        def __init__(self, context: cl.Context, flags: int, size: int = 0, hostbuf: object = None):
            super().__init__(context, flags, size, hostbuf)
            self.own = 0 if flags & cl.mem_flags.USE_HOST_PTR else self.size
            live[0] += self.own
            live[1] = max(live)

        def __del__(self) -> None:
            live[0] -= self.own

    cl.Buffer = Counted
    from clra.ops.streaming import memory

    tell = memory._Counted.__del__

    def both(buffer: Counted) -> None:
        tell(buffer)
        Counted.__del__(buffer)

    memory._Counted.__del__ = both
    return live


def _status(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return int(line.split()[1]) << 10
    raise OSError(f"no {field}")


def measured(method: str, scan: Path, folder: Path, host: int | None, device: int | None) -> dict:
    out = folder / f"{method}-{'free' if host is None else 'tight'}.h5"
    command = [sys.executable, __file__, "--child", method, "--scan", str(scan), "--out", str(out)]
    if host is not None:
        command += ["--host", str(host), "--device", str(device)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return {**json.loads(done.stdout.splitlines()[-1]), "file": out}


def predicted(method: str, path: Path, host: int, device: int) -> Any:
    """Ask what clra info would say."""
    import clra
    from clra.methods.alignment.reprojection import with_margin
    from clra.methods.memory_estimate import alignment_need, multigrid_need, reconstruction_need
    from clra.model.grid import default_grid
    from clra.ops.runtime.devices import choose_device
    from clra.ops.streaming.memory import Budgets

    geometry = clra.read_scan(path).geometry
    grid = default_grid(geometry)
    budgets = Budgets.of(choose_device(), device, host)
    if method == "align":
        wide = with_margin(grid)
        quarter, half = (alignment_need(budgets, geometry, wide, level) for level in (4, 2))
        return quarter.beside(half)
    if method == "imgr":
        return multigrid_need(budgets, geometry, grid)
    return reconstruction_need(budgets, geometry, grid, 2 if method == "katsevich" else 1)


def difference(method: str, one: Path, other: Path) -> str:
    """How far two results are apart."""
    import clra
    from clra.io.volumes.volume_files import read_volume

    if method == "align":
        first, second = (clra.read_alignment(path).motion for path in (one, other))
        return f"{np.abs(first.shift_u - second.shift_u).max():.1e} px"
    first, second = (read_volume(path)[0] for path in (one, other))
    return f"{np.linalg.norm(first - second) / np.linalg.norm(first):.1e}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=600)
    parser.add_argument(
        "--detector", type=int, nargs=2, default=(320, 256), metavar=("ROWS", "COLUMNS")
    )
    parser.add_argument("--host-mib", type=int, default=64)
    parser.add_argument("--device-mib", type=int, default=32)
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    for name in ("--child", "--scan", "--out"):
        parser.add_argument(name, help=argparse.SUPPRESS)
    for name in ("--host", "--device"):
        parser.add_argument(name, type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        child(given.child, Path(given.scan), Path(given.out), given.host, given.device)
        return
    host, device = given.host_mib << 20, given.device_mib << 20
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scan = folder / "scan.nxs"
        simulate(scan, given.views, tuple(given.detector))
        print(f"scan {scan.stat().st_size >> 20} MiB\n\n{HEAD}")
        for method in given.methods:
            free = measured(method, scan, folder, None, None)
            tight = measured(method, scan, folder, host, device)
            need = predicted(method, scan, host, device)
            values = [host, tight["host"], need.host, device, tight["device"], need.device]
            sizes = " | ".join(f"{value / 2**20:.1f}" for value in values)
            print(
                f"| {method} | {sizes} | {difference(method, free['file'], tight['file'])} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
