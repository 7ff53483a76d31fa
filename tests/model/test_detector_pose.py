"""A detector that is shifted and turned, against where points land."""

import math

import numpy as np
import pytest

from clra.model.detector_pose import with_detector
from clra.model.geometry import ConeBeamGeometry
from clra.model.trajectory import helix

STAGE = {"source_to_axis": 4.3627, "source_to_detector": 436.27, "shape": (61, 67)}


def test_points_are_turned_about_the_middle_and_shifted():
    geometry = helix(7, angle_step=0.9, z_step=0.04, pixel_size=3.6, **STAGE)
    tilt = math.radians(3.0)
    points = np.random.default_rng(0).normal(scale=0.2, size=(20, 3))
    found = with_detector(geometry, offset_u=-4.5, tilt=tilt).project(points)
    centre = np.array([33.0, 30.0])
    turn = np.array([[math.cos(tilt), -math.sin(tilt)], [math.sin(tilt), math.cos(tilt)]])
    expected = centre + (geometry.project(points) - centre) @ turn.T + [-4.5, 0]
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_pixels_that_are_not_square_are_turned_as_lengths():
    geometry = ConeBeamGeometry(
        source=[[0, -10, 0]], detector=[[0, 90, 0]], u=[[1, 0, 0]], v=[[0, 0, 2]], shape=(61, 67)
    )
    turned = with_detector(geometry, tilt=math.radians(30.0))
    assert np.linalg.norm(turned.u) == pytest.approx(1)
    assert np.linalg.norm(turned.v) == pytest.approx(2)
    assert turned.u @ turned.v[0] == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(turned.detector, geometry.detector)
