"""Slices for the report: the method, and what the correction makes of them."""

import math

import numpy as np
import pytest

import clra
from clra.app.report.slices import Slicer
from clra.model.grid import VolumeGrid
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.ops.streaming.stream import Stream

DETECTOR = {
    "source_to_axis": 3.0,
    "source_to_detector": 6.0,
    "pixel_size": 0.034,
    "shape": (77, 133),
}
BODY = Ellipsoids(
    [[0, 0, 0], [0.3, 0.2, 0.05], [-0.35, -0.1, -0.1]],
    [[0.85, 0.8, 1.2], [0.25, 0.2, 0.3], [0.2, 0.25, 0.2]],
    [1.0, 0.5, -0.6],
)


def moved(geometry):
    random = np.random.default_rng(5)
    motion = clra.Motion(
        shift_u=random.uniform(-4, 4, geometry.views),
        shift_v=random.uniform(-2, 2, geometry.views),
        magnification=random.uniform(0.98, 1.02, geometry.views),
    )
    return clra.Scan(BODY.line_integrals(geometry.with_motion(motion)), geometry, truth=motion)


def errors(scan, level, method):
    slicer = Slicer(Stream(), scan, scan.truth, level)
    assert method in slicer.method
    nz, _, nx = slicer.grid.shape
    size = slicer.grid.voxel_size
    across = slicer.grid.slab(nz // 2, nz // 2 + 1)
    along = VolumeGrid(shape=(nz, 1, nx), voxel_size=size, centre=slicer.grid.centre)
    for plane in (across, along):
        truth = BODY.volume(plane)
        truth = truth[0] if len(truth) == 1 else truth[::-1, 0]
        images = slicer.images(plane)
        assert {image.shape for image in images} == {truth.shape}
        # Where the helix holds no pi-interval there is nothing.
        held = (images[1] != 0) & (images[0] != 0)
        assert held.mean() > 0.3
        yield tuple(np.sqrt(np.mean((image - truth)[held] ** 2)) for image in images)


@pytest.mark.parametrize("level", [1, 2])  # the odd detector loses a row and a column
def test_katsevich_cuts_a_helix_and_its_motion_is_corrected(level):
    step = math.radians(3.6)
    scan = moved(clra.helix(260, angle_step=step, z_step=step / (2 * math.pi), **DETECTOR))
    for before, after in errors(scan, level, "Katsevich"):
        assert after < 0.6 * before
        assert after < 0.09


def test_ramp_fbp_cuts_what_is_no_helix():
    scan = moved(clra.circular(120, **DETECTOR))
    (before, after), _ = errors(scan, 1, "ramp")
    assert after < 0.6 * before
