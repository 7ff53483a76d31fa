"""Views that see a voxel, against counting them in float64."""

import math

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest

import clra
from clra.model.grid import VolumeGrid
from clra.model.sampling.field_of_view import field_radii
from clra.model.sampling.ray_weights import ray_weights
from clra.ops.filtering.ramp import taper
from clra.ops.projection.coverage import Coverage

DETECTOR = {
    "source_to_axis": 60.0,
    "source_to_detector": 100.0,
    "pixel_size": 1.0,
    "shape": (38, 45),
}
# Of the largest W: what linear interpolation between coarse voxels costs.
TOLERANCE = 0.04


def _counted(geometry, grid, row_weight):
    x, y, z = grid.coordinates()
    points = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1).reshape(-1, 3)
    column, row = np.moveaxis(geometry.project(points), 2, 0)
    on = (column >= 0) & (column <= geometry.columns - 1) & (row >= 0) & (row <= geometry.rows - 1)
    weight = np.interp(row, np.arange(geometry.rows), row_weight)
    return np.where(on, weight, 0.0).sum(axis=0).reshape(grid.shape)


def _normalised(
    context, queue, geometry, grid, row_weight, order="zyx", first=0, planes=None, **more
):
    coverage = Coverage(context, geometry, grid, row_weight, **more)
    coverage.compute(queue)
    nz, ny, nx = grid.shape
    nz = planes or nz
    shape = (nz, ny, nx) if order == "zyx" else (ny, nx, nz)
    volume = cl.array.to_device(queue, np.ones(shape, np.float32))
    coverage.normalise(queue, volume, 1.0, first=first, volume_order=order).wait()
    return volume.get() if order == "zyx" else np.moveaxis(volume.get(), 2, 0)


def _smooth_weight(rows):
    return 0.1 + np.sin(np.pi * (np.arange(rows) + 0.5) / rows)


@pytest.mark.parametrize("order", ["zyx", "yxz"])
def test_views_are_counted(context, queue, order):
    geometry = clra.helix(90, angle_step=math.radians(11), z_step=0.3, **DETECTOR)
    grid = VolumeGrid(shape=(31, 18, 21), voxel_size=0.7, centre=(0.4, -0.3, 1.0))
    weight = _smooth_weight(geometry.rows)
    expected = _counted(geometry, grid, weight)
    inverse = _normalised(context, queue, geometry, grid, weight, order)
    inside = inverse > 0
    assert inside.mean() > 0.6
    error = np.abs(1 / inverse[inside] - expected[inside])
    assert error.max() < TOLERANCE * expected.max()


@pytest.mark.parametrize(
    ("rows", "planes"), [(1, 1), (2, 1), (3, 2), (3, 3), (5, 5), (9, 9), (38, 1), (38, 2), (38, 5)]
)
def test_all_views_count_where_grid_or_detector_is_thin(context, queue, rows, planes):
    geometry = clra.circular(60, **(DETECTOR | {"shape": (rows, 45)}))
    grid = VolumeGrid(shape=(planes, 17, 9), voxel_size=0.6)
    middle = _normalised(context, queue, geometry, grid, np.ones(rows))[planes // 2]
    assert np.allclose(1 / middle, 60, rtol=1e-5)


def test_a_plane_at_the_end_of_the_field_of_view_is_counted(context, queue):
    geometry = clra.circular(60, **DETECTOR)
    grid = VolumeGrid(shape=(1, 18, 21), voxel_size=0.6, centre=(0.4, -0.3, 9.1))
    weight = _smooth_weight(geometry.rows)
    expected = _counted(geometry, grid, weight)
    assert 0.1 * weight.max() * 60 < expected.min()
    found = 1 / _normalised(context, queue, geometry, grid, weight)
    assert np.abs(found - expected).max() < TOLERANCE * 60 * weight.max()


def test_views_count_by_their_weight(context, queue):
    geometry = clra.helix(50, angle_step=math.radians(23), z_step=0.3, **DETECTOR)
    grid = VolumeGrid(shape=(19, 10, 11), voxel_size=1.1)
    weight = np.random.default_rng(0).integers(0, 3, geometry.views)
    twice = np.repeat(np.arange(geometry.views), weight)  # as often as it weighs
    rows = _smooth_weight(geometry.rows)
    volume = _normalised(context, queue, geometry, grid, rows, view_weight=weight)
    expected = _normalised(context, queue, geometry.subset(twice), grid, rows)
    assert np.allclose(volume[expected > 0], expected[expected > 0], rtol=1e-5)


def test_with_ray_weights_the_part_on_the_rows_counts(context, queue):
    geometry = clra.circular(120, arc=math.radians(215), **(DETECTOR | {"shape": (22, 45)}))
    grid = VolumeGrid(shape=(27, 34, 35), voxel_size=0.4, centre=(0.3, -0.5, 1.0))
    rays, rows = ray_weights(geometry), taper(geometry.rows, 0.5)
    x, y, z = grid.coordinates()
    points = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1).reshape(-1, 3)
    column, row = np.moveaxis(geometry.project(points), 2, 0)
    beside = (column >= 0) & (column <= geometry.columns - 1)
    table = rays.at(np.arange(geometry.columns))
    weight = np.stack([np.interp(c, np.arange(45), t) for c, t in zip(column, table, strict=True)])
    weight = np.where(beside, weight, 0.0)
    on = (row >= 0) & (row <= geometry.rows - 1)
    seen = np.where(on, weight * np.interp(row, np.arange(22), rows), 0.0)
    expected = (seen.sum(axis=0) / weight.sum(axis=0)).reshape(grid.shape)
    inverse = _normalised(context, queue, geometry, grid, rows, ray_weights=rays)
    inside = inverse > 0
    assert inside.mean() > 0.6
    assert np.abs(1 / inverse[inside] - expected[inside]).max() < TOLERANCE


