"""What a fresh process pays before it works: import and builds of kernels, for ``bench.py``."""

import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from bench_cases import Bench, Value

_FIRST_USE = """
import dataclasses, math, time
import numpy as np
import clra
geometry = clra.circular(16, source_to_axis=100.0, source_to_detector=150.0, pixel_size=0.6,
                         shape=(64, 64))
scan = clra.Scan(np.random.default_rng(0).random((16, 64, 64), np.float32), geometry)
grid = clra.VolumeGrid(shape=(32, 32, 32), voxel_size=0.5)
start = time.perf_counter()
result = clra.align(scan, schedule="1HR-1FR", grid=grid)
clra.reconstruct(scan, grid=grid, motion=result.motion)
clra.correct(scan, result.motion).read(0, 4)
print(time.perf_counter() - start, time.process_time())
"""
# Every method and form of the projectors: what it builds are all kernels.
_ALL = """
import dataclasses, math, time
import numpy as np
import pyopencl as cl
import pyopencl.array
import clra
from clra.ops.runtime.devices import create_context
random = np.random.default_rng(0)
geometry = clra.circular(16, source_to_axis=100.0, source_to_detector=150.0, pixel_size=0.6,
                         shape=(64, 64))
tilted = dataclasses.replace(geometry, v=geometry.v + 0.1 * geometry.u)
scan = clra.Scan(random.random((16, 64, 64), np.float32), geometry)
grid = clra.VolumeGrid(shape=(32, 32, 32), voxel_size=0.5)
helix = clra.helix(200, angle_step=math.radians(5), z_step=0.1, source_to_axis=100.0,
                   source_to_detector=150.0, pixel_size=0.9, shape=(80, 64))
turns = clra.Scan(np.zeros((200, 80, 64), np.float32), helix)
start = time.perf_counter()
result = clra.align(scan, schedule="1HR-1FR", grid=grid)
clra.correct(scan, result.motion).read(0, 4)
for method in "fbp", "osem-tr", "imgr":
    clra.reconstruct(scan, method=method, grid=grid)
clra.reconstruct(turns, method="katsevich", grid=clra.VolumeGrid(shape=(9, 32, 32), voxel_size=0.5))
context = create_context(None)
queue = cl.CommandQueue(context)
projections = cl.array.zeros(queue, (16, 64, 64), np.float32)
volume = cl.array.zeros(queue, grid.shape, np.float32)
for views in geometry, tilted:
    clra.ForwardProjector(queue.context, views, grid)(queue, projections, volume)
    for matched in False, True:
        clra.BackProjector(queue.context, views, grid, matched=matched)(
            queue, volume, projections
        ).wait()
print(time.perf_counter() - start, time.process_time())
"""
_IMPORT = """
import time
start = time.perf_counter()
import clra
print(time.perf_counter() - start, time.process_time())
"""


_DEVICES = """
import contextlib, io, sys, time
start = time.perf_counter()
from clra.app.cli import main
sys.argv = ["clra", "devices"]
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    main()
print(time.perf_counter() - start, time.process_time())
"""
# The child's processor time is not in the second number.
_SELF_TEST = """
import time
from clra.ops.runtime.devices import usable_device
start = time.perf_counter()
usable_device()
print(time.perf_counter() - start, time.process_time())
"""


def first_use(bench: Bench) -> Iterator[Value]:
    """Time what a fresh process pays: import, and kernels' builds with caches empty and filled."""

    def fresh(
        name: str, size: str, code: str, environment: Mapping[str, str], repeats: int
    ) -> Value:
        variables = os.environ | {"CLRA_DEVICE": bench.queue.device.name.strip()} | environment
        command = [sys.executable, "-c", code]
        runs = [
            subprocess.run(command, env=variables, stdout=subprocess.PIPE, text=True, check=True)
            for _ in range(repeats)
        ]
        seconds, processor = zip(*(map(float, run.stdout.split()) for run in runs), strict=True)
        median = statistics.median(seconds)
        return Value(name, size, "s", {"clra": median}, {"clra": seconds}, {"clra": processor})

    yield fresh("import clra", "", _IMPORT, {}, 7)
    yield fresh("clra devices", "", _DEVICES, {}, 7)
    with tempfile.TemporaryDirectory() as folder:
        names = ("XDG_CACHE_HOME", "POCL_CACHE_DIR", "CUDA_CACHE_PATH")
        caches = {name: str(Path(folder) / name) for name in names}
        for path in caches.values():
            Path(path).mkdir()
        yield fresh("self-test, caches empty", "", _SELF_TEST, caches, 1)
        yield fresh("self-test, verdict kept", "", _SELF_TEST, caches, 7)
        size = "tiny scan aligned, reconstructed, corrected"
        yield fresh("first use, caches as the self-test left them", size, _FIRST_USE, caches, 1)
        yield fresh("first use, caches filled", size, _FIRST_USE, caches, 3)
    with tempfile.TemporaryDirectory() as folder:
        caches = {name: folder for name in names}
        size = "every method and form of the projectors"
        yield fresh("all kernels, caches empty", size, _ALL, caches, 1)
