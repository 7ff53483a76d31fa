"""What aligning and reconstructing a scan will take: memory, and time on a device."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from clra.app.progress import duration
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid, default_grid
from clra.model.schedule import level_name

if TYPE_CHECKING:
    from clra.methods.needs import Need
    from clra.ops.memory import Budgets
    from clra.ops.streaming import Report

LEVELS = (1, 2, 4)
# Size of the test: views, and the most columns of a radiograph. It takes about a second on two
# cores; with half of the columns launching counts and the estimate is a third too long.
_TEST_VIEWS, _TEST_COLUMNS = 48, 160
# Heights at which the views that see the axis are counted.
_HEIGHTS = 64


@dataclass(frozen=True)
class Speed:
    """Seconds that a device takes for a unit of each kind of work.

    Attributes
    ----------
    device : str
        Its name.
    budgets : Budgets or None
        Memory that may be used on it and on the host.
    back, forward : float
        To back-project, and to project forward, one voxel in one view [s].
    filtering, registering : float
        To filter, and to register, one pixel [s].
    """

    device: str
    budgets: "Budgets | None"
    back: float
    forward: float
    filtering: float
    registering: float

    @classmethod
    def unknown(cls) -> "Speed":
        """Return the speed of no device."""
        return cls("no device", None, *[math.nan] * 4)


@dataclass(frozen=True)
class Cost:
    """What one level of resolution takes.

    Attributes
    ----------
    level : str
        "FR", "HR" or "QR".
    panel : (int, int)
        Rows and columns of a radiograph.
    radiograph_bytes, volume_bytes : int
        Size of all radiographs and of the volume.
    volume_shape : (int, int, int)
        Voxels (nz, ny, nx) of the field of view.
    voxel_views : float
        Voxels times the views that see them.
    reconstruction_s, iteration_s : float
        Time of a reconstruction, and of an iteration of alignment, without reading the scan.
    reconstruction, iteration : Need or None
        Memory that they take at their peaks, where there is a device.
    """

    level: str
    panel: tuple[int, int]
    radiograph_bytes: int
    volume_shape: tuple[int, int, int]
    volume_bytes: int
    voxel_views: float
    reconstruction_s: float
    iteration_s: float
    reconstruction: "Need | None" = None
    iteration: "Need | None" = None


def costs_of(geometry: ConeBeamGeometry, speed: Speed) -> list[Cost]:
    """Estimate the cost of each level, from full to quarter resolution.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan.
    speed : Speed
        Of the device, from :func:`measure`.
    """
    whole = default_grid(geometry)
    seen = _views_a_voxel(geometry, whole)
    costs = []
    for level in LEVELS:
        if level > min(*geometry.shape, *whole.shape):
            break
        rows, columns = geometry.rows // level, geometry.columns // level
        nz, ny, nx = (n // level for n in whole.shape)
        pixels = geometry.views * rows * columns
        updates = nz * ny * nx * seen
        reconstruction = updates * speed.back + pixels * speed.filtering
        registration = updates * speed.forward + pixels * speed.registering
        costs.append(
            Cost(
                level=level_name(level),
                panel=(rows, columns),
                radiograph_bytes=4 * pixels,
                volume_shape=(nz, ny, nx),
                volume_bytes=4 * nz * ny * nx,
                voxel_views=updates,
                reconstruction_s=reconstruction,
                iteration_s=reconstruction + registration,
                **_needs(speed, geometry, whole, level),
            )
        )
    return costs


def _needs(
    speed: Speed, geometry: ConeBeamGeometry, grid: VolumeGrid, level: int
) -> dict[str, "Need"]:
    if speed.budgets is None:
        return {}
    from clra.methods.needs import alignment_need, reconstruction_need

    binned = (geometry.binned(level), grid.binned(level)) if level > 1 else (geometry, grid)
    return {
        "reconstruction": reconstruction_need(speed.budgets, *binned),
        "iteration": alignment_need(speed.budgets, geometry, grid, level),
    }


def _views_a_voxel(geometry: ConeBeamGeometry, grid: VolumeGrid) -> float:
    """Count the views that see a voxel, on average over the axis."""
    _, _, z = grid.coordinates()
    heights = np.linspace(z[0], z[-1], _HEIGHTS)
    axis = np.column_stack([np.zeros((_HEIGHTS, 2)), heights])
    row = geometry.project(axis)[..., 1]
    return float(np.sum((row >= 0) & (row <= geometry.rows - 1)) / _HEIGHTS)


def measure(
    geometry: ConeBeamGeometry,
    device: Any = None,
    report: "Report | None" = None,
    *,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
) -> Speed:
    """Measure the speed of a device on a small piece of work like that of a scan.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan.
    device : str or cl.Device, optional
        As :func:`clra.ops.opencl.choose_device` takes it.
    report : callable, optional
        Told how far the test is.
    max_device_memory, max_host_memory : int, optional
        Bytes that the work may use; the test itself is small.

    Returns
    -------
    Speed
        The first run of each operation, which builds its kernels, is not counted.
    """
    from clra.ops.filtering import RampFilter
    from clra.ops.memory import Budgets
    from clra.ops.projector import BackProjector, ForwardProjector
    from clra.ops.registration import ESTIMATE_FIELDS, Registration
    from clra.ops.streaming import Stream

    stream = Stream(device, report=report)
    context, queue = stream.context, stream.queue
    level = -(-geometry.columns // _TEST_COLUMNS)
    chosen = np.unique(np.linspace(0, geometry.views - 1, _TEST_VIEWS).astype(int))
    small = geometry.subset(chosen)
    small = small.binned(min(level, *small.shape)) if level > 1 else small
    grid = default_grid(small)
    nz, ny, nx = grid.shape
    shape = (small.views, *small.shape)
    # Something to register: the same smooth pattern in every radiograph.
    row, column = np.ogrid[: shape[1], : shape[2]]
    pattern = np.sin(row / 5.0) * np.cos(column / 7.0) + np.sin((row + column) / 11.0)
    radiographs = stream.upload(np.tile(pattern.astype(np.float32), (shape[0], 1, 1)))
    filtered, volume = stream.empty(shape), stream.empty((ny, nx, nz))
    estimates = stream.empty((shape[0], len(ESTIMATE_FIELDS)))
    ramp = RampFilter(context, small)
    back = BackProjector(context, small, grid, volume_order="yxz")
    forward = ForwardProjector(context, small, grid, volume_order="yxz")
    register = Registration(context, small.shape, views=small.views)
    updates = float(np.prod(grid.shape)) * _views_a_voxel(small, grid)
    pixels = float(np.prod(shape))
    work: Sequence[tuple[str, Callable[[], Any], float]] = (
        ("filtering", lambda: ramp(queue, filtered, radiographs), pixels),
        ("back", lambda: back(queue, volume, filtered), updates),
        ("forward", lambda: forward(queue, filtered, volume), updates),
        ("registering", lambda: register(queue, estimates, radiographs, radiographs), pixels),
    )
    seconds = {}
    for step, (name, run, amount) in enumerate(work):
        stream.report("testing the device", step, len(work))
        run().wait()
        started = time.perf_counter()
        run().wait()
        seconds[name] = (time.perf_counter() - started) / amount
    budgets = Budgets.of(stream.device, max_device_memory, max_host_memory)
    return Speed(stream.device.name.strip(), budgets, **seconds)


def costs_table(costs: Sequence[Cost], speed: Speed) -> str:
    """Lay costs out for reading.

    Parameters
    ----------
    costs : sequence of Cost
        One a level.
    speed : Speed
        What the times hold for.
    """
    rows = [("level", "radiographs", "", "volume", "", "reconstruction", "iteration")]
    for cost in costs:
        nz, ny, nx = cost.volume_shape
        rows.append(
            (
                cost.level,
                f"{cost.panel[0]} x {cost.panel[1]}",
                size(cost.radiograph_bytes),
                f"{nx} x {ny} x {nz}",
                size(cost.volume_bytes),
                duration(cost.reconstruction_s),
                duration(cost.iteration_s),
            )
        )
    lines = _columns(rows)
    if speed.budgets is None:
        return "\n".join(lines)
    budgets = speed.budgets
    within = f"{size(budgets.host)} on the host, "
    within += "half of them for the device" if budgets.shared else f"{size(budgets.device)} on it"
    return "\n".join(
        [
            *lines,
            "",
            f"Times are for {speed.device}, without reading the scan; an iteration is one of clra "
            "align.",
            "",
            *_columns(_memory_rows(costs)),
            "",
            f"Memory at its peak, within {within} (--max-host-memory, --max-device-memory); what "
            "has no room goes to temporary files (TMPDIR).",
        ]
    )


def _memory_rows(costs: Sequence[Cost]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [("memory", "work", "device", "host", "temporary files")]
    for cost in costs:
        for work, need in (("reconstruction", cost.reconstruction), ("iteration", cost.iteration)):
            if need is not None:
                sizes = (size(need.device), size(need.host), size(need.disk))
                rows.append((cost.level, work, *sizes))
    return rows


def _columns(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  ".join(c.rjust(w) for c, w in zip(row, widths, strict=True)) for row in rows]


def size(count: float) -> str:
    """Write a number of bytes: "512 MiB", "3.2 GiB"."""
    for unit in ("B", "KiB", "MiB", "GiB", "TiB"):
        if count < 1000 or unit == "TiB":
            break
        count /= 1024
    return f"{count:.3g} {unit}" if count < 1000 else f"{count:.0f} {unit}"
