"""Which views see a slab."""

import numpy as np

import clra
from clra.model.grid import VolumeGrid
from clra.model.view_selection import runs, views_that_see

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
