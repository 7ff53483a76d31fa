"""Views that look alike, against scans that are rotated copies of each other."""

import math

import numpy as np
import pytest

from clra.model.gauge.gauge import sample_points
from clra.model.grid import default_grid
from clra.model.trajectory import circular, helix
from clra.model.view_selection import match_views

STAGE = {"source_to_axis": 4.3627, "source_to_detector": 436.27, "pixel_size": 3.6}


def test_the_same_places_are_found_in_any_order():
    scan = helix(97, angle_step=0.31, z_step=0.04, shape=(61, 67), **STAGE)
    points = sample_points(default_grid(scan), count=30)
    places = np.array([90, 3, 50, 49])
    match = match_views(scan, scan.subset(places), points)
    assert match.views.tolist() == places.tolist()
    assert np.abs([match.distance, match.offset_u, match.offset_v]).max() < 1e-9


def test_distance_is_in_pixels_and_the_mean_is_told():
    scan = circular(72, shape=(61, 67), **STAGE)
    points = np.array([[0.0, 0.0, 0.1], [0.0, 0.0, -0.2]])
    # A detector two columns and one row aside; the axis looks alike from everywhere.
    other = scan.subset([5])
    moved = type(scan)(
        source=other.source,
        detector=other.detector - 2 * other.u + other.v,
        u=other.u,
        v=other.v,
        shape=scan.shape,
    )
    match = match_views(scan, moved, points)
    assert match.distance == pytest.approx([math.sqrt(5)])
    # A detector that lies lower sees the sample higher.
    assert match.offset_u == pytest.approx([-2.0])
    assert match.offset_v == pytest.approx([1.0])


def test_a_view_that_nobody_else_took_is_far():
    scan = circular(36, shape=(61, 67), **STAGE)
    other = circular(36, start=math.radians(5.0), shape=(61, 67), **STAGE)
    points = sample_points(default_grid(scan), count=30)
    assert match_views(scan, other, points).distance.min() > 1.0


def test_detectors_have_to_be_alike():
    scan, other = (circular(9, shape=shape, **STAGE) for shape in ((61, 67), (61, 66)))
    with pytest.raises(ValueError, match=r"detector: found 61 x 66 pixels, expected 61 x 67"):
        match_views(scan, other, np.zeros((1, 3)))
