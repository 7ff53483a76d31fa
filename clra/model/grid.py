"""The grid of voxels on which a volume lives."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.model.sampling.field_of_view import field_radii
from clra.model.validation import positive, whole

if TYPE_CHECKING:
    from clra.model.geometry import ConeBeamGeometry

Floats = NDArray[np.float64]

# Part of a voxel by which a grid may fall short of what it covers: without it, rounding in the last
# bit adds a plane to a grid that fits exactly.
_SLACK = 1e-6


@dataclass(frozen=True, kw_only=True)
class VolumeGrid:
    """A regular grid of cubic voxels; volumes on it are arrays (z, y, x).

    The centre of voxel (k, j, i) is
    ``centre + ((i - (nx - 1) / 2), (j - (ny - 1) / 2), (k - (nz - 1) / 2)) * voxel_size``.

    Parameters
    ----------
    shape : (int, int, int)
        Voxels (nz, ny, nx).
    voxel_size : float
        Edge of a voxel [mm].
    centre : (float, float, float)
        Centre (x, y, z) of the grid [mm].

    Raises
    ------
    InputError
        If a size is not positive or a number is not finite.
    """

    shape: tuple[int, int, int]
    voxel_size: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _cut: tuple[VolumeGrid, int] | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if np.shape(self.shape) != (3,):
            raise InputError(f"shape: found {self.shape!r}, expected (nz, ny, nx)")
        size = positive("voxel_size", self.voxel_size)
        if np.shape(self.centre) != (3,) or not np.isfinite(self.centre).all():
            raise InputError(f"centre: found {self.centre!r}, expected finite (x, y, z) in mm")
        nz, ny, nx = (whole("shape", n) for n in self.shape)
        x, y, z = (float(c) for c in self.centre)
        object.__setattr__(self, "shape", (nz, ny, nx))
        object.__setattr__(self, "voxel_size", size)
        object.__setattr__(self, "centre", (x, y, z))

    def coordinates(self) -> tuple[Floats, Floats, Floats]:
        """Return the centres of the voxels along x, y and z, each 1-D [mm]."""
        x, y, z = (
            middle + (np.arange(n, dtype=np.float64) - (n - 1) / 2) * self.voxel_size
            for middle, n in zip(self.centre, self.shape[::-1], strict=True)
        )
        return x, y, z

    def index_to_world(self) -> Floats:
        """Return the (4, 4) matrix from (i, j, k, 1), the index along x, y, z, to mm."""
        matrix = np.diag([self.voxel_size] * 3 + [1.0])
        sizes = np.array(self.shape[::-1])
        matrix[:3, 3] = np.array(self.centre) - (sizes - 1) / 2 * self.voxel_size
        return matrix

    @property
    def whole(self) -> VolumeGrid:
        """The grid that this one is a slab of; itself if it is none."""
        return self if self._cut is None else self._cut[0]

    @property
    def first(self) -> int:
        """Plane of :attr:`whole` with which this grid begins."""
        return 0 if self._cut is None else self._cut[1]

    def slab(self, start: int, stop: int) -> VolumeGrid:
        """Return the grid of the planes `start` to `stop - 1` along z.

        It remembers the grid that it was cut from, so that operators compute its voxels with the
        same roundings as the whole's.

        Raises
        ------
        InputError
            If these are not one or more of the grid's planes.
        """
        nz, ny, nx = self.shape
        if not 0 <= start < stop <= nz:
            raise InputError(f"slab: found {start}:{stop}, expected 0 <= start < stop <= {nz}")
        first = self.first + start
        part = self.whole._moved((stop - start, ny, nx), self.voxel_size, (0, 0, first))
        object.__setattr__(part, "_cut", (self.whole, first))
        return part

    def binned(self, factor: int = 2) -> VolumeGrid:
        """Return the grid of voxels `factor` times larger, with the same lower corner.

        Voxels at the upper ends that fill no whole block are dropped.

        Raises
        ------
        InputError
            If `factor` is less than 1 or more than there are voxels along an axis.
        """
        factor = whole("factor", factor)
        if factor > min(self.shape):
            raise InputError(f"factor: found {factor}, expected at most {min(self.shape)}")
        nz, ny, nx = (n // factor for n in self.shape)
        return self._moved((nz, ny, nx), self.voxel_size * factor, (0, 0, 0))

    def padded(self, planes: int) -> VolumeGrid:
        """Return the grid with `planes` more planes at each end of z, fewer if negative.

        Raises
        ------
        InputError
            If no plane is left.
        """
        nz, ny, nx = self.shape
        if nz + 2 * planes < 1:
            raise InputError(f"planes: found {planes}, expected more than {-nz / 2:g}")
        return self._moved((nz + 2 * planes, ny, nx), self.voxel_size, (0, 0, -planes))

    def _moved(
        self, shape: tuple[int, int, int], voxel_size: float, start: tuple[int, int, int]
    ) -> VolumeGrid:
        """Grid whose lower corner is that of this grid's voxel `start` (i, j, k)."""
        x, y, z = (
            # Written as a difference of half widths so that an unchanged axis keeps its centre.
            middle + first * self.voxel_size + 0.5 * (new * voxel_size - old * self.voxel_size)
            for middle, first, new, old in zip(
                self.centre, start, shape[::-1], self.shape[::-1], strict=True
            )
        )
        return VolumeGrid(shape=shape, voxel_size=voxel_size, centre=(x, y, z))


