"""The table of views that the projectors' kernels read."""

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid

ALIGNED = 16
"""Planes of which a whole number lies below the plane from which a view counts heights: kernels
treat as many voxels along z together, in vectors or work-items."""


def view_table(geometry: ConeBeamGeometry, grid: VolumeGrid) -> NDArray[np.float32]:
    """Compose in float64 what geometry.clh calls a view, (views, 28).

    The tables of all slabs of a grid differ in whole numbers only.

    Raises
    ------
    InputError
        If a voxel, or the one beyond the last, is not in front of a source.
    """
    _check_in_front(geometry, grid)
    whole = grid.whole
    index_to_world = whole.index_to_world()
    matrices = geometry.projection_matrices() @ index_to_world
    corner = (
        geometry.detector
        - geometry.source
        - 0.5 * (geometry.columns - 1) * geometry.u
        - 0.5 * (geometry.rows - 1) * geometry.v
    )
    source = (geometry.source - index_to_world[:3, 3]) / whole.voxel_size
    steps = [vector / whole.voxel_size for vector in (corner, geometry.u, geometry.v)]
    if geometry.axial:
        # Exactly, so that the rays of a column share their place in a plane to the last bit.
        matrices[:, [0, 2], 2] = 0
        steps[2][:, :2] = 0
    planes = _reference_planes(geometry, whole)
    matrices[:, :, 3] += planes[:, None] * matrices[:, :, 2]
    source[:, 2] -= planes
    heights = [grid.first - planes, -planes, whole.shape[0] - 1 - planes, 0 * planes]
    table = np.concatenate(
        [matrices.reshape(-1, 12), source, *steps, np.stack(heights, axis=1)], axis=1
    )
    return np.ascontiguousarray(table, dtype=np.float32)


def _check_in_front(geometry: ConeBeamGeometry, grid: VolumeGrid) -> None:
    """Refuse a grid that reaches behind a source."""
    matrices = geometry.projection_matrices() @ grid.index_to_world()
    ends = [(-1.0, float(n)) for n in grid.shape[::-1]]
    corners = np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(8, 3)
    depth = (matrices[:, 2, :3] @ corners.T + matrices[:, 2, 3:]).min(axis=1)
    if not depth.min() > 0:
        raise InputError(
            f"grid: it reaches behind the source of view {int(depth.argmin())}, expected every "
            "voxel and the one beyond in front of every source"
        )


def _reference_planes(geometry: ConeBeamGeometry, whole: VolumeGrid) -> NDArray[np.float64]:
    """Multiples of `ALIGNED`, one near where each view's middle ray meets the axis."""
    # What the view sees is near: float32 tells heights there, however tall the grid is.
    way = geometry.detector - geometry.source
    level = np.sum(way[:, :2] ** 2, axis=1).clip(1e-30)
    along = -np.sum(geometry.source[:, :2] * way[:, :2], axis=1) / level
    height = geometry.source[:, 2] + along * way[:, 2]
    plane = (height - whole.index_to_world()[2, 3]) / whole.voxel_size
    nearest = np.round(plane / ALIGNED)
    return np.asarray(ALIGNED * np.clip(nearest, 0, whole.shape[0] // ALIGNED))
