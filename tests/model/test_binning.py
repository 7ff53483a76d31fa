"""Binned scans."""

import numpy as np
import pytest

import clra
from clra.model.binning import binned_motion, binned_scan
from clra.model.rigid.rigid_motion import RigidMotion, optics_of

DETECTOR = {
    "source_to_axis": 50.0,
    "source_to_detector": 100.0,
    "pixel_size": 0.5,
    "shape": (11, 14),
}


def _motion(views):
    rng = np.random.default_rng(2)
    return clra.Motion(
        shift_u=rng.normal(size=views),
        shift_v=rng.normal(size=views),
        magnification=1 + 0.02 * rng.normal(size=views),
    )


@pytest.mark.parametrize("kind", ["line-integrals", "transmission"])
def test_line_integrals_are_averaged(kind):
    geometry = clra.circular(4, **DETECTOR)
    values = np.random.default_rng(0).uniform(0.1, 1, (4, 11, 14)).astype(np.float32)
    mask = np.ones((11, 14), np.bool_)
    mask[5, 6] = False
    scan = clra.Scan(values, geometry, kind, mask=mask)
    binned = binned_scan(scan, 3)
    expected = scan.read(0, 4)[:, :9, :12].reshape(4, 3, 3, 4, 3).mean(axis=(2, 4))
    assert binned.read(1, 3) == pytest.approx(expected[1:3], rel=1e-6)
    assert binned.geometry == geometry.binned(3)
    assert binned_scan(scan, 1) is scan


@pytest.mark.parametrize("cause", ["detector", "source"])
def test_a_motion_in_binned_pixels_is_the_same_motion(cause):
    geometry, motion = clra.circular(5, **DETECTOR), _motion(5).caused_by(cause)
    binned = geometry.binned(3).with_motion(binned_motion(motion, 3, geometry.shape))
    expected = geometry.with_motion(motion).binned(3)
    points = np.random.default_rng(1).uniform(-1, 1, (7, 3))
    tolerance = 1e-9 if cause == "detector" else 1e-3
    assert binned.project(points) == pytest.approx(expected.project(points), abs=tolerance)


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_a_rigid_motion_in_binned_pixels_keeps_its_rotations(factor):
    geometry = clra.circular(5, **DETECTOR)
    table = np.random.default_rng(3).normal(scale=0.1, size=(5, 6))
    motion = RigidMotion.of(geometry, table)
    binned = binned_motion(motion, factor, geometry.shape)
    expected = geometry.with_motion(motion).binned(factor)
    assert geometry.binned(factor).with_motion(binned).to_astra() == pytest.approx(
        expected.to_astra(), abs=1e-9
    )
    assert binned.optics == pytest.approx(optics_of(geometry.binned(factor)), rel=1e-12)
