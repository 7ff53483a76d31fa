"""The steps of work on a cluster: tasks that are done before the next step begins."""

import math
import re
from dataclasses import dataclass

from clra.app.speed import Speed, exact_updates, views_a_voxel
from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid, default_grid
from clra.model.schedule import level_name, parse_schedule

_WORKERS = re.compile(r"([1-9]\d{0,4})(?:x(.+))?")
# A GPU that nobody has measured: half of the bound that tools/gpu_limits.py derives for an A100,
# with 40 GiB.
_GPU = Speed("a GPU, predicted", None, 2.9e-12, 3.2e-12, 1e-10, 5e-10, 5e-12, 2e-10)
_GPU_BYTES = 40 << 30
# Time to read and correct a pixel of a scan, on one core, beside the device's work [s].
_READ_S = 7e-9
# A view that sees two slabs is back-projected twice, which costs as much as this many voxels more
# for each column of voxels: 95 on a CPU with 160 columns, 93 with 256.
_COLUMN = 95
# To count the views that see a voxel, and divide by them, costs as much as this many voxels more
# for each voxel.
_COVERAGE = 55
# The statistics of a ray, in pixels that are registered; and the host's time for a byte of a volume
# between file and device, beside the file system's [s]: of OSEM-TR, which reads and writes volumes
# for few views.
_STATISTICS, _HANDLING_S = 4, 8e-10
# Iterations of a level after which "until converged" mostly ends.
_UNTIL_CONVERGED = 2
# Time of the projection's adjoint, by that of the projection: 1.10 at 128 columns, 1.12 at 192.
_ADJOINT = 1.1
# Shares of a device, as `clra.ops.streaming.memory.Budgets` has them.
_USABLE, _SLAB = 0.75, 1 / 3


@dataclass(frozen=True)
class Workers:
    """Workers of one kind.

    Parameters
    ----------
    count : int
        How many.
    speed : Speed
        Of one.
    slab_bytes : float
        Of a slab of the volume at most.
    slowdown : float
        How much longer the host's part of the work takes than on a core of its own.
    """

    count: int
    speed: Speed
    slab_bytes: float
    slowdown: float = 1.0

    @classmethod
    def parse(cls, text: str, measured: Speed) -> "Workers":
        """Read "8xGPU", "4xNAME" or "4".

        Parameters
        ----------
        text : str
            Number, and part of the name of the device here, or "GPU" for a predicted one.
        measured : Speed
            Of the device here.

        Raises
        ------
        InputError
            If it is none of these.
        """
        match = _WORKERS.fullmatch(text)
        if match is None:
            raise InputError(
                f"--cluster: found {text!r}, expected a number of workers such as 8, 8xGPU, or "
                "workers that are there: ADDRESS|FILE|local:N"
            )
        count, name = int(match[1]), (match[2] or "").strip().lower()
        if name == "gpu" and measured.device != _GPU.device:
            return cls(count, _GPU, _SLAB * _USABLE * _GPU_BYTES)
        if name not in measured.device.lower() or measured.budgets is None:
            raise InputError(
                f"--cluster: found {match[2] or 'no device'!r}, expected GPU or a part of the name "
                f"of the device here, {measured.device}"
            )
        return cls(count, measured, measured.budgets.slab)


@dataclass(frozen=True)
class PlannedStep:
    """Tasks that are done before the next step begins.

    Attributes
    ----------
    name : str
        What they do.
    tasks : int
        How many.
    seconds : float
        Of one worker's device, for all of them.
    read, written : float
        Bytes of files, of all of them.
    """

    name: str
    tasks: int
    seconds: float
    read: float
    written: float


