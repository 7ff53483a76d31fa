"""What a resolution's registrations find, against a scan in which nothing moved, in closed form."""

import math

import numpy as np
import pyopencl.array as cl_array
import pytest

import clra
from clra.methods.alignment.level import Level
from clra.methods.alignment.options import Solver
from clra.methods.alignment.region import Region
from clra.methods.reconstruction.fitted_fbp import reprojections
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.ops.projection.projector import ForwardProjector
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.slab_projector import volume_from
from clra.ops.streaming.stream import Stream

VIEWS = 121
SAME = 1e-5  # of the largest magnitude
BODY = Ellipsoids(
    [[0, 0, 0], [0.3, 0.2, 0.1], [-0.2, 0.1, -0.4]],
    [[0.7, 0.7, 0.9], [0.2, 0.2, 0.15], [0.2, 0.3, 0.1]],
    [1.0, 0.7, 0.5],
)
GRID = VolumeGrid(shape=(88, 80, 84), voxel_size=0.025, centre=(0.01, 0.0, 0.05))


@pytest.fixture(scope="module")
def scan():
    """A helix that looks 25 degrees up and down, where ramp-FBP is far off."""
    geometry = clra.helix(
        VIEWS,
        angle_step=math.radians(6.1),
        z_step=0.02,
        source_to_axis=3.0,
        source_to_detector=6.0,
        pixel_size=0.05,
        shape=(115, 95),
    )
    return clra.Scan(BODY.line_integrals(geometry), geometry)


def _found(scan, solver, memory=None):
    level = Level(Stream(max_device_memory=memory), scan, Region(GRID, GRID), solver, 2)
    options = {"valid_views": np.ones(VIEWS, np.bool_), "first": False, "magnification": True}
    options |= {"measure": True, "title": "test"}
    motion, still = Motion.identity(VIEWS), np.ones(VIEWS)
    found = [level.residual_motion(motion, still, **options).motion for _ in range(2)]
    # Once it is known, the bias is the same.
    assert found[0] == found[1]
    return found[0].normalised()


def _size(motion):
    return np.array(
        [np.sqrt(np.mean(x**2)) for x in (motion.shift_u, motion.shift_v, motion.magnification - 1)]
    )


def test_what_is_found_where_nothing_moved_is_found_out(scan):
    left = _size(_found(scan, Solver()))
    biased = _size(_found(scan, Solver(unbias=False)))
    assert (left < 0.6 * biased).all()


def test_slabs_and_chunks_change_nothing(scan):
    whole, cut = (_found(scan, Solver(), memory) for memory in (None, 2 << 20))
    assert np.abs(whole.shift_u - cut.shift_u).max() < 1e-3
    assert np.abs(whole.shift_v - cut.shift_v).max() < 1e-3


@pytest.mark.parametrize("memory", [None, 1 << 19])
def test_reprojections_are_projections(scan, memory):
    stream = Stream(max_device_memory=memory)
    grid, geometry = GRID.binned(2), scan.geometry.binned(2)
    values = BODY.volume(grid).astype(np.float32)
    volume = volume_from(stream, grid, values)
    assert (len(volume.planes) > 1) == (memory is not None)
    measured = Radiographs(stream, scan, 2)
    used = np.ones((57, 47), np.bool_)
    used[5, 7] = False
    made = reprojections(stream, volume, geometry, 2, "test")
    more = reprojections(stream, volume, geometry, 2, "test", lacking_of=(measured, used))
    assert (made.shape, made.level) == ((VIEWS, 57, 47), 2)
    project = ForwardProjector(stream.context, geometry, grid)
    whole = cl_array.zeros(stream.queue, made.shape, np.float32)
    project(stream.queue, whole, cl_array.to_device(stream.queue, values)).wait()
    expected = whole.get()
    assert np.abs(made[3:VIEWS] - expected[3:]).max() < SAME * expected.max()
    lacking = np.where(used, measured[0:VIEWS] - expected, 0.0)
    assert np.abs(more[0:VIEWS] - lacking).max() < SAME * expected.max()
