"""What a method takes of the memory within a budget, worked out without running it."""

from dataclasses import dataclass

import numpy as np

from clra.methods.alignment.options import Solver
from clra.methods.alignment.reprojection import band_of, with_margin
from clra.methods.reconstruction.fitted_fbp import VOLUMES
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.sampling.ray_weights import ray_weights, widened
from clra.ops.projection.layout import view_shape
from clra.ops.registration.gauss_newton import pair_bytes
from clra.ops.runtime.lines import line_stride
from clra.ops.streaming.memory import Budgets, keeps

# Bytes for an element of the windows and masks in registration.
_WINDOW = 16
# Radiographs read at a time, as parts of a chunk: two in flight, and while one is converted and
# checked half of another.
_READING = 2.5
# What Python takes for the gauge, the motion and the transforms' threads.
_SMALL = 8 << 20


@dataclass(frozen=True)
class Need:
    """Memory at its peak [bytes].

    Attributes
    ----------
    device, host : int
        Buffers of the device; resident memory above what the program takes by itself. On a CPU
        device the one is a part of the other.
    disk : int
        Temporary files.
    """

    device: int
    host: int
    disk: int = 0

    def beside(self, other: "Need") -> "Need":
        """Return what two pieces of work need that follow each other."""
        return Need(
            max(self.device, other.device),
            max(self.host, other.host),
            max(self.disk, other.disk),
        )


def reconstruction_need(
    budgets: Budgets,
    geometry: ConeBeamGeometry,
    grid: VolumeGrid,
    lines: int = 1,
    *,
    volumes: int = 1,
) -> Need:
    """Return what filtered back-projection takes, from file to file.

    Parameters
    ----------
    budgets : Budgets
        Of device and host.
    geometry : ConeBeamGeometry
        Of the radiographs at the resolution that they are used at.
    grid : VolumeGrid
        Of the volume.
    lines : int
        For Katsevich's method: lines that its filter makes of a row of a radiograph, about two.
    volumes : int
        How many volumes the device has to hold at a time.
    """
    rays = ray_weights(geometry)
    if rays is not None:  # filtered radiographs of an offset detector are wider
        geometry = widened(geometry, *rays.beyond)
    views, (rows, columns), shared = geometry.views, geometry.shape, budgets.shared
    chunk = _chunk(budgets, geometry)
    padded = 4 * 2 * columns
    filtering = min(_limited(budgets.profile.filter_bytes, budgets), padded * rows * views)
    if lines > 1:
        filtering = max(filtering, lines * rows * padded)
    coarse = grid.shape[0] / 4 * grid.shape[1] / 8 * grid.shape[2] / 8
    device = (
        _slab(budgets, grid, volumes)
        + _projecting(budgets, geometry, chunk)
        + filtering
        + int(4 * coarse)
        + 200 * views
        + _resident(budgets, geometry)
        + (2 if shared else 4) * chunk
    )
    piece = min(budgets.piece, _slab(budgets, grid, volumes))
    return Need(device, int(shared * device + _READING * chunk) + piece)


def alignment_need(budgets: Budgets, full: ConeBeamGeometry, grid: VolumeGrid, level: int) -> Need:
    """Return what the iterations of alignment at one level take.

    Parameters
    ----------
    budgets : Budgets
        Of device and host.
    full : ConeBeamGeometry
        Of the scan.
    grid : VolumeGrid
        Of :func:`clra.methods.alignment.region.region_of`, at full resolution: that of a truncated
        or long sample is wider or higher than the field of view.
    level : int
        Binning: 1, 2 or 4.
    """
    geometry = full.binned(level) if level > 1 else full
    grid = grid.binned(level) if level > 1 else grid
    # What the radiographs have beyond the re-projections is kept beside them; on small detectors
    # the re-projections are as well.
    solver = Solver()
    count = int(level > 1) + int(solver.terms > 0) + int(solver.is_biased(geometry))
    kept = [_bytes(geometry)] * count
    return _registering_need(budgets, full, geometry, grid, VOLUMES, kept)


