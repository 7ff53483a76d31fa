"""Where alignment reconstructs, by closed-form radiographs."""

import math

import numpy as np
import pytest

import clra
from clra.methods.alignment.region import region_of
from clra.methods.alignment.reprojection import with_margin
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.ops.streaming.stream import Stream

DETECTOR = {
    "source_to_axis": 30.0,
    "source_to_detector": 60.0,
    "pixel_size": 0.2,
    "shape": (40, 48),
}


def _region(geometry, semi_axes, level=0.0):
    sample = Ellipsoids([[0, 0, 0]], [semi_axes], [0.2])
    scan = clra.Scan(sample.line_integrals(geometry) + np.float32(level), geometry)
    return region_of(Stream(), scan, default_grid(geometry)), with_margin(default_grid(geometry))


@pytest.mark.parametrize(
    ("radius", "truncated", "width"), [(2.0, False, 1.0), (3.0, True, 1.25), (5.0, True, 1.6)]
)
def test_a_truncated_sample_gets_a_grid_as_wide_as_it_seems(radius, truncated, width):
    region, usual = _region(clra.circular(40, **DETECTOR), (radius, radius, 1.0))
    assert region.truncated == truncated
    assert region.sample == usual
    # Of radius 3 it reaches 0.07 of the detector beyond each side: 1.15 + 18 * 0.07^2.
    assert region.grid.shape[1] == pytest.approx(width * usual.shape[1], rel=0.1)
    assert region.terms(1) == (3 if truncated else 1) and region.terms(0) == 0


def test_a_level_beside_the_sample_is_no_truncation():
    region, usual = _region(clra.circular(40, **DETECTOR), (1.5, 1.5, 1.0), level=0.3)
    assert not region.truncated and region.grid == usual


def test_a_grid_of_ones_own_stays():
    geometry = clra.circular(40, **DETECTOR)
    sample = Ellipsoids([[0, 0, 0]], [(3.0, 3.0, 1.0)], [0.2])
    scan = clra.Scan(sample.line_integrals(geometry), geometry)
    region = region_of(Stream(), scan, default_grid(geometry), own=False)
    assert region.truncated and region.grid == with_margin(default_grid(geometry))


@pytest.mark.parametrize("half_height", [3.0, 20.0])
def test_the_grid_is_as_high_as_the_sample_is_seen(half_height):
    geometry = clra.helix(120, angle_step=math.radians(9), z_step=0.1, **DETECTOR)
    region, usual = _region(geometry, (1.5, 1.5, half_height))
    lowest, highest = (z(geometry.source[:, 2]) for z in (np.min, np.max))
    half_detector = 0.5 * 40 * 0.1
    top = region.grid.centre[2] + 0.5 * region.grid.shape[0] * region.grid.voxel_size
    if half_height == 3.0:
        assert region.grid == usual
    else:
        assert top > highest + half_detector
        assert 2 * region.grid.centre[2] == pytest.approx(lowest + highest, abs=0.1)


@pytest.mark.parametrize(("arc", "terms"), [(360, 1), (200, 3), (140, 3)])
def test_an_arc_needs_more_corrections(arc, terms):
    region, _ = _region(clra.circular(40, arc=math.radians(arc), **DETECTOR), (1.5, 1.5, 1.0))
    assert region.terms(1) == terms and region.terms(0) == 0
