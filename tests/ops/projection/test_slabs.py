"""Slabs of a volume get what the whole gets, wherever it is cut and whatever lies at borders."""

from itertools import pairwise

import numpy as np
import pyopencl.array as cl_array
import pytest
from geometries import upside_down
from projector_cases import (
    DETECTOR,
    all_forms,
    assert_close,
    back,
    forms,
    forward,
    numbers,
    on_device,
    perturbed,
)

from clra import VolumeGrid, helix
from clra.ops.projection.coverage import Coverage, around
from clra.ops.projection.projector import BackProjector

# Of the largest value. GPUs sum views in runs that depend on the slab. Forward projection adds up
# what rays collect in each slab.
RUNS, RAYS, ADJOINT = 5e-7, 3e-6, 2e-5

TALL = helix(40, angle_step=0.5, z_step=1.4, **DETECTOR | {"shape": (40, 37), "pixel_size": 1.0})
GEOMETRIES = {
    "helix": TALL,
    "v down": upside_down(TALL),
    "tilted": perturbed(TALL, 1.0),
    "coarse pixels": helix(
        40, angle_step=0.5, z_step=1.4, **DETECTOR | {"shape": (9, 8), "pixel_size": 6.0}
    ),
}
geometries = pytest.mark.parametrize("geometry", GEOMETRIES.values(), ids=GEOMETRIES)
GRID = VolumeGrid(shape=(101, 15, 17), voxel_size=0.6, centre=(0.1, -0.2, 0.3))
CUTS = list(pairwise((0, 5, 37, 64, 65, 101)))


def test_a_slab_remembers_the_whole():
    slab = GRID.slab(7, 90).slab(3, 20)
    assert (slab.whole, slab.first) == (GRID, 10)
    assert (GRID.whole, GRID.first) == (GRID, 0)
    assert slab == GRID.slab(10, 27)
    plain = VolumeGrid(shape=slab.shape, voxel_size=slab.voxel_size, centre=slab.centre)
    assert slab == plain
    assert plain.whole is plain


@geometries
@all_forms
def test_slabs_of_a_back_projection_are_the_wholes(queue, geometry, form):
    """To the bit on CPUs: no voxel at a detector's border is seen in one and not in the other."""
    projections = numbers(geometry.views, *geometry.shape) - 0.5
    whole = back(queue, geometry, GRID, projections)
    slabs = np.concatenate([back(queue, geometry, GRID.slab(*cut), projections) for cut in CUTS])
    if form.on_cpu:
        assert np.array_equal(slabs, whole)
    assert_close(slabs, whole, RUNS)


@pytest.mark.parametrize("name", ["helix", "tilted"])
@forms
def test_slabs_of_projections_and_their_adjoint_add_up(queue, name, form):
    geometry = GEOMETRIES[name]
    volume, projections = numbers(*GRID.shape), numbers(geometry.views, *geometry.shape)
    cuts = [(0, 37), (37, 101)]
    parts = [forward(queue, geometry, GRID.slab(a, b), volume[a:b]) for a, b in cuts]
    assert_close(sum(parts), forward(queue, geometry, GRID, volume), RAYS)
    slabs = [back(queue, geometry, GRID.slab(*cut), projections, matched=True) for cut in cuts]
    whole = back(queue, geometry, GRID, projections, matched=True)
    assert_close(np.concatenate(slabs), whole, ADJOINT)


@pytest.mark.parametrize("name", ["helix", "tilted"])
def test_on_cpus_views_in_chunks_give_the_same_bits(queue, name):
    geometry = GEOMETRIES[name]
    projections = numbers(geometry.views, *geometry.shape) - 0.5
    nz, ny, nx = GRID.shape
    found = []
    for cuts in (0, 40), (0, 3, 17, 40):
        operator = BackProjector(queue.context, geometry, GRID, volume_order="yxz")
        volume = cl_array.zeros(queue, (ny, nx, nz), np.float32)
        for start, stop in pairwise(cuts):
            part = on_device(queue, projections[start:stop])
            operator(queue, volume, part, views=slice(start, stop), accumulate=True)
        found.append(volume.get())
    assert np.array_equal(*found)


@geometries
def test_slabs_are_divided_by_the_same_number_of_views(context, queue, geometry):
    def divided(grid: VolumeGrid, first: int, planes: int) -> np.ndarray:
        coverage = Coverage(context, geometry, grid, np.linspace(1, 2, geometry.rows))
        coverage.compute(queue)
        volume = cl_array.to_device(queue, np.ones((planes, *grid.shape[1:]), np.float32))
        coverage.normalise(queue, volume, 1.0, first=first).wait()
        return volume.get()

    parts = []
    for start, stop in CUTS:
        near = around(slice(start, stop), GRID.shape[0])
        parts.append(divided(GRID.slab(near.start, near.stop), start - near.start, stop - start))
    assert np.array_equal(np.concatenate(parts), divided(GRID, 0, GRID.shape[0]))
