"""A sample that turns the other way: trajectories with the sign of their steps reversed."""

import numpy as np

import clra
from clra.model.detector_pose import with_detector
from clra.model.rotation_sense import opposite_rotation


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
    return with_detector(ideal, offset_u=2.5, tilt=0.02)


def test_a_helix_with_its_offset_and_tilt_is_wound_the_other_way():
    found, expected = opposite_rotation(_helix(0.7)), _helix(-0.7)
    np.testing.assert_allclose(found.to_astra(), expected.to_astra(), rtol=0, atol=1e-12)


def test_twice_is_none():
    there = _helix(0.7)
    np.testing.assert_allclose(
        opposite_rotation(opposite_rotation(there)).to_astra(), there.to_astra()
    )
