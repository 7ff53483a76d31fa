"""What a reconstruction tells of a scan that was never aligned."""

import warnings

import numpy as np
import pytest

import clra
from clra.findings import collected
from clra.model.phantoms.ellipsoids import Ellipsoids

VIEWS, SHAPE = 90, (40, 64)
CONE = {"source_to_axis": 4.0, "source_to_detector": 20.0, "pixel_size": 0.1, "shape": SHAPE}


@pytest.fixture(scope="module")
def frames():
    random = np.random.default_rng(3)
    places = random.uniform(-0.4, 0.4, (30, 3)) * [1, 1, 0.7]
    balls = Ellipsoids(places, random.uniform(0.04, 0.12, 30), np.full(30, 3.0))
    return balls.line_integrals(clra.circular(VIEWS, **CONE))


def told(frames, geometry, **options):
    scan = clra.Scan(np.ascontiguousarray(frames), geometry)
    with collected() as findings, warnings.catch_warnings():
        warnings.simplefilter("ignore", clra.errors.ClraWarning)
        clra.reconstruct(scan, **options)
    return [finding.code for finding in findings]


def test_nothing_is_said_of_the_right_geometry(frames):
    assert told(frames, clra.circular(VIEWS, **CONE)) == []


def test_the_wrong_sense_of_rotation_is_told(frames):
    other = clra.circular(VIEWS, **CONE, rotation="ccw")
    assert told(frames, other) == ["rotation-sense"]


def test_an_axis_elsewhere_is_told_unless_the_motion_has_it(frames):
    geometry = clra.circular(VIEWS, **CONE)
    aside = np.roll(frames, 4, axis=2)  # the outermost columns show air
    assert told(aside, geometry) == ["axis-offset"]
    known = clra.Motion(shift_u=np.full(VIEWS, 4.0), shift_v=np.zeros(VIEWS))
    assert told(aside, geometry, motion=known) == []


def test_a_clipped_detector_is_told(frames):
    clipped = np.minimum(frames, 0.4 * frames.max())
    assert told(clipped, clra.circular(VIEWS, **CONE)) == ["clipped-detector"]
