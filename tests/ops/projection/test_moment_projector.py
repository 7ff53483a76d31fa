"""The two integrals along a ray against float64 sums and the closed form of a sphere."""

import math

import numpy as np
import pyopencl.array as cl_array
import pytest
from projector_cases import GRID, all_forms, assert_close, geometries, numbers, on_device

from clra import VolumeGrid, circular
from clra.model.trajectory import helix
from clra.ops.projection.moment_projector import MomentProjector
from clra.ops.projection.projector import ForwardProjector

from .test_projector import joseph

SPHERE = 8e-3  # root mean square over the largest


def moments(queue, geometry, grid, volume):
    """Both integrals."""
    operator = MomentProjector(queue.context, geometry, grid)
    out = [
        cl_array.empty(queue, (geometry.views, *geometry.shape), np.float32).fill(np.nan)
        for _ in range(2)
    ]
    operator(queue, *out, on_device(queue, volume)).wait()
    return [one.get() for one in out]


@all_forms
@geometries
def test_moments_against_float64(queue, geometry, form):
    volume = numbers(*GRID.shape)
    found = moments(queue, geometry, GRID, volume)
    for integral, over_depth in zip(found, (False, True), strict=True):
        expected = joseph(geometry, GRID, over_depth=over_depth) @ volume.ravel()
        assert_close(integral, expected.reshape(integral.shape))


def test_moments_of_a_sphere(queue):
    """A chord from g1 to g2 gives its length, and |ray| log(g2 / g1) over the depth."""
    radius, centre = 8.0, np.array([1.5, -2.0, 0.7])
    geometry = circular(
        5,
        source_to_axis=60.0,
        source_to_detector=100.0,
        pixel_size=0.8,
        shape=(41, 47),
    )
    grid = VolumeGrid(shape=(120, 120, 120), voxel_size=0.2, centre=tuple(centre))
    x, y, z = (a - c for a, c in zip(grid.coordinates(), centre, strict=True))
    distance = np.sqrt(z[:, None, None] ** 2 + y[:, None] ** 2 + x**2)
    volume = np.clip(0.5 + (radius - distance) / 0.2, 0, 1).astype(np.float32)
    operator = MomentProjector(queue.context, geometry, grid)
    out = [cl_array.empty(queue, (5, *geometry.shape), np.float32) for _ in range(2)]
    operator(queue, *out, on_device(queue, volume)).wait()
    column = np.arange(geometry.columns) - (geometry.columns - 1) / 2
    row = np.arange(geometry.rows) - (geometry.rows - 1) / 2
    source, detector, u, v = (a[:, None, None] for a in np.split(geometry.to_astra(), 4, axis=1))
    ray = detector - source + row[:, None, None] * v + column[:, None] * u
    square = np.sum(ray**2, axis=-1)
    nearest = np.sum(ray * (centre - source), axis=-1) / square
    height = np.sum((source + nearest[..., None] * ray - centre) ** 2, axis=-1)
    half = np.sqrt(np.clip(radius**2 - height, 0, None) / square)
    chord = 2 * half * np.sqrt(square)
    over_depth = np.sqrt(square) * np.log((nearest + half) / (nearest - half))
    for found, expected in zip(out, (chord, over_depth), strict=True):
        error = math.sqrt(np.mean((found.get() - expected) ** 2)) / expected.max()
        assert error < SPHERE


def test_first_moment_is_the_forward_projection_and_slabs_add_up(queue):
    geometry = helix(
        7,
        angle_step=0.9,
        z_step=2.1,
        source_to_axis=60.0,
        source_to_detector=100.0,
        pixel_size=2.3,
        shape=(15, 19),
    )
    volume = numbers(*GRID.shape)
    plain = cl_array.empty(queue, (7, *geometry.shape), np.float32)
    ForwardProjector(queue.context, geometry, GRID)(queue, plain, on_device(queue, volume)).wait()
    whole, over = (cl_array.empty_like(plain) for _ in range(2))
    operator = MomentProjector(queue.context, geometry, GRID, scratch_limit=1)
    operator(queue, whole, over, on_device(queue, volume)).wait()
    assert np.array_equal(whole.get(), plain.get())
    sums = [cl_array.empty_like(plain) for _ in range(2)]
    for start, stop in ((0, 8), (8, 19)):
        slab = MomentProjector(queue.context, geometry, GRID.slab(start, stop))
        slab(queue, *sums, on_device(queue, volume[start:stop]), accumulate=start > 0).wait()
    assert_close(sums[0].get(), whole.get())
    assert_close(sums[1].get(), over.get())


@pytest.mark.parametrize("views", [slice(2, 5), slice(6, 7)])
def test_some_views(queue, views):
    geometry = circular(
        7, source_to_axis=60.0, source_to_detector=100.0, pixel_size=2.3, shape=(15, 19)
    )
    volume = on_device(queue, numbers(*GRID.shape))
    operator = MomentProjector(queue.context, geometry, GRID)
    whole = [cl_array.empty(queue, (7, 15, 19), np.float32) for _ in range(2)]
    operator(queue, *whole, volume).wait()
    some = [cl_array.empty(queue, (views.stop - views.start, 15, 19), np.float32) for _ in range(2)]
    operator(queue, *some, volume, views=views).wait()
    for found, expected in zip(some, whole, strict=True):
        assert np.array_equal(found.get(), expected.get()[views])
