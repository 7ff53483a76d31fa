"""The core of wood: where its cells lie, and that they are hollow."""

import numpy as np
import pytest

from clra.model.grid import VolumeGrid
from clra.model.phantoms.wood import wood

RADIUS, HEIGHT = 1.45, 3.0


@pytest.fixture(scope="module")
def core():
    return wood(RADIUS, HEIGHT, seed=3)


def test_all_cells_lie_in_the_cylinder(core):
    x, y, z = np.abs(core.centres).T
    a, b, c = core.semi_axes.T
    assert (z + c <= HEIGHT / 2 + 1e-9).all()
    # The corner of the box about an ellipsoid is farther out than the ellipsoid: fibres are round.
    along_z = a == b
    assert (np.hypot(x, y)[along_z] + a[along_z] <= RADIUS + 1e-9).all()
    assert (np.hypot(x + a, y + b)[~along_z] <= RADIUS + 1e-9).all()
    assert along_z.any() and not along_z.all()


@pytest.mark.slow
def test_cells_are_hollow_and_the_mean_line_integral_is_one(core):
    size = 2 * RADIUS / 160
    grid = VolumeGrid(shape=(round(HEIGHT / size), 160, 160), voxel_size=size)
    volume = core.volume(grid)
    assert volume.min() > -1e-5 * volume.max()
    mean = volume.sum() * size**3 / (np.pi * RADIUS**2 * HEIGHT)
    assert 2 * RADIUS * mean == pytest.approx(1, rel=0.01)
    outer, inner = np.split(np.arange(len(core)), 2)
    wall = core.semi_axes[outer] - core.semi_axes[inner]
    assert np.ptp(wall, axis=1).max() < 1e-9  # as thick at the tips
    assert (wall < core.semi_axes[outer]).all()
    assert (core.attenuation[inner] == -core.attenuation[outer]).all()


def test_the_seed_chooses_the_core(core):
    assert (wood(RADIUS, HEIGHT, seed=3).centres == core.centres).all()
    assert wood(RADIUS, HEIGHT, seed=4).centres.shape != core.centres.shape
