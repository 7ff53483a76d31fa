"""Warped radiographs against what the ideal geometry would have shown, by closed form."""

import numpy as np
import pytest

import clra
from clra.methods.alignment.result import AlignmentResult
from clra.model.phantoms.ellipsoids import Ellipsoids

SHAPE = (45, 53)


@pytest.fixture
def geometry():
    return clra.circular(
        7, source_to_axis=100.0, source_to_detector=150.0, pixel_size=0.5, shape=SHAPE
    )


@pytest.fixture
def motion():
    rng = np.random.default_rng(5)
    return clra.Motion(
        shift_u=rng.uniform(-2, 2, 7),
        shift_v=rng.uniform(-2, 2, 7),
        magnification=rng.uniform(0.99, 1.01, 7),
    )


def _smooth(geometry):
    """Radiographs without edges: a stack of many thin shells is close to a bump."""
    radii = np.linspace(1.0, 6.0, 40)
    bump = Ellipsoids(
        centres=np.tile((0.3, -0.2, 0.4), (40, 1)), semi_axes=radii, attenuation=np.full(40, 0.01)
    )
    return bump.line_integrals(geometry)


def test_correction_undoes_the_motion(geometry, motion):
    ideal = _smooth(geometry)
    moved = clra.Scan(_smooth(geometry.with_motion(motion)), geometry, name="moved")
    corrected = clra.correct(moved, motion)
    error = corrected.read(0, 7) - ideal
    before = moved.read(0, 7) - ideal
    inside = (slice(None), slice(5, -5), slice(5, -5))
    assert np.abs(error[inside]).max() < 0.01 * ideal.max()
    assert np.abs(error[inside]).max() < 0.1 * np.abs(before[inside]).max()
    assert corrected.name == "moved, corrected"


def test_views_are_corrected_as_they_are_read(geometry, motion):
    scan = clra.correct(clra.Scan(_smooth(geometry), geometry), motion)
    assert np.array_equal(scan.read(2, 5), scan.read(0, 7)[2:5])


def test_a_motion_of_other_length_is_refused(geometry):
    scan = clra.Scan(np.zeros((7, *SHAPE), np.float32), geometry)
    with pytest.raises(ValueError, match="motion: found 6 views, expected 7"):
        clra.correct(scan, clra.Motion.identity(6))


def test_the_parallax_of_a_source_that_moved_stays_and_is_told(geometry, motion):
    moved = motion.caused_by("source")
    scan = clra.Scan(_smooth(geometry.with_motion(moved)), geometry)
    with pytest.warns(UserWarning, match="keeps its parallax"):
        clra.correct(scan, moved)


def test_views_that_an_alignment_rejected_are_left_out(geometry, motion):
    rng = np.random.default_rng(0)
    pixels = rng.random((geometry.views, *geometry.shape)).astype(np.float32)
    scan = clra.Scan(pixels, geometry)
    valid_views = np.arange(geometry.views) != 1
    part = clra.correct(scan, AlignmentResult.from_motion(motion, valid_views))
    whole = clra.correct(scan, motion)
    assert part.views == geometry.views - 1 and part.geometry == geometry.subset(valid_views)
    np.testing.assert_array_equal(part.read(0, part.views), whole.read(0, whole.views)[valid_views])
