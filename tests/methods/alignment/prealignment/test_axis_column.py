"""The column of the axis of arcs that are closed forms."""

import math

import numpy as np
import pytest

import clra
from clra.methods.alignment.prealignment.axis_column import axis_column
from clra.model.gauge.gauge import Gauge, sample_points
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

VIEWS, ASIDE = 60, 5.0


def _scan(arc, aside, jitter=0.0):
    geometry = clra.circular(
        VIEWS,
        source_to_axis=6.0,
        source_to_detector=12.0,
        pixel_size=0.05,
        shape=(48, 64),
        arc=math.radians(arc),
    )
    u, v = jitter * np.random.default_rng(3).uniform(-1, 1, (2, VIEWS))
    motion = clra.Motion(shift_u=u + aside, shift_v=v)
    random = np.random.default_rng(2)
    angle, distance = 2 * np.pi * random.random(40), 0.45 * np.sqrt(random.random(40))
    z = 0.4 * random.uniform(-1, 1, 40)
    centres = np.stack([distance * np.cos(angle), distance * np.sin(angle), z], axis=1)
    balls = Ellipsoids(centres, random.uniform(0.03, 0.1, 40), random.uniform(1, 3, 40))
    lines = balls.line_integrals(geometry.with_motion(motion))
    return clra.Scan(lines, geometry, truth=motion)


@pytest.mark.parametrize(
    ("arc", "aside", "found"),
    [(210, ASIDE, ASIDE), (210, -ASIDE, -ASIDE), (210, 0.5, 0), (360, ASIDE, 0), (120, ASIDE, 0)],
)
def test_an_axis_aside_is_found_where_rays_are_measured_twice(arc, aside, found):
    stream, scan = Stream(), _scan(arc, aside)
    column = axis_column(stream, scan, lambda: Radiographs(stream, scan, 1))
    assert column == pytest.approx(found, abs=0.3)


def test_an_axis_aside_is_no_movement_of_the_sample():
    # Taken for one it ended at 0.10, 0.09 and 0.018.
    scan = _scan(210, ASIDE, jitter=2.0)
    result = clra.align(scan, quality=False)
    gauge = Gauge(scan.geometry, sample_points(default_grid(scan.geometry)))
    error = gauge.error(result.motion, scan.truth)
    assert error.gauge_free_u < 0.035 and error.gauge_free_v < 0.035
    assert error.gauge_free_m < 3.5e-3
