"""A sample that turns the other way: trajectories with the sign of their steps reversed."""

import numpy as np

import clra
from clra.model.detector_pose import with_panel
from clra.model.rotation_sense import turned_back


def _helix(angle_step: float) -> clra.ConeBeamGeometry:
    ideal = clra.helix(
        11,
        angle_step=angle_step,
        z_step=0.3,
        source_to_axis=20.0,
        source_to_detector=90.0,
        pixel_size=0.5,
        shape=(15, 21),
    )
    return with_panel(ideal, offset_u=2.5, tilt=0.02)


def test_a_helix_with_its_offset_and_tilt_is_wound_the_other_way():
    found, expected = turned_back(_helix(0.7)), _helix(-0.7)
    np.testing.assert_allclose(found.to_astra(), expected.to_astra(), rtol=0, atol=1e-12)


def test_twice_is_none():
    there = _helix(0.7)
    np.testing.assert_allclose(turned_back(turned_back(there)).to_astra(), there.to_astra())