def default_grid(geometry: ConeBeamGeometry) -> VolumeGrid:
    """Return the grid of the field of view.

    A voxel is a pixel seen at the axis, |u| SOD / SDD (median over the views). In x and y the grid
    covers the circle about the axis that every view sees: its radius is the distance from the axis
    to the nearer of the planes through the source and a side of the detector, SOD sin(half fan); to
    the farther one if :func:`clra.model.sampling.field_of_view.is_offset`. In z it covers the
    heights at which the axis is seen by at least half as many views as where it is seen best; of a
    parallel beam without the planes of the outermost rows.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan, at the resolution wanted.

    Returns
    -------
    VolumeGrid
        Centred on the axis.

    Raises
    ------
    InputError
        If a view does not see the axis, or sees it end on.
    """
    magnified = geometry.source_to_axis / geometry.source_to_detector
    if magnified.min() <= 0:
        raise InputError(f"view {int(magnified.argmin())}: the axis lies behind the source")
    voxel = float(np.median(np.linalg.norm(geometry.u, axis=1) * magnified))
    nearest = field_radii(geometry)
    radius = float(nearest.min())
    if not radius > 0:
        raise InputError(
            f"view {int(nearest.argmin())} does not see the rotation axis: give a grid"
        )
    low, high = _axis_range(geometry)
    across = max(1, math.ceil(2 * radius / voxel - _SLACK))
    planes = max(1, math.ceil((high - low) / voxel - _SLACK))
    if np.allclose(magnified, 1.0, rtol=1e-9):
        # Of a far source that stands for a parallel beam, the outermost rows are seen at half of
        # their planes only, where these lie before the axis.
        planes = max(1, planes - 2)
    middle = 0.5 * (low + high)
    # A scan about z = 0 gets a grid about z = 0, not about what rounding left.
    z = middle if abs(middle) > _SLACK * voxel else 0.0
    return VolumeGrid(shape=(planes, across, across), voxel_size=voxel, centre=(0.0, 0.0, z))


Interval = tuple[float | None, float | None]
Region = tuple[Interval, Interval, Interval]


def volume_grid(
    geometry: ConeBeamGeometry,
    *,
    roi: Region | None = None,
    voxel_size: float | None = None,
) -> VolumeGrid:
    """Return the grid of the field of view with another voxel, or a part of it.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan, at the resolution wanted.
    roi : ((x0, x1), (y0, y1), (z0, z1)), optional
        Region to cover [mm]; None for an end where :func:`default_grid` ends. Voxels are those of
        the whole grid.
    voxel_size : float, optional
        In mm; by default that of :func:`default_grid`.

    Returns
    -------
    VolumeGrid

    Raises
    ------
    InputError
        If the region is empty.
    """
    whole = default_grid(geometry)
    if voxel_size is not None:
        size = positive("voxel_size", voxel_size)
        nz, ny, nx = (max(1, math.ceil(n * whole.voxel_size / size - _SLACK)) for n in whole.shape)
        whole = VolumeGrid(shape=(nz, ny, nx), voxel_size=size, centre=whole.centre)
    if roi is None:
        return whole
    starts, counts = [], []
    for name, (low, high), axis in zip("xyz", roi, whole.coordinates(), strict=True):
        size, edge = whole.voxel_size, axis[0] - 0.5 * whole.voxel_size
        start = 0 if low is None else math.floor((low - edge) / size + _SLACK)
        stop = len(axis) if high is None else math.ceil((high - edge) / size - _SLACK)
        if stop <= start or (low is not None and high is not None and high <= low):
            found = f"{low} to {high} mm of {edge:.4g} to {edge + len(axis) * size:.4g} mm"
            raise InputError(f"roi: found {name} {found}, expected two places in order")
        starts.append(start)
        counts.append(stop - start)
    shape = (counts[2], counts[1], counts[0])
    return whole._moved(shape, whole.voxel_size, (starts[0], starts[1], starts[2]))


def axis_ranges(geometry: ConeBeamGeometry) -> tuple[Floats, Floats]:
    """Lowest and highest point of the axis that each view sees, each (views,) [mm].

    Raises
    ------
    InputError
        If the rows of a view run along the axis.
    """
    matrices = geometry.projection_matrices()
    ends = []
    for row in (-0.5, geometry.rows - 0.5):
        # row = (b z + b0) / (g z + g0) on the axis, solved for z
        slope = matrices[:, 1, 2] - row * matrices[:, 2, 2]
        with np.errstate(divide="ignore"):
            ends.append((row * matrices[:, 2, 3] - matrices[:, 1, 3]) / slope)
    low, high = np.sort(ends, axis=0)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise InputError("the rows of a view run along the rotation axis: give a grid")
    return low, high


def _axis_range(geometry: ConeBeamGeometry) -> tuple[float, float]:
    """Lowest and highest point of the axis that enough views see [mm]."""
    low, high = axis_ranges(geometry)
    heights = np.sort(np.concatenate([low, high]))
    middles = 0.5 * (heights[1:] + heights[:-1])
    seen = np.searchsorted(np.sort(low), middles) - np.searchsorted(np.sort(high), middles)
    # A piece narrower than rounding is no height at which anything is seen.
    wide = np.diff(heights) > 1e-12 * (heights[-1] - heights[0])
    enough = np.flatnonzero(wide & (2 * seen >= seen[wide].max()))
    return float(heights[enough[0]]), float(heights[enough[-1] + 1])
