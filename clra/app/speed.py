"""How fast a device is at the work of a scan, from a small test."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from clra.app.scan_description import path_of
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid, default_grid

if TYPE_CHECKING:
    from clra.ops.streaming.memory import Budgets
    from clra.ops.streaming.stream import Stream
    from clra.progress import ProgressCallback

# Size of the test: views, and the most columns of a radiograph. It takes about a second on two
# cores; with half of the columns launching counts and the estimate is a third too long.
_TEST_VIEWS, _TEST_COLUMNS = 48, 160
# Rows and columns that a registration needs at least.
_LEAST = 16
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
    exact_back, exact_filtering : float
        To back-project one voxel in one view, and to filter one pixel, by Katsevich's method [s];
        not a number where it cannot treat the scan.
    """

    device: str
    budgets: "Budgets | None"
    back: float
    forward: float
    filtering: float
    registering: float
    exact_back: float = math.nan
    exact_filtering: float = math.nan

    @classmethod
    def unknown(cls) -> "Speed":
        """Return the speed of no device."""
        return cls("no device", None, *[math.nan] * 4)


def views_a_voxel(geometry: ConeBeamGeometry, grid: VolumeGrid) -> float:
    """Count the views that see a voxel, on average over the axis.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan.
    grid : VolumeGrid
        Of the volume.
    """
    _, _, z = grid.coordinates()
    heights = np.linspace(z[0], z[-1], _HEIGHTS)
    axis = np.column_stack([np.zeros((_HEIGHTS, 2)), heights])
    row = geometry.project(axis)[..., 1]
    return float(np.sum((row >= 0) & (row <= geometry.rows - 1)) / _HEIGHTS)


def exact_updates(geometry: ConeBeamGeometry, grid: VolumeGrid) -> float:
    """Voxels times views in Katsevich's method: a view's window is half a pitch high at the axis.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of one helix or several.
    grid : VolumeGrid
        Of the volume.
    """
    _, ny, nx = grid.shape
    pitch = path_of(geometry).pitch_mm
    return 0.5 * pitch / grid.voxel_size * nx * ny * geometry.views


def measure(
    geometry: ConeBeamGeometry,
    device: Any = None,
    report: "ProgressCallback | None" = None,
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
        As :func:`clra.ops.runtime.devices.choose_device` takes it.
    report : callable, optional
        Told how far the test is.
    max_device_memory, max_host_memory : int, optional
        Bytes that the work may use; the test itself is small.

    Returns
    -------
    Speed
        The first run of each operation, which builds its kernels, is not counted.
    """
    from clra.ops.filtering.ramp import RampFilter
    from clra.ops.projection.projector import BackProjector, ForwardProjector
    from clra.ops.registration.gauss_newton import ESTIMATE_FIELDS, Registration
    from clra.ops.streaming.memory import Budgets
    from clra.ops.streaming.stream import Stream

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
    sheet = (max(shape[1], _LEAST), max(shape[2], _LEAST))
    row, column = np.ogrid[: sheet[0], : sheet[1]]
    pattern = np.sin(row / 5.0) * np.cos(column / 7.0) + np.sin((row + column) / 11.0)
    sheets = np.tile(pattern.astype(np.float32), (shape[0], 1, 1))
    radiographs = stream.upload(np.ascontiguousarray(sheets[:, : shape[1], : shape[2]]))
    registered = radiographs if sheet == small.shape else stream.upload(sheets)
    filtered, volume = stream.empty(shape), stream.empty((ny, nx, nz))
    estimates = stream.empty((shape[0], len(ESTIMATE_FIELDS)))
    ramp = RampFilter(context, small)
    back = BackProjector(context, small, grid, volume_order="yxz")
    forward = ForwardProjector(context, small, grid, volume_order="yxz")
    register = Registration(context, sheet, views=small.views)
    updates = float(np.prod(grid.shape)) * views_a_voxel(small, grid)
    pixels = float(np.prod(shape))
    work: tuple[tuple[str, Callable[[], Any], float], ...] = (
        ("filtering", lambda: ramp(queue, filtered, radiographs), pixels),
        ("back", lambda: back(queue, volume, filtered), updates),
        ("forward", lambda: forward(queue, filtered, volume), updates),
        (
            "registering",
            lambda: register(queue, estimates, registered, registered),
            float(sheets.size),
        ),
    )
    work += _exact_work(stream, geometry, level)
    seconds = {}
    for step, (name, run, amount) in enumerate(work):
        stream.report("testing the device", step, len(work))
        run().wait()
        started = time.perf_counter()
        run().wait()
        seconds[name] = (time.perf_counter() - started) / amount
    budgets = Budgets.of(stream.device, max_device_memory, max_host_memory)
    return Speed(stream.device.name.strip(), budgets, **seconds)


def _exact_work(
    stream: "Stream", geometry: ConeBeamGeometry, level: int
) -> tuple[tuple[str, Callable[[], Any], float], ...]:
    """Name, test and amount of each kind of work of Katsevich's method; none where it cannot."""
    from clra.model.helix.fit import fit_helices
    from clra.model.helix.pi_intervals import field_of_view
    from clra.ops.filtering.katsevich_filter import KatsevichFilter
    from clra.ops.projection.pi_backprojector import PiBackProjector

    try:
        fit_helices(geometry)
        # Successive views, of the first helix.
        small = geometry.subset(slice(0, _TEST_VIEWS + 1))
        small = small.binned(min(level, *small.shape)) if level > 1 else small
        _, helix = fit_helices(small)[0]
        grid = default_grid(small)
        radius = field_of_view([helix], grid)
    except ValueError:
        return ()
    nz, ny, nx = grid.shape
    filters = KatsevichFilter(stream.context, helix, radius)
    back = PiBackProjector(stream.context, [filters.helix], 0, grid, radius)
    radiographs = stream.upload(np.ones((helix.views, *helix.shape), np.float32))
    filtered = stream.empty((filters.helix.views, *filters.helix.shape))
    volume = stream.empty((ny, nx, nz))
    queue = stream.queue
    return (
        (
            "exact_filtering",
            lambda: filters(queue, filtered, radiographs),
            float(np.prod(radiographs.shape)),
        ),
        ("exact_back", lambda: back(queue, volume, filtered), exact_updates(small, grid)),
    )