def multigrid_need(budgets: Budgets, full: ConeBeamGeometry, grid: VolumeGrid) -> Need:
    """Return what IMGR takes at its last level, full resolution, where it takes most.

    Parameters
    ----------
    budgets, full
        As :func:`alignment_need` takes them.
    grid : VolumeGrid
        Of the volume at full resolution.
    """
    # Radiographs of the lower levels, and the simulated ones.
    kept = [_bytes(full.binned(level)) for level in (4, 2)] + [_bytes(full)]
    return _registering_need(budgets, full, full, with_margin(grid), 2, kept)


def _registering_need(
    budgets: Budgets,
    full: ConeBeamGeometry,
    geometry: ConeBeamGeometry,
    grid: VolumeGrid,
    volumes: int,
    kept: list[int],
) -> Need:
    """Return what it takes to reconstruct volumes, to project and to register.

    `kept` are the sizes of the arrays that stay on the host beside the volumes.
    """
    shared, pixels = budgets.shared, int(np.prod(geometry.shape))
    slab, volume = _slab(budgets, grid, volumes), 4 * int(np.prod(grid.shape))
    cut = slab < volume
    in_memory = disk = 0
    for size in kept + [volume] * volumes * cut:
        if in_memory + size <= budgets.kept:
            in_memory += size
        else:
            disk += size
    on_host = shared and cut and sum(kept) + volumes * volume <= budgets.kept
    chunk = _chunk(budgets, geometry)
    lined = geometry.rows * line_stride(geometry.columns)
    pair = pair_bytes(geometry.shape, band_of(geometry.shape)[1])
    pairs = max(1, _limited(budgets.profile.registration_bytes, budgets, 3) // pair)
    pairs = min(pairs, chunk // (4 * pixels))
    registering = (
        _projecting(budgets, geometry, chunk)
        + pair * pairs
        + _WINDOW * lined
        + (1 if shared else 2) * chunk
        + _resident(budgets, geometry)
        + (0 if on_host else slab)
    )
    reading = _chunk(budgets, full)
    first = reconstruction_need(budgets, geometry, grid, volumes=volumes)
    # A volume that is updated stays beside the update.
    beside = _projecting(budgets, geometry, chunk) + chunk + (0 if on_host else slab)
    beside *= volumes - 1
    steps = (
        Need(first.device + beside, first.host + shared * beside),
        Need(registering, int(shared * registering + _READING * chunk)),
        Need(0 if shared else reading, int(_READING * reading)),
    )
    most = steps[0].beside(steps[1]).beside(steps[2])
    return Need(most.device, most.host + in_memory + _SMALL, disk)


def _bytes(geometry: ConeBeamGeometry) -> int:
    """All radiographs."""
    return 4 * geometry.views * int(np.prod(geometry.shape))


def _resident(budgets: Budgets, geometry: ConeBeamGeometry) -> int:
    """Bytes of the radiographs that stay on the device."""
    size = _bytes(geometry)
    return size if keeps(budgets, (geometry.views, *geometry.shape)) else 0


def _limited(wanted: int, budgets: Budgets, shares: int = 1) -> int:
    return min(wanted, shares * budgets.scratch)


def _chunk(budgets: Budgets, geometry: ConeBeamGeometry) -> int:
    """Bytes of the radiographs of a chunk, which are equal runs of all."""
    view = 4 * int(np.prod(geometry.shape))
    most = max(1, budgets.chunk(view) // view)
    return view * -(-geometry.views // -(-geometry.views // most))


def _slab(budgets: Budgets, grid: VolumeGrid, volumes: int = 1) -> int:
    """Bytes of a slab, which are equal runs of all planes."""
    nz, ny, nx = grid.shape
    most = max(1, budgets.slab // volumes // (4 * ny * nx))
    return 4 * ny * nx * -(-nz // -(-nz // most))


def _projecting(budgets: Budgets, geometry: ConeBeamGeometry, chunk: int) -> int:
    """Bytes of padded lines in a projector; those of GPUs need none."""
    if not budgets.profile.on_cpu:
        return 0
    pixels = 4 * int(np.prod(geometry.shape))
    view = 4 * int(np.prod(view_shape(budgets.profile, geometry.shape)))
    most = max(1, _limited(budgets.profile.projector_bytes, budgets) // view)
    return view * min(most, max(1, chunk // pixels))
