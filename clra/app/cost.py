"""What aligning and reconstructing a scan will take: memory, and time on a device."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from clra.app.progress_bar import duration
from clra.app.speed import Speed, exact_updates, views_a_voxel
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid, default_grid
from clra.model.schedule import level_name

if TYPE_CHECKING:
    from clra.methods.memory_estimate import Need

LEVELS = (1, 2, 4)


@dataclass(frozen=True)
class Cost:
    """What one level of resolution takes.

    Attributes
    ----------
    level : str
        "FR", "HR" or "QR".
    detector : (int, int)
        Rows and columns of a radiograph.
    radiograph_bytes, volume_bytes : int
        Size of all radiographs and of the volume.
    volume_shape : (int, int, int)
        Voxels (nz, ny, nx) of the field of view.
    voxel_views : float
        Voxels times the views that see them.
    reconstruction_s, iteration_s : float
        Time of a reconstruction, and of an iteration of alignment, without reading the scan.
    exact_s : float
        Time of Katsevich's method; not a number where it cannot treat the scan.
    reconstruction, iteration, exact, multigrid : Need or None
        Memory that they, and at full resolution IMGR, take at their peaks, where there is a device.
    """

    level: str
    detector: tuple[int, int]
    radiograph_bytes: int
    volume_shape: tuple[int, int, int]
    volume_bytes: int
    voxel_views: float
    reconstruction_s: float
    iteration_s: float
    exact_s: float
    reconstruction: "Need | None" = None
    iteration: "Need | None" = None
    exact: "Need | None" = None
    multigrid: "Need | None" = None


def costs_of(
    geometry: ConeBeamGeometry, speed: Speed, aligned: VolumeGrid | None = None
) -> list[Cost]:
    """Estimate the cost of each level, from full to quarter resolution.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan.
    speed : Speed
        Of the device, from :func:`measure`.
    aligned : VolumeGrid, optional
        Where alignment reconstructs at full resolution, as far as radiographs tell; by default the
        field of view with a margin.
    """
    whole = default_grid(geometry)
    seen = views_a_voxel(geometry, whole)
    costs = []
    for level in LEVELS:
        if level > min(*geometry.shape, *whole.shape):
            break
        rows, columns = geometry.rows // level, geometry.columns // level
        nz, ny, nx = (n // level for n in whole.shape)
        pixels = geometry.views * rows * columns
        updates = nz * ny * nx * seen
        reconstruction = updates * speed.back + pixels * speed.filtering
        projection = updates * speed.forward
        costs.append(
            Cost(
                level=level_name(level),
                detector=(rows, columns),
                radiograph_bytes=4 * pixels,
                volume_shape=(nz, ny, nx),
                volume_bytes=4 * nz * ny * nx,
                voxel_views=updates,
                reconstruction_s=reconstruction,
                iteration_s=reconstruction + projection + pixels * speed.registering,
                exact_s=exact_updates(geometry, whole) / level**3 * speed.exact_back
                + pixels * speed.exact_filtering,
                **_needs(speed, geometry, whole, aligned, level),
            )
        )
    return costs


def _needs(
    speed: Speed,
    geometry: ConeBeamGeometry,
    grid: VolumeGrid,
    aligned: VolumeGrid | None,
    level: int,
) -> dict[str, "Need"]:
    if speed.budgets is None:
        return {}
    from clra.methods.alignment.reprojection import with_margin
    from clra.methods.memory_estimate import alignment_need, multigrid_need, reconstruction_need

    binned = (geometry.binned(level), grid.binned(level)) if level > 1 else (geometry, grid)
    needs = {
        "reconstruction": reconstruction_need(speed.budgets, *binned),
        "iteration": alignment_need(speed.budgets, geometry, aligned or with_margin(grid), level),
    }
    if not math.isnan(speed.exact_back):
        needs["exact"] = reconstruction_need(speed.budgets, *binned, lines=2)
    if level == 1 and min(geometry.shape) >= max(LEVELS):
        needs["multigrid"] = multigrid_need(speed.budgets, geometry, grid)
    return needs


def costs_table(costs: Sequence[Cost], speed: Speed) -> str:
    """Lay costs out for reading.

    Parameters
    ----------
    costs : sequence of Cost
        One a level.
    speed : Speed
        What the times hold for.
    """
    helical = any(cost.exact_s > 0 for cost in costs)
    head = ("level", "radiographs", "", "volume", "", "reconstruction", "iteration")
    rows: list[tuple[str, ...]] = [head + ("katsevich",) * helical]
    for cost in costs:
        nz, ny, nx = cost.volume_shape
        rows.append(
            (
                cost.level,
                f"{cost.detector[0]} x {cost.detector[1]}",
                size(cost.radiograph_bytes),
                f"{nx} x {ny} x {nz}",
                size(cost.volume_bytes),
                duration(cost.reconstruction_s),
                duration(cost.iteration_s),
                *([duration(cost.exact_s)] if helical else []),
            )
        )
    lines = columns(rows)
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
            *columns(_memory_rows(costs)),
            "",
            f"Memory at its peak, within {within} (--max-host-memory, --max-device-memory); what "
            "has no room goes to temporary files (TMPDIR).",
        ]
    )


def _memory_rows(costs: Sequence[Cost]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [("memory", "work", "device", "host", "temporary files")]
    for cost in costs:
        for work, need in (
            ("reconstruction", cost.reconstruction),
            ("iteration", cost.iteration),
            ("katsevich", cost.exact),
            ("imgr", cost.multigrid),
        ):
            if need is not None:
                sizes = (size(need.device), size(need.host), size(need.disk))
                rows.append((cost.level, work, *sizes))
    return rows


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Align the cells of each column to the right; return a line a row."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  ".join(c.rjust(w) for c, w in zip(row, widths, strict=True)) for row in rows]


def size(count: float) -> str:
    """Write a number of bytes: "512 MiB", "3.2 GiB"."""
    for unit in ("B", "KiB", "MiB", "GiB", "TiB"):
        if count < 1000 or unit == "TiB":
            break
        count /= 1024
    return f"{count:.3g} {unit}" if count < 1000 else f"{count:.0f} {unit}"
