"""Volumes between levels, in one slab or many, and residuals of radiographs."""

import numpy as np
import pyopencl.array as cl_array
import pytest

from clra.model.grid import VolumeGrid
from clra.ops.streaming.multigrid import Residual, add_update, cropped, prolongate, restrict
from clra.ops.streaming.slab_projector import constant_volume, volume_from
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import CroppedVolume, HostPlanes
from tests.ops.images.test_pyramid import prolonged, restricted

ROUNDING = 4e-7
SHAPES = [(12, 5, 7), (13, 6, 4), (27, 9, 8)]


def tight(shape, planes):
    """A stream whose slabs hold that many planes of a grid."""
    bytes_of_plane = 4 * shape[1] * shape[2]
    stream = Stream()
    budgets = stream.budgets
    object.__setattr__(budgets, "slab", planes * bytes_of_plane)
    return stream


def random_volume(shape):
    return np.random.default_rng(3).uniform(-1, 1, shape).astype(np.float32)


@pytest.mark.parametrize("planes", [100, 5, 2, 1])
@pytest.mark.parametrize("shape", SHAPES)
def test_levels(shape, planes):
    stream = tight(shape, planes)
    grid = VolumeGrid(shape=shape, voxel_size=0.1)
    fine = random_volume(shape)
    coarse = restrict(stream, volume_from(stream, grid, fine))
    assert coarse.grid == grid.binned(2)
    np.testing.assert_allclose(coarse.to_host(), restricted(fine, (0, 1, 2)), rtol=0, atol=ROUNDING)
    host = coarse.to_host()
    again = prolongate(stream, coarse, grid)
    if planes < shape[0]:
        assert len(again.planes) > 1
    np.testing.assert_allclose(again.to_host(), prolonged(host, shape), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("shape", SHAPES)
def test_some_planes_are_those_of_the_whole(shape):
    stream, grid = tight(shape, 2), VolumeGrid(shape=shape, voxel_size=0.1)
    fine = volume_from(stream, grid, random_volume(shape))
    coarse = restrict(stream, fine)
    again = prolongate(stream, coarse, grid)
    half, whole = coarse.to_host(), again.to_host()
    for first, last in ((0, 1), (1, 4), (2, 6), (5, 6)):
        planes = slice(first, last)
        part = restrict(stream, fine, planes=planes)
        assert part.grid == coarse.grid.slab(first, last)
        np.testing.assert_array_equal(part.to_host(), half[planes])
        part = prolongate(stream, coarse, grid, planes=slice(2 * first, shape[0]))
        np.testing.assert_array_equal(part.to_host(), whole[2 * first :])


@pytest.mark.parametrize("planes", [100, 4])
def test_planes_are_cropped(planes):
    shape = (13, 3, 5)
    stream = tight(shape, planes)
    grid = VolumeGrid(shape=shape, voxel_size=0.1)
    values = random_volume(shape)
    volume = volume_from(stream, grid, values)
    part = cropped(stream, volume, 3, grid.slab(3, 11))
    np.testing.assert_array_equal(part.to_host(), values[3:11])
    part = CroppedVolume(volume, 3, grid.slab(3, 11))
    np.testing.assert_array_equal(part.to_host(), values[3:11])
    some = HostPlanes(grid.slab(5, 9))
    part.write(some, slice(2, 6))
    np.testing.assert_array_equal(some.volume, values[5:9])


@pytest.mark.parametrize("planes", [100, 4])
def test_updates_are_added_and_stay_positive(planes):
    shape = (13, 3, 5)
    stream = tight(shape, planes)
    grid = VolumeGrid(shape=shape, voxel_size=0.1)
    update = random_volume(shape)
    volume = constant_volume(stream, grid, 0.25)
    add_update(stream, volume, volume_from(stream, grid, update), 0.5)
    expected = np.maximum(0, 0.25 + 0.5 * update)
    np.testing.assert_allclose(volume.to_host(), expected, rtol=0, atol=ROUNDING)


def test_residual_leaves_out_what_is_masked_or_beyond_the_border(context, queue):
    rows, columns = 6, 9
    shape = (2, rows, columns)
    measured, simulated = random_volume((2, *shape))
    used = np.ones((rows, columns), bool)
    used[2, 3] = False
    motion = np.array([[0.0, 0.0, 1.0], [2.2, -1.4, 1.01]], np.float32)
    arrays = [cl_array.to_device(queue, a) for a in (measured, simulated, motion)]
    out = cl_array.empty(queue, shape, np.float32)
    Residual(context, used)(queue, out, *arrays)
    j, i = np.mgrid[:rows, :columns]
    expected = (measured - simulated) * used
    u = 4 + 1.01 * (i - 4) + 2.2
    v = 2.5 + 1.01 * (j - 2.5) - 1.4
    expected[1][(u >= columns - 0.5) | (v <= -0.5) | (u <= -0.5) | (v >= rows - 0.5)] = 0
    assert np.count_nonzero(expected[1]) < np.count_nonzero(expected[0])
    np.testing.assert_allclose(out.get(), expected, rtol=0, atol=ROUNDING)
