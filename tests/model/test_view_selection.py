"""Which views see a slab."""

from dataclasses import replace

import numpy as np
import pytest

import clra
from clra.model.grid import VolumeGrid
from clra.model.view_selection import rows_that_see, runs, together, views_that_see

DETECTOR = {"source_to_axis": 50.0, "source_to_detector": 100.0, "pixel_size": 1.0}


def test_views_that_see_a_slab():
    geometry = clra.helix(50, angle_step=0.3, z_step=1.0, shape=(20, 40), **DETECTOR)
    top = VolumeGrid(shape=(4, 10, 10), voxel_size=1.0, centre=(0, 0, 20.0))
    seen = views_that_see(geometry, top)
    # At magnification 2 the detector of 20 mm sees 5 mm either side of its height on the axis.
    heights = geometry.source[:, 2]
    assert seen[np.abs(heights - 20) < 5].all()
    assert not seen[np.abs(heights - 20) > 10].any()


def test_runs():
    chosen = np.array([True, True, False, True, False, False, True])
    assert list(runs(chosen)) == [slice(0, 2), slice(3, 4), slice(6, 7)]
    assert list(runs(np.zeros(3, bool))) == []


@pytest.mark.parametrize("radius", [np.inf, 6.0])
@pytest.mark.parametrize("lean", [0.0, 0.2])
def test_rows_that_see_a_slab(radius, lean):
    """All rows that its voxels project between, and few more."""
    geometry = clra.helix(30, angle_step=0.4, z_step=0.5, shape=(40, 40), **DETECTOR)
    v = geometry.v + lean * np.linalg.norm(geometry.v, axis=1)[:, None] * geometry.source / 50
    geometry = replace(geometry, v=v)
    slab = VolumeGrid(shape=(5, 16, 16), voxel_size=1.0, centre=(0.0, 0.0, 3.0))
    x, y, z = np.meshgrid(*slab.coordinates(), indexing="ij")
    inside = x**2 + y**2 <= radius**2
    points = np.stack([x[inside], y[inside], z[inside]], axis=1)
    row = geometry.project(points)[..., 1]
    rows = rows_that_see(geometry, slab, radius)
    needed = np.clip([np.floor(row.min(axis=1)), np.floor(row.max(axis=1)) + 2], 0, 40)
    seen = needed[0] < needed[1]
    assert seen.sum() > 20
    assert (rows[seen, 0] <= needed[0][seen]).all() and (rows[seen, 1] >= needed[1][seen]).all()
    assert (rows[:, 0] % 2 == 0).all() and (rows[:, 0] < rows[:, 1]).all()
    more = rows[seen, 1] - rows[seen, 0] - (needed[1] - needed[0])[seen]
    assert more.max() <= 6


def test_views_that_need_nearly_the_same_rows_go_together():
    low = np.arange(0, 300, 3)
    rows = np.stack([low, low + 100], axis=1)
    found = list(together(rows, 500, least=4))
    assert [views.start for views, _ in found] == [0, *(views.stop for views, _ in found[:-1])]
    assert found[-1][0].stop == 100
    for views, chosen in found:
        assert (chosen.start, chosen.stop) == (rows[views, 0].min(), rows[views, 1].max())
        assert chosen.stop - chosen.start <= 125 and views.stop - views.start <= 9
    assert list(together(rows, 120, least=4)) == [(slice(0, 100), None)]
    assert len(list(together(rows, 500, least=1000))) == 1
