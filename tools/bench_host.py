"""What the host adds to the device's work, for ``bench.py``: calls of operators, gauge columns."""

import math
import time
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import numpy as np
import pyopencl as cl
from bench_cases import Bench, Case, Value

import clra
from clra.model.gauge.gauge import sample_points
from clra.model.gauge.modes import gauge_columns
from clra.model.grid import default_grid
from clra.model.trajectory import PAPER
from clra.ops.images.pyramid import Restrict2D
from clra.ops.images.warp import Warp

_CALLS = 200
_SHAPE = (48, 64)
_GRID = clra.VolumeGrid(shape=(32, 32, 32), voxel_size=0.5)


def host(bench: Bench) -> Iterator[Case | Value]:
    """Time of a call beyond its bare kernel launches, and of what is computed without a device."""
    geometry = clra.circular(
        8, source_to_axis=100.0, source_to_detector=150.0, pixel_size=0.6, shape=_SHAPE
    )
    context = bench.queue.context
    images, halved = bench.empty(8, *_SHAPE), bench.empty(8, *(n // 2 for n in _SHAPE))
    volume = bench.empty(*_GRID.shape)
    motion = bench.device(np.tile(np.array([0.5, -0.5, 1.0]), (8, 1)))
    forward = clra.ForwardProjector(context, geometry, _GRID)
    back = clra.BackProjector(context, geometry, _GRID)
    restrict, warp = Restrict2D(context), Warp(context, _SHAPE)
    warped = bench.empty(8, *_SHAPE)
    calls: dict[str, Callable[[], Any]] = {
        "forward projector": lambda: forward(bench.queue, images, volume),
        "back-projector": lambda: back(bench.queue, volume, images),
        "restriction": lambda: restrict(bench.queue, halved, images),
        "warp": lambda: warp(bench.queue, warped, images, motion),
    }
    for name, call in calls.items():
        overhead = 1e3 * _beyond_launches(bench.queue, call)
        yield Value("call beyond its launches", name, "ms", {"clra": overhead})
    paper = clra.space_filling(3456, **PAPER)
    points = sample_points(default_grid(paper))
    yield Case(
        *("gauge columns", "3456 views", "views/s", 3456),
        {"clra": lambda: gauge_columns(paper, points)},
    )


def _beyond_launches(queue: cl.CommandQueue, call: Callable[[], Any]) -> float:
    """Least processor time of a call, without what its bare kernel launches take."""
    launches: list[tuple[cl.Kernel, tuple[Any, ...]]] = []
    launch = cl.Kernel.__call__

    def noted(kernel: Any, *arguments: Any, **named: Any) -> Any:
        launches.append((kernel, arguments))
        return launch(kernel, *arguments, **named)

    with mock.patch.object(cl.Kernel, "__call__", noted):
        call().wait()

    def bare() -> None:
        for kernel, arguments in launches:
            kernel(*arguments)

    least = [math.inf, math.inf]
    for _ in range(_CALLS):
        for k, run in enumerate((bare, call)):
            queue.finish()
            start = time.thread_time()
            run()
            least[k] = min(least[k], time.thread_time() - start)
    return least[1] - least[0]