def steps_of_work(
    geometry: ConeBeamGeometry, workers: Workers, aligned: VolumeGrid | None = None
) -> list[tuple[str, list[PlannedStep], int]]:
    """Return pieces of work: name, steps, and how many views are registered.

    Reconstructions at full resolution, and an alignment by the default schedule.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan.
    workers : Workers
        Who does it.
    aligned : VolumeGrid, optional
        Where alignment reconstructs; by default the field of view with a margin.
    """
    from clra.methods.alignment.options import Solver
    from clra.methods.alignment.reprojection import with_margin

    grid = default_grid(geometry)
    aligned = aligned or with_margin(grid)
    work = [("fbp, full resolution", [_planes(geometry, grid, workers)], 0)]
    if not math.isnan(workers.speed.exact_back) and _is_helical(geometry):
        exact = _planes(geometry, grid, workers, exact=True)
        work.append(("katsevich, full resolution", [exact], 0))
    iterative = _ordered_subsets(geometry, with_margin(grid), workers)
    work.append(("osem-tr, full resolution", [*iterative, _handed_on(grid, workers)], 0))
    steps: list[PlannedStep] = []
    names, registered = [], 0
    for stage in parse_schedule("auto", geometry.shape):
        iterations = stage.iterations or _UNTIL_CONVERGED
        if stage.level > 1:
            steps.append(_binning(geometry, stage.level, workers))
        # What displaces the re-projections of small images is found by an iteration with them.
        more = Solver().is_biased(geometry.binned(stage.level) if stage.level > 1 else geometry)
        steps += (iterations + more) * _iteration(geometry, aligned, stage.level, workers)
        registered += iterations * geometry.views
        names.append(f"{iterations}{level_name(stage.level)}")
    work.append((f"align, {'-'.join(names)}", steps, registered))
    return work


def _planes(
    geometry: ConeBeamGeometry, grid: VolumeGrid, workers: Workers, *, exact: bool = False
) -> PlannedStep:
    """Planes of a volume, as `clra.methods.execution.executor.reconstruct_planes` cuts them."""
    from clra.methods.execution.executor import slabs_of

    tasks = len(slabs_of(workers.count, workers.slab_bytes, grid.shape))
    seen, rows = _seen_by_slabs(geometry, grid, tasks)
    # A scan is read view by view, and of each what is needed is filtered.
    pixels = seen * geometry.rows * geometry.columns
    speed = workers.speed
    if exact:
        seconds = exact_updates(geometry, grid) * speed.exact_back + pixels * speed.exact_filtering
    else:
        updates = math.prod(grid.shape) * views_a_voxel(geometry, grid)
        updates += _COVERAGE * math.prod(grid.shape)
        seconds = updates * speed.back + rows * geometry.columns * speed.filtering
        seconds += _COLUMN * (seen - geometry.views) * math.prod(grid.shape[1:]) * speed.back
    seconds += pixels * _READ_S * workers.slowdown
    # What workers write the client reads again, and writes into the output.
    return PlannedStep("planes", tasks, seconds, 4.0 * pixels + _bytes(grid), 2.0 * _bytes(grid))


def _binning(geometry: ConeBeamGeometry, level: int, workers: Workers) -> PlannedStep:
    from clra.methods.shared_work.shared_scan import chunks_each, view_chunks

    stored = 4.0 * geometry.views * geometry.rows * geometry.columns
    each = chunks_each(workers.count, geometry)
    tasks = len(view_chunks(workers.count, geometry.views, each))
    seconds = stored / 4 * _READ_S * workers.slowdown
    return PlannedStep("binning", tasks, seconds, stored, stored / level**2)


def _iteration(
    geometry: ConeBeamGeometry, grid: VolumeGrid, level: int, workers: Workers
) -> list[PlannedStep]:
    """Return the steps of an iteration, as `SharedLevel` has them."""
    from clra.methods.alignment.options import Solver
    from clra.methods.execution.executor import slabs_of
    from clra.methods.reconstruction.fitted_fbp import VOLUMES
    from clra.methods.shared_work.shared_scan import chunks_each, view_chunks

    terms = Solver().terms
    binned = geometry.binned(level) if level > 1 else geometry
    grid = grid.binned(level) if level > 1 else grid
    slabs = slabs_of(workers.count, workers.slab_bytes, grid.shape, VOLUMES if terms else 1)
    each = chunks_each(workers.count, geometry)
    chunks = len(view_chunks(workers.count, geometry.views, each))
    seen, rows = _seen_by_slabs(binned, grid, len(slabs))
    looked_at = rows * binned.columns
    view = float(binned.rows * binned.columns)
    updates = math.prod(grid.shape) * views_a_voxel(binned, grid)
    speed = workers.speed
    again = max(0.0, seen - binned.views) * math.prod(grid.shape[1:])
    covered = _COVERAGE * math.prod(grid.shape)
    back = (updates + covered + _COLUMN * again) * speed.back + looked_at * speed.filtering
    forward = updates * speed.forward
    volume, images = _bytes(grid), 4.0 * binned.views * view
    fetched = volume * _looked_at(chunks, len(slabs), seen / binned.views)
    steps = [PlannedStep("reconstructing", len(slabs), back, 4 * looked_at, volume)]
    for _ in range(terms):
        steps += [
            PlannedStep("simulating", chunks, forward, fetched + images, images),
            PlannedStep("correcting", len(slabs), back, 4 * looked_at + volume, volume),
        ]
    registering = binned.views * view * speed.registering
    return [
        *steps,
        PlannedStep("registering", chunks, forward + registering, fetched + images, 0.0),
    ]


