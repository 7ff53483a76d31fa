"""What the projectors share: views on the device, and the order that they want data in.

Kernels read projections as (view, column, row) and volumes as (y, x, z), see geometry.clh. A
:class:`Layout` turns the caller's arrays into those and back, in scratch memory of its own.
"""

from collections.abc import Iterator, Sequence

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray
from pyopencl.array import Array

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.ops.projection.transpose import Planes, Transpose
from clra.ops.projection.view_arguments import check_geometry, successive
from clra.ops.projection.view_table import ALIGNED, view_table
from clra.ops.runtime.buffers import Allocator, Scratch, check_array, check_queue, to_device, within
from clra.ops.runtime.profile import DeviceProfile, profile_of

_PAD = 24  # as in geometry.clh
_PIECE = 32  # the most that kernels read from where they are, past the last line's end

_LEAST_VIEWS = 8


class Layout:
    """Views of a geometry on the device, with scratch for projections and a volume.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    geometry : ConeBeamGeometry
        Of the projections.
    grid : VolumeGrid
        Of the volume.
    volume_order : {"zyx", "yxz"}
        Order of the caller's volume.
    allocator : callable, optional
        Gives the scratch memory, see :class:`clra.ops.runtime.buffers.Scratch`.
    scratch_limit : int, optional
        Bytes of scratch for projections; fewer views are treated at a time, at least one.
    weighs : bool
        Whether projections are changed before they are used, so that a GPU too needs scratch for
        them; CPUs always do.
    images : int
        Projections that a view gives at a time.

    Attributes
    ----------
    profile : DeviceProfile
        Of the context.
    lanes : {1, 8, 16}
        Its ``projector_lanes``.
    columnar : bool
        Whether the kernels for v parallel to z apply, where besides no ray is steep.
    leaning : bool
        Whether no ray is steep and v is within 45 degrees of z.
    heights : ndarray
        (views, 2) voxels along z that each view sees: the first, and one past the last.
    steep : bool
        Whether rays may advance fastest along z.
    table : Array
        (views, 28), see geometry.clh.
    before : int
        Planes of the whole grid between the last that is a multiple of `ALIGNED` and this grid.
    sizes : tuple of int
        nx, ny, nz.
    detector : tuple of int
        Columns, rows and elements of a padded line.
    scratch_bytes : int
        Most bytes of scratch memory that it takes.
    last : list of cl.Event
        What the next call has to wait for, because it uses the same scratch.
    """

    def __init__(
        self,
        context: cl.Context,
        geometry: ConeBeamGeometry,
        grid: VolumeGrid,
        volume_order: str,
        allocator: Allocator | None = None,
        scratch_limit: int | None = None,
        *,
        weighs: bool = False,
        images: int = 1,
    ) -> None:
        self.profile = profile = profile_of(context)
        self.context = context
        self.grid = grid
        self.lanes = profile.projector_lanes
        self.sizes = grid.shape[::-1]
        self.before = grid.first % ALIGNED
        self.detector = (geometry.columns, geometry.rows, _pitch(geometry.rows))
        self._view_shape = view_shape(self.profile, geometry.shape)
        self._view_elements = self._view_shape[0] * self._view_shape[1]
        self.last: list[cl.Event] = []
        self._views = geometry.views
        self.volume_order = volume_order
        self._volume_shape = volume_shape(grid, volume_order)
        self._bytes = within(profile.projector_bytes, scratch_limit)
        self._least = _LEAST_VIEWS if scratch_limit is None else 1
        self._transpose = Transpose(context)
        self._lines: Array | None = None
        self._volume: Array | None = None
        self._memory = Scratch(context, allocator)
        self._images = images
        lines = images * min(geometry.views, self._most) * self._view_elements
        self.scratch_bytes = 4 * (lines + _PIECE) if profile.on_cpu or weighs else 0
        if volume_order == "zyx":
            self.scratch_bytes += 4 * grid.shape[0] * grid.shape[1] * grid.shape[2]
        self.set_geometry(geometry)

    def set_geometry(self, geometry: ConeBeamGeometry) -> None:
        """Take other vectors of the same views and detector."""
        check_geometry(geometry, (self._views, self.detector[1], self.detector[0]))
        self.table = to_device(self.context, view_table(geometry, self.grid))
        self.steep = _steep(geometry)
        self.columnar = self.profile.columns and geometry.axial and not self.steep
        self.leaning = not self.steep and _leaning(geometry)
        self.heights = heights(geometry, self.grid)

    def check(
        self,
        queue: cl.CommandQueue,
        names: tuple[str, str],
        volume: Array,
        projections: Array,
        views: slice | None,
    ) -> tuple[int, int]:
        """Refuse what does not fit; first of the views, and one past the last."""
        start, stop = successive(views, self._views)
        check_queue(queue, self.context)
        columns, rows, _ = self.detector
        check_array(names[0], volume, self._volume_shape, context=self.context)
        shape = (stop - start, rows, columns)
        check_array(names[1], projections, shape, context=self.context)
        return start, stop

    @property
    def _most(self) -> int:
        """Most views that one launch treats."""
        images = max(self._least, self._bytes // (4 * self._view_elements))
        return max(1, images // self._images)

    def batches(self, count: int) -> Iterator[tuple[int, int]]:
        """Cut `count` views into runs that fit the scratch, the longest first: it allocates it."""
        runs = -(-count // self._most)
        for run in range(runs):
            yield -(-count * run // runs), -(-count * (run + 1) // runs)

    def gather_projections(
        self, queue: cl.CommandQueue, projections: Array, wait_for: Sequence[cl.Event]
    ) -> tuple[Array, cl.Event]:
        """Projections in the kernels' order, padded, in scratch."""
        lines = self.scratch_projections(len(projections))
        columns, rows, pitch = self.detector
        event = self._transpose(
            queue,
            Planes(lines, (columns + 1) * pitch, pitch, columns + 1, pitch),
            Planes(projections, rows * columns, columns, rows, columns),
            len(projections),
            before=_PAD,
            wait_for=wait_for,
        )
        return lines, event

    def scatter_projections(
        self,
        queue: cl.CommandQueue,
        projections: Array,
        accumulate: bool,
        wait_for: Sequence[cl.Event],
        skipped: int = 0,
    ) -> cl.Event:
        """From scratch, behind the lines of `skipped` views, to the caller's projections."""
        columns, rows, pitch = self.detector
        lines = self.scratch_projections(skipped + len(projections))[skipped:, :, _PAD:]
        return self._transpose(
            queue,
            Planes(projections, rows * columns, columns, rows, columns),
            Planes(lines, (columns + 1) * pitch, pitch, columns, rows),
            len(projections),
            accumulate=accumulate,
            wait_for=wait_for,
        )

    def scratch_projections(self, count: int) -> Array:
        """Lines of `count` views, (count, columns + 1, pitch), on a GPU (count, rows, columns)."""
        if self._lines is None or len(self._lines) < count:
            size = count * self._view_elements
            flat = self._memory.empty((size + _PIECE,))
            self._lines = flat[:size].reshape(count, *self._view_shape)
        lines: Array = self._lines[:count]
        return lines

    def gather_volume(
        self, queue: cl.CommandQueue, volume: Array, wait_for: Sequence[cl.Event]
    ) -> tuple[Array, Sequence[cl.Event]]:
        """Volume in the kernels' order."""
        if self.volume_order == "yxz":
            return volume, wait_for
        nx, ny, nz = self.sizes
        columns = self.scratch_volume(volume)
        event = self._transpose(
            queue,
            Planes(columns, nx * nz, nz, nx, nz),
            Planes(volume, nx, nx * ny, nz, nx),
            ny,
            wait_for=wait_for,
        )
        return columns, [event]

    def scatter_volume(
        self, queue: cl.CommandQueue, volume: Array, accumulate: bool, wait_for: Sequence[cl.Event]
    ) -> cl.Event:
        """From scratch to the caller's volume, in the order (z, y, x)."""
        nx, ny, nz = self.sizes
        columns = self.scratch_volume(volume)
        return self._transpose(
            queue,
            Planes(volume, nx, nx * ny, nz, nx),
            Planes(columns, nx * nz, nz, nx, nz),
            ny,
            accumulate=accumulate,
            wait_for=wait_for,
        )

    def scratch_volume(self, volume: Array) -> Array:
        """Where kernels write a volume: the caller's own in the order (y, x, z)."""
        if self.volume_order == "yxz":
            return volume
        if self._volume is None:
            nx, ny, nz = self.sizes
            self._volume = self._memory.empty((ny, nx, nz))
        return self._volume


def _pitch(rows: int) -> int:
    """Elements of a padded line."""
    return 16 * -(-(rows + 2 * _PAD) // 16)


def view_shape(profile: DeviceProfile, shape: tuple[int, int]) -> tuple[int, int]:
    """Shape of a view of (rows, columns) in scratch: padded lines on CPUs."""
    return (shape[1] + 1, _pitch(shape[0])) if profile.on_cpu else shape


def volume_shape(grid: VolumeGrid, order: str) -> tuple[int, int, int]:
    """Shape of a volume whose axes are in that order.

    Raises
    ------
    InputError
        If it is neither "zyx" nor "yxz".
    """
    if order not in ("zyx", "yxz"):
        raise InputError(f"volume_order: found {order!r}, expected 'zyx' or 'yxz'")
    nz, ny, nx = grid.shape
    return (nz, ny, nx) if order == "zyx" else (ny, nx, nz)


def heights(geometry: ConeBeamGeometry, grid: VolumeGrid) -> NDArray[np.int64]:
    """Voxels along z that each view sees, (views, 2): the first, and one past the last.

    Those of axial views; of others all.
    """
    nz, ny, nx = grid.shape
    if not geometry.axial:
        return np.tile([0, nz], (geometry.views, 1))
    matrices = geometry.projection_matrices() @ grid.index_to_world()
    # The height at which a ray of row r passes is linear along x and y: corners are outermost.
    b, g = matrices[:, 1, :, None], matrices[:, 2, :, None, None]
    x, y = np.array([0.0, nx - 1, 0, nx - 1]), np.array([0.0, 0, ny - 1, ny - 1])
    row = np.array([0.0, geometry.rows - 1])[:, None]
    depth = g[:, 0] * x + g[:, 1] * y + g[:, 3]
    at = (row * depth - (b[:, 0] * x + b[:, 1] * y + b[:, 3])[:, None]) / b[:, 2, None]
    low = np.clip(np.floor(at.min(axis=(1, 2))), 0, nz)
    high = np.clip(np.ceil(at.max(axis=(1, 2))) + 1, 0, nz)
    return np.stack([low, high], axis=1).astype(np.int64)


def _leaning(geometry: ConeBeamGeometry) -> bool:
    """Whether every view's rows follow each other within 45 degrees of z."""
    level = np.linalg.norm(geometry.v[:, :2], axis=1)
    return bool(np.all(np.abs(geometry.v[:, 2]) > level))


def _steep(geometry: ConeBeamGeometry) -> bool:
    """Whether any ray may advance faster along z than along x and y."""
    across, down = (0.5 * (n - 1) for n in (geometry.columns, geometry.rows))
    centre = geometry.detector - geometry.source
    corners = np.stack(
        [centre + a * across * geometry.u + b * down * geometry.v for a in (-1, 1) for b in (-1, 1)]
    )
    # Over the detector, |z| is at most that of a corner, the larger of |x| and |y| at least the
    # distance from the axis of z over the root of 2, and that distance at least its part along the
    # way to the centre.
    level = centre[:, :2] / np.linalg.norm(centre[:, :2], axis=1, keepdims=True).clip(1e-30)
    nearest = np.sum(corners[:, :, :2] * level, axis=2).min(axis=0)
    highest = np.abs(corners[:, :, 2]).max(axis=0)
    return bool(np.any(1.0001 * highest > nearest / np.sqrt(2)))