def test_a_slab_is_part_of_the_whole(context, queue):
    geometry = clra.helix(50, angle_step=0.2, z_step=0.5, **DETECTOR)
    grid = VolumeGrid(shape=(29, 10, 11), voxel_size=0.9)
    weight = np.ones(geometry.rows)
    whole = _normalised(context, queue, geometry, grid, weight)
    part = _normalised(context, queue, geometry, grid, weight, first=13, planes=9)
    assert np.array_equal(part, whole[13:22])


def test_outside_the_circle_that_all_views_see_is_zero(context, queue):
    geometry = clra.circular(40, **DETECTOR)
    radius = field_radii(geometry).min()
    grid = VolumeGrid(shape=(3, 61, 61), voxel_size=2.4 * radius / 61)
    volume = _normalised(context, queue, geometry, grid, np.ones(geometry.rows))
    x, y, _ = grid.coordinates()
    distance = np.hypot(y[:, None], x[None])
    assert (volume[1][distance < 0.98 * radius] > 0).all()
    assert not volume[1][distance > radius].any()


def test_one_view_moved_far_does_not_narrow_the_field(context, queue):
    geometry = clra.circular(100, **DETECTOR)
    shift = np.zeros(100)
    shift[31] = 15.0
    moved = geometry.with_motion(clra.Motion(shift_u=shift, shift_v=0 * shift))
    grid = VolumeGrid(shape=(3, 41, 41), voxel_size=0.6)
    weight = np.ones(geometry.rows)
    still, now = (_normalised(context, queue, g, grid, weight) > 0 for g in (geometry, moved))
    assert now.sum() > 0.98 * still.sum()


def test_what_no_view_sees_is_zero(context, queue):
    geometry = clra.circular(5, **DETECTOR)
    grid = VolumeGrid(shape=(4, 3, 3), voxel_size=1.0, centre=(0, 0, 80.0))
    assert not _normalised(context, queue, geometry, grid, np.ones(geometry.rows)).any()


def test_weights_must_fit_the_detector(context):
    with pytest.raises(ValueError, match=r"row_weight: found \(7,\), expected \(38,\)"):
        Coverage(
            context,
            clra.circular(5, **DETECTOR),
            VolumeGrid(shape=(2, 2, 2), voxel_size=1.0),
            np.ones(7),
        )


def test_weights_must_fit_the_views(context):
    with pytest.raises(ValueError, match=r"view_weight: found \(7,\), expected 5 finite numbers"):
        Coverage(
            context,
            clra.circular(5, **DETECTOR),
            VolumeGrid(shape=(2, 2, 2), voxel_size=1.0),
            np.ones(38),
            view_weight=np.ones(7),
        )


def test_a_volume_of_another_grid_is_refused(context, queue):
    geometry = clra.circular(5, **DETECTOR)
    coverage = Coverage(context, geometry, VolumeGrid(shape=(5, 6, 7), voxel_size=1.0), np.ones(38))
    coverage.compute(queue)
    with pytest.raises(ValueError, match=r"volume: found shape \(5, 7, 6\)"):
        coverage.normalise(queue, cl.array.zeros(queue, (5, 7, 6), np.float32), 1.0)