def _ordered_subsets(
    geometry: ConeBeamGeometry, grid: VolumeGrid, workers: Workers
) -> list[PlannedStep]:
    """Return the steps of OSEM-TR by its defaults, as `shared_osem_tr` has them."""
    from clra.methods.execution.executor import slabs_of
    from clra.methods.ordered_subsets.subset_rays import VOLUMES
    from clra.methods.reconstruction.osem_tr import OrderedSubsets
    from clra.methods.shared_work.shared_scan import view_chunks

    options, speed = OrderedSubsets(), workers.speed
    subsets = options.share_out(geometry, grid, None)
    tasks = len(slabs_of(workers.count, workers.slab_bytes, grid.shape, VOLUMES))
    seen, rows = _seen_by_slabs(geometry, grid, tasks)
    pixels = float(geometry.rows * geometry.columns)
    volume, images = _bytes(grid), 4.0 * pixels * geometry.views
    seen_rows = 4.0 * rows * geometry.columns
    updates = math.prod(grid.shape) * views_a_voxel(geometry, grid)
    read = images / 4 * _READ_S * workers.slowdown
    read += _STATISTICS * pixels * geometry.views * speed.registering
    handled = _HANDLING_S * workers.slowdown
    forward, adjoint = updates * speed.forward, _ADJOINT * updates * speed.forward
    back = updates * speed.back + rows * geometry.columns * speed.filtering
    back += pixels * seen * _READ_S * workers.slowdown
    chunks = len(view_chunks(workers.count, geometry.views))
    steps = [
        PlannedStep("reconstructing", tasks, back, 4.0 * pixels * seen, volume),
        PlannedStep("weighing", chunks, forward + read, images, images),
        PlannedStep("back-projecting", tasks, adjoint, seen_rows, volume),
    ]
    for subset in options.passes * subsets:
        part, chunks = len(subset) / geometry.views, len(view_chunks(workers.count, len(subset), 1))
        fetched = volume * _looked_at(chunks, tasks, seen / geometry.views)
        steps += [
            PlannedStep(
                "comparing",
                chunks,
                part * (forward + read) + fetched * handled,
                part * images + fetched,
                part * images,
            ),
            PlannedStep(
                "stepping",
                tasks,
                part * adjoint + 3 * volume * handled,
                part * seen_rows + 2 * volume,
                volume,
            ),
        ]
    return steps


def _handed_on(grid: VolumeGrid, workers: Workers) -> PlannedStep:
    """Return how a volume in files becomes the output: by workers, then by the client."""
    from clra.methods.execution.executor import slabs_of

    tasks = len(slabs_of(workers.count, workers.slab_bytes, grid.shape))
    return PlannedStep("writing", tasks, 0.0, 2 * _bytes(grid), 2 * _bytes(grid))


def _looked_at(chunks: int, slabs: int, seen: float) -> float:
    """Count how often a volume is read by chunks of views, of which each reads what it sees.

    `seen` are the slabs that a view sees, on average.
    """
    return chunks * min(1.0, (math.ceil(min(slabs, seen)) + 1) / slabs)


def _seen_by_slabs(geometry: ConeBeamGeometry, grid: VolumeGrid, slabs: int) -> tuple[float, float]:
    """Add up the views that see each of some slabs, and their rows that do."""
    from clra.model.view_selection import rows_that_see, views_that_see
    from clra.ops.streaming.stream import equal_runs

    views = rows = 0
    radius = 0.5 * grid.shape[2] * grid.voxel_size
    for part in equal_runs(grid.shape[0], min(slabs, grid.shape[0])):
        slab = grid.slab(part.start, part.stop)
        seeing = views_that_see(geometry, slab)
        low, high = rows_that_see(geometry, slab, radius)[seeing].T
        views += int(seeing.sum())
        rows += int((high - low).sum())
    return float(views), float(rows)


def _is_helical(geometry: ConeBeamGeometry) -> bool:
    from clra.model.helix.fit import fit_helices

    try:
        fit_helices(geometry)
    except InputError:
        return False
    return True


def _bytes(grid: VolumeGrid) -> float:
    return 4.0 * math.prod(grid.shape)
