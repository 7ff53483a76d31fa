"""What one correction makes of a ramp-filtered reconstruction, against the phantom itself."""

import math

import numpy as np
import pytest

import clra
from clra.methods.fbp import ramp_fbp
from clra.methods.refinement import refine
from clra.model.grid import VolumeGrid
from clra.model.phantom import Ellipsoids
from clra.ops.streaming import Radiographs, Stream

SAME = 1e-5  # of the largest magnitude
BODY = Ellipsoids([[0, 0, 0], [0.3, 0.2, 0.1]], [[0.7, 0.7, 0.9], [0.2, 0.2, 0.15]], [1.0, 0.7])
ALL = np.ones(121, np.bool_)
GRID = VolumeGrid(shape=(44, 40, 42), voxel_size=0.05, centre=(0.01, 0.0, 0.05))


@pytest.fixture(scope="module")
def scan():
    """A helix that looks 25 degrees up and down, where ramp-FBP is far off."""
    geometry = clra.helix(
        121,
        angle_step=math.radians(6.1),
        z_step=0.02,
        source_to_axis=3.0,
        source_to_detector=6.0,
        pixel_size=0.1,
        shape=(57, 47),
    )
    return clra.Scan(BODY.line_integrals(geometry), geometry)


def _rms(volume):
    return np.sqrt(np.mean((volume - BODY.volume(GRID)) ** 2))


def _refined(stream, scan):
    radiographs = Radiographs(stream, scan, 1)
    volume = ramp_fbp(stream, radiographs, scan.geometry, GRID, volumes=2)
    refine(stream, radiographs, volume, scan.geometry, believed=ALL, stage="test")
    return volume


def test_the_volume_comes_closer_to_the_sample(scan):
    stream = Stream()
    radiographs = Radiographs(stream, scan, 1)
    plain = ramp_fbp(stream, radiographs, scan.geometry, GRID).to_host()
    assert _rms(_refined(stream, scan).to_host()) < 0.75 * _rms(
        plain
    )  # what is left is the blur of edges


def test_slabs_and_chunks_change_nothing(scan):
    volumes = []
    for memory in (None, 1 << 20):
        stream = Stream(max_device_memory=memory)
        volume = _refined(stream, scan)
        volumes.append(volume.to_host())
    assert len(volume.planes) > 1
    assert np.abs(volumes[1] - volumes[0]).max() < SAME * np.abs(volumes[0]).max()
