"""Work cut to fit the memory: views in chunks, volumes in z-slabs, host and device kept apart.

This is the one module that moves data between host and device. A CPU device works on the host's
own arrays: nothing is copied that can be shared.
"""

import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyopencl as cl
import pyopencl.array
from numpy.typing import NDArray

from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.scan import Scan
from clra.ops import opencl
from clra.ops.pyramid import Restrict2D

Floats = NDArray[np.float32]

# Radiographs in flight at once. Large enough that launching costs nothing beside computing, small
# enough that three of them (measured, filtered, simulated) are no burden on a laptop; at half or
# twice the size the time of an iteration is the same within 3 %.
_CHUNK_BYTES = 96 << 20


@dataclass(frozen=True)
class Progress:
    """How far a piece of work is: `done` of `total` steps of the stage named `stage`."""

    stage: str
    done: int
    total: int


Report = Callable[[Progress], None]


def host_memory() -> int:
    """Bytes of memory that this machine has free for us (Linux; elsewhere 4 GiB)."""
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) << 10
    except OSError:
        pass
    return 4 << 30


class Stream:
    """One device with its queue, and how much memory may be used on it and on the host.

    Parameters
    ----------
    device : str or cl.Device, optional
        As :func:`clra.ops.opencl.choose_device` takes it.
    max_device_memory, max_host_memory : int, optional
        Bytes; by default 3/4 of the device's memory and half of what the host has available.
    report : callable, optional
        Called with a :class:`Progress` as work goes on.

    Raises
    ------
    NoDeviceError
        If there is no such device.
    """

    def __init__(
        self,
        device: str | cl.Device | None = None,
        *,
        max_device_memory: int | None = None,
        max_host_memory: int | None = None,
        report: Report | None = None,
    ) -> None:
        self.device = opencl.choose_device(device)
        self.context = cl.Context([self.device])
        self.queue = cl.CommandQueue(self.context)
        self.device_budget = max_device_memory or self.device.global_mem_size * 3 // 4
        self.host_budget = max_host_memory or host_memory() // 2
        self.largest_buffer = min(self.device.max_mem_alloc_size, self.device_budget // 2)
        self._report = report
        self._shared = opencl.is_cpu(self.device)

    def report(self, stage: str, done: int, total: int) -> None:
        """Tell the caller how far a stage is."""
        if self._report is not None:
            self._report(Progress(stage, done, total))

    def upload(self, host: Floats) -> cl.array.Array:
        """Give the device a C-ordered float32 array; a CPU reads it in place.

        The array has to be kept until the device has done with it.
        """
        flags = cl.mem_flags
        mode = flags.USE_HOST_PTR if self._shared else flags.COPY_HOST_PTR
        buffer = cl.Buffer(self.context, flags.READ_ONLY | mode, hostbuf=host)
        return cl.array.Array(self.queue, host.shape, host.dtype, data=buffer)

    def empty(self, shape: tuple[int, ...]) -> cl.array.Array:
        """Device array of float32 with undefined contents."""
        return cl.array.empty(self.queue, shape, np.float32)

    def download(self, array: cl.array.Array) -> Floats:
        """Copy of a device array on the host, when all that was enqueued is done."""
        return np.asarray(array.get(queue=self.queue))

    def chunks(self, views: int, bytes_per_view: int) -> list[slice]:
        """Cut views into runs whose radiographs fit the device comfortably."""
        budget = min(_CHUNK_BYTES, self.device_budget // 8, self.largest_buffer)
        size = max(1, budget // bytes_per_view)
        # Runs of equal length: no last one of two or three views.
        count = -(-views // size)
        ends = [views * k // count for k in range(count + 1)]
        return [slice(a, b) for a, b in pairwise(ends)]

    def slabs(self, grid: VolumeGrid) -> list[slice]:
        """Cut a volume into runs of z planes that each fit one buffer and a third of the budget."""
        nz, ny, nx = grid.shape
        limit = min(self.largest_buffer, self.device_budget // 3)
        planes = limit // (4 * nx * ny)
        if planes < 1:
            raise opencl.DeviceMemoryError(
                f"one plane of {ny} x {nx} voxels takes {4 * nx * ny >> 20} MiB, the device allows "
                f"{limit >> 20} MiB: use a coarser grid or raise the memory limit"
            )
        count = -(-nz // planes)
        ends = [nz * k // count for k in range(count + 1)]
        return [slice(a, b) for a, b in pairwise(ends)]


class Volume:
    """A volume in the order (y, x, z), on the device if it fits, else in slabs on the host.

    Parameters
    ----------
    stream : Stream
        Where it lives.
    grid : VolumeGrid
        Of the whole volume.
    """

    def __init__(self, stream: Stream, grid: VolumeGrid) -> None:
        self.grid = grid
        self._stream = stream
        self._planes = stream.slabs(grid)
        self._parts: list[cl.array.Array | Floats | None] = [None] * len(self._planes)

    @property
    def planes(self) -> list[slice]:
        """Planes of the grid in each slab, bottom to top."""
        return list(self._planes)

    @property
    def slabs(self) -> list[VolumeGrid]:
        """Grid of each slab."""
        return [self.grid.slab(planes.start, planes.stop) for planes in self._planes]

    def put(self, index: int, part: cl.array.Array) -> None:
        """Keep slab `index`: where it is if the volume is one slab, else on the host."""
        self._parts[index] = part if len(self._parts) == 1 else self._stream.download(part)

    def get(self, index: int) -> cl.array.Array:
        """Slab `index` (ny, nx, planes) on the device."""
        part = self._parts[index]
        if part is None:
            raise RuntimeError(f"slab {index} was not computed")
        return part if isinstance(part, cl.array.Array) else self._stream.upload(part)

    def to_host(self) -> Floats:
        """Return the whole volume as a numpy array (z, y, x)."""
        volume = np.empty(self.grid.shape, np.float32)
        for index, planes in enumerate(self._planes):
            part = self._parts[index]
            host = self._stream.download(part) if isinstance(part, cl.array.Array) else part
            volume[planes] = np.moveaxis(np.asarray(host), 2, 0)
        return volume


class Radiographs:
    """The line integrals of a scan, binned, read in chunks.

    Binned radiographs are read from the scan once and then kept: on the host as far as half of its
    budget goes, beyond that in an unnamed temporary file. Full resolution is read where needed.

    Parameters
    ----------
    stream : Stream
        Device that bins.
    scan : Scan
        At full resolution.
    level : int
        Binning factor: 1, 2, 4 or 8.
    """

    def __init__(self, stream: Stream, scan: Scan, level: int) -> None:
        views, rows, columns = scan.shape
        self.shape = (views, rows // level, columns // level)
        self.level = level
        self._stream, self._scan = stream, scan
        self._kept = None if level == 1 else self._read_all()

    @property
    def view_bytes(self) -> int:
        """Bytes of one radiograph at this level."""
        return 4 * self.shape[1] * self.shape[2]

    def read(self, views: slice) -> Floats:
        """Radiographs `views`, float32 (n, rows, columns)."""
        if self._kept is None:
            return self._scan.read(views.start, views.stop)
        return self._kept[views]

    def _read_all(self) -> Floats:
        stream = self._stream
        kept = self._room()
        restrict = Restrict2D(stream.context)
        chunks = stream.chunks(self.shape[0], 4 * self._scan.shape[1] * self._scan.shape[2])
        name = f"reading radiographs, binned {self.level} x {self.level}"
        for views in chunks:
            stream.report(name, views.start, self.shape[0])
            images = [stream.upload(self._scan.read(views.start, views.stop))]
            for _ in range(self.level.bit_length() - 1):
                n, rows, columns = images[-1].shape
                images.append(stream.empty((n, rows // 2, columns // 2)))
                restrict(stream.queue, images[-1], images[-2])
            kept[views] = stream.download(images[-1])
        stream.report(name, self.shape[0], self.shape[0])
        return kept

    def _room(self) -> Floats:
        """Where the binned radiographs are kept."""
        if self.shape[0] * self.view_bytes <= self._stream.host_budget // 2:
            return np.empty(self.shape, np.float32)
        with tempfile.TemporaryFile() as file:  # the mapping outlives the name and the handle
            os.truncate(file.fileno(), self.shape[0] * self.view_bytes)
            return np.memmap(file, np.float32, "r+", shape=self.shape)


def views_that_see(geometry: ConeBeamGeometry, grid: VolumeGrid) -> NDArray[np.bool_]:
    """Whether each view's panel can see any of a grid.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the views.
    grid : VolumeGrid
        Volume or slab.

    Returns
    -------
    ndarray of bool, (views,)
        False only where the shadow of the grid's bounding box misses the panel.
    """
    ends = [(axis[0] - h, axis[-1] + h) for axis in grid.coordinates() for h in [grid.voxel_size]]
    corners = np.array([(x, y, z) for x in ends[0] for y in ends[1] for z in ends[2]])
    pixels = geometry.project(corners)
    behind = np.isnan(pixels).any(axis=(1, 2))  # a corner behind the source: its shadow has no end
    low = np.nanmin(pixels, axis=1, initial=np.inf)
    high = np.nanmax(pixels, axis=1, initial=-np.inf)
    size = np.array([geometry.columns, geometry.rows])
    return np.asarray(behind | ((high > -1) & (low < size)).all(axis=1))


def runs(chosen: NDArray[np.bool_]) -> Iterator[slice]:
    """Yield the runs of consecutive chosen views."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(np.int8)))
    for start, stop in edges.reshape(-1, 2):
        yield slice(int(start), int(stop))
