"""The work that ``bench.py`` times: projectors, filter, registration, a whole iteration.

A case is made on demand, with arrays that live until it is done. Every run ends when its result is
there.
"""

import math
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
from bench_peers import Peer
from numpy.typing import NDArray
from paper_sets import SAMPLE, VOXEL, geometry_of, moved_scan, project

import clra
from clra.model.phantoms.ellipsoids import Ellipsoids, porous
from clra.model.phantoms.perturbation import random_motion
from clra.ops.filtering.ramp import RampFilter
from clra.ops.registration.gauss_newton import ESTIMATE_FIELDS, Registration

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Case:
    """Work to be timed.

    Attributes
    ----------
    name, size, unit : str
        For the table; the unit is of `work` a second.
    work : float
        Of one run.
    runs : mapping of str to callable
        Software and what does the work once.
    """

    name: str
    size: str
    unit: str
    work: float
    runs: Mapping[str, Callable[[], Any]]


@dataclass(frozen=True)
class Value:
    """A result.

    Attributes
    ----------
    name, size, unit : str
        For the table.
    values : mapping of str to float
        Software and its number.
    seconds, processor_seconds : mapping of str to sequence of float
        Time of each run on the clock and, summed over threads, on the processors.
    """

    name: str
    size: str
    unit: str
    values: Mapping[str, float]
    seconds: Mapping[str, Sequence[float]] = field(default_factory=dict)
    processor_seconds: Mapping[str, Sequence[float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Bench:
    """Where and beside whom to run."""

    queue: cl.CommandQueue
    peers: Sequence[Peer]

    def device(self, values: NDArray[Any]) -> cl.array.Array:
        """Copy on the device."""
        return cl.array.to_device(self.queue, np.ascontiguousarray(values, np.float32))

    def empty(self, *shape: int) -> cl.array.Array:
        """Zeros on the device: memory that was never touched would be slower the first time."""
        return cl.array.zeros(self.queue, shape, np.float32)


Maker = Callable[[Bench], Iterator[Case | Value]]


def circle(size: int = 256, views: int = 60, detector: int = 384) -> tuple[Any, Any]:
    """Geometry and grid of `size` cubed voxels, all of which every view sees."""
    voxel = 0.1 * 256 / size
    geometry = clra.circular(
        views,
        source_to_axis=100.0,
        source_to_detector=150.0,
        pixel_size=0.15 * 384 / detector,
        shape=(detector, detector),
    )
    return geometry, clra.VolumeGrid(shape=(size, size, size), voxel_size=voxel)


def paper_helix() -> tuple[Any, Any]:
    """Geometry of all views and grid of the paper's helix at a quarter of the resolution."""
    planes, columns = (size // 4 for size in SAMPLE)
    grid = clra.VolumeGrid(shape=(planes, columns, columns), voxel_size=4 * VOXEL)
    return geometry_of("helix", 1).binned(4), grid


def tilted(geometry: Any) -> Any:
    """Geometry whose detectors are rolled by a degree, so that v is not parallel to the axis."""
    cos, sin = math.cos(math.radians(1)), math.sin(math.radians(1))
    return clra.ConeBeamGeometry(
        source=geometry.source,
        detector=geometry.detector,
        u=cos * geometry.u + sin * geometry.v,
        v=cos * geometry.v - sin * geometry.u,
        shape=geometry.shape,
    )


def _projecting(bench: Bench, geometry: Any, grid: Any, size: str) -> Iterator[Case]:
    """Both directions and the adjoint, ideal and tilted."""
    context, queue = bench.queue.context, bench.queue
    random = np.random.default_rng(0)
    projections = random.random((geometry.views, *geometry.shape), np.float32)
    volume = random.random(grid.shape, np.float32)
    work = math.prod(grid.shape) * geometry.views / 1e9
    there, here = bench.device(projections), bench.device(volume)
    out_there, out_here = bench.empty(*projections.shape), bench.empty(*volume.shape)

    def back(of: Any, matched: bool) -> Callable[[], Any]:
        operator = clra.BackProjector(context, of, grid, matched=matched)
        return lambda: operator(queue, out_here, there).wait()

    def forward(of: Any) -> Callable[[], Any]:
        operator = clra.ForwardProjector(context, of, grid)
        return lambda: operator(queue, out_there, here).wait()

    ours, rolled = {"clra": back(geometry, False)}, tilted(geometry)
    peers = {peer.name: peer.back(geometry, grid, projections) for peer in bench.peers}
    yield Case("back-projection", size, "G/s", work, ours | peers)
    peers = {peer.name: peer.forward(geometry, grid, volume) for peer in bench.peers}
    yield Case("forward projection", size, "G/s", work, {"clra": forward(geometry)} | peers)
    del peers
    for name, run in (
        ("matched adjoint", back(geometry, True)),
        ("back-projection, tilted", back(rolled, False)),
        ("forward projection, tilted", forward(rolled)),
        ("matched adjoint, tilted", back(rolled, True)),
    ):
        yield Case(name, size, "G/s", work, {"clra": run})


def projectors(bench: Bench) -> Iterator[Case]:
    yield from _projecting(bench, *circle(), "256^3, 60 views of 384^2")


def helix(bench: Bench) -> Iterator[Case]:
    size = "paper's helix at QR: 120x120x312, 216 views of 128^2"
    geometry, grid = paper_helix()
    # The square in the middle of every 16th detector.
    part = replace(geometry.subset(slice(None, None, 16)), shape=(128, 128))
    yield from _projecting(bench, part, grid, size)


def _fdk(bench: Bench, geometry: Any, grid: Any, projections: Floats) -> Callable[[], Any]:
    """FDK by clra's operators."""
    queue = bench.queue
    measured = bench.device(projections)
    filtered, volume = bench.empty(*projections.shape), bench.empty(*grid.shape)
    ramp = RampFilter(queue.context, geometry)
    back = clra.BackProjector(queue.context, geometry, grid)

    def run() -> Callable[[], Floats]:
        event = ramp(queue, filtered, measured)
        back(queue, volume, filtered, wait_for=[event]).wait()
        return lambda: volume.get() * np.float32(math.pi / geometry.views)

    return run


def fdk(bench: Bench) -> Iterator[Case]:
    geometry, grid = circle()
    shape = (geometry.views, *geometry.shape)
    projections = np.random.default_rng(0).random(shape, np.float32)
    work = math.prod(grid.shape) * geometry.views / 1e9
    runs = {"clra": _fdk(bench, geometry, grid, projections)}
    runs |= {peer.name: peer.fdk(geometry, grid, projections) for peer in bench.peers}
    yield Case("FDK", "256^3, 60 views of 384^2", "G/s", work, runs)


def accuracy(bench: Bench) -> Iterator[Value]:
    """Projections of a sampled sphere against the sphere's, and its reconstruction."""
    geometry, grid = circle(128, 240, 192)
    sphere = Ellipsoids([[2.1, -1.3, 1.7]], [[7.0, 7.0, 7.0]], [0.1])
    volume, exact = sphere.volume(grid, oversample=4), sphere.line_integrals(geometry)
    here, there = bench.device(volume), bench.empty(*exact.shape)
    clra.ForwardProjector(bench.queue.context, geometry, grid)(bench.queue, there, here).wait()
    forward = {"clra": there.get()}
    back = {"clra": _fdk(bench, geometry, grid, exact)()()}
    for peer in bench.peers:
        for found, result in (
            (forward, peer.forward(geometry, grid, volume)()),
            (back, peer.fdk(geometry, grid, exact)()),
        ):
            if callable(result):
                found[peer.name] = result()
    size, unit = "128^3, 240 views of 192^2", "rms error, % of the peak"
    for name, found, truth in (
        ("forward projection of a sphere", forward, exact),
        ("FDK of a sphere", back, volume),
    ):
        errors = {
            software: 100 * float(np.sqrt(np.mean((image - truth) ** 2)) / truth.max())
            for software, image in found.items()
        }
        yield Value(name, size, unit, errors)


def ramp_filter(bench: Bench) -> Iterator[Case]:
    geometry, _ = circle()
    shape = (geometry.views, *geometry.shape)
    measured = bench.device(np.random.default_rng(0).random(shape, np.float32))
    filtered = bench.empty(*shape)
    ramp = RampFilter(bench.queue.context, geometry)
    runs = {"clra": lambda: ramp(bench.queue, filtered, measured).wait()}
    yield Case("ramp filter", "60 views of 384^2", "Mpixel/s", math.prod(shape) / 1e6, runs)


def registration(bench: Bench) -> Iterator[Case]:
    """Shift, magnification, gain and offset of radiographs that moved by a few pixels."""
    views = 64
    geometry = clra.circular(
        views,
        source_to_axis=100.0,
        source_to_detector=150.0,
        pixel_size=0.15,
        shape=(256, 256),
    )
    sample = porous(9.0, 18.0, seed=1, count=200)
    motion = random_motion(views, seed=2, shift=(-5.0, 5.0), magnification=0.002)
    simulated = bench.device(sample.line_integrals(geometry))
    measured = bench.device(1.1 * sample.line_integrals(geometry.with_motion(motion)) + 0.05)
    estimates = bench.empty(views, len(ESTIMATE_FIELDS))
    register = Registration(bench.queue.context, (256, 256), views=views)

    def run() -> None:
        register(bench.queue, estimates, measured, simulated).wait()

    yield Case("registration", "64 pairs of 256^2", "pairs/s", views, {"clra": run})


def iteration(bench: Bench) -> Iterator[Value]:
    """Filter, back-project, forward-project, register: one iteration of an alignment."""
    geometry, grid = paper_helix()
    motion = random_motion(geometry.views, seed=1, shift=(-2.0, 2.0))
    projections = np.empty((geometry.views, *geometry.shape), np.float32)
    project(projections, geometry.with_motion(motion))
    scan = clra.Scan(projections, geometry)
    # align() adds 15 per cent of margin at each end of the grid: 240 planes become 312.
    grid = clra.VolumeGrid(shape=(240, 120, 120), voxel_size=grid.voxel_size)
    history = clra.align(scan, schedule="3FR", grid=grid, device=bench.queue.device).history
    size = "paper's helix at QR: 120x120x312, 3456 views of 232x128"
    times = [step.seconds for step in history]
    yield Value("RA iteration", size, "s", {"clra": statistics.median(times)}, {"clra": times})


def alignment(bench: Bench) -> Iterator[Value]:
    """Align at the paper's full size; the radiographs, 6.6 GB, are read from a file."""
    grid = clra.VolumeGrid(shape=(960, 480, 480), voxel_size=VOXEL)  # 1248 with align()'s margin
    with tempfile.TemporaryDirectory() as folder:
        scan = moved_scan("helix", "random", 1, 0.0, Path(folder))
        begin, begin_processor = time.perf_counter(), time.process_time()
        clra.align(scan, schedule="1QR-1HR", grid=grid, device=bench.queue.device)
        seconds = time.perf_counter() - begin
        processor = time.process_time() - begin_processor
        del scan
    size = "paper's helix: 480x480x1248, 3456 views of 928x512"
    times = {"clra": [seconds]}, {"clra": [processor]}
    yield Value("1QR-1HR", size, "s", {"clra": seconds}, *times)


def scaling(bench: Bench) -> Iterator[Case]:
    """Whether the time of a voxel-view stays the same as volumes and scans grow."""
    for size, views in ((128, 60), (256, 60), (512, 60), (128, 100), (128, 1000), (128, 4000)):
        geometry, grid = circle(size, views, 3 * size // 2)
        label = f"{size}^3, {views} views of {3 * size // 2}^2"
        cases = _projecting(bench, geometry, grid, label)
        yield next(cases)
        yield next(cases)


CASES: dict[str, Maker] = {
    "projectors": projectors,
    "helix": helix,
    "fdk": fdk,
    "accuracy": accuracy,
    "filter": ramp_filter,
    "registration": registration,
}
LONG: dict[str, Maker] = {"iteration": iteration, "scaling": scaling, "alignment": alignment}
