"""Static geometry that is off: closed-form radiographs taken by a detector shifted and turned."""

import math

import numpy as np
import pytest

import clra
from clra.app.simulation import paper_like, sample, simulated_motion
from clra.methods.alignment.autofocus import Focus, autofocus
from clra.methods.assessment.slice_sharpness import sharpening_by_opposite_rotation
from clra.model.detector_pose import with_detector
from clra.model.gauge.gauge import Gauge, sample_points
from clra.model.grid import default_grid
from clra.model.rotation_sense import opposite_rotation
from clra.ops.streaming.stream import Stream

OFFSET, TILT = 6.0, math.radians(1.0)
VIEWS, SHAPE = 90, (64, 64)


def _scan(trajectory, jitter=0.0, offset=OFFSET):
    geometry = paper_like(trajectory, VIEWS, SHAPE)
    truth = simulated_motion("random", geometry, shift=(-jitter, jitter), seed=3)
    real = with_detector(geometry, offset_u=offset, tilt=TILT).with_motion(truth)
    rock = sample("porous", geometry, 1)
    return clra.Scan(rock.line_integrals(real), geometry, truth=truth)


def test_offset_and_tilt_are_found():
    found = autofocus(_scan("circular"))
    assert found.offset_u == pytest.approx(OFFSET, abs=0.05)
    assert found.tilt == pytest.approx(TILT, abs=math.radians(0.1))
    assert found.sharpening > 1.2


def _error(scan, focus):
    """Of the shifts that alignment finds, those of the detector included."""
    motion = clra.align(focus.applied(scan), schedule="3HR", estimate="shift", quality=False).motion
    whole = clra.Motion(shift_u=motion.shift_u + focus.offset_u - OFFSET, shift_v=motion.shift_v)
    points = sample_points(default_grid(scan.geometry))
    return Gauge(scan.geometry, points, magnification=False).error(whole, scan.truth)


@pytest.mark.parametrize("trajectory", ["helix", "space-filling"])
def test_a_scan_that_jitters_is_aligned_as_if_the_detector_had_been_known(trajectory):
    scan = _scan(trajectory, jitter=4.0)
    found = autofocus(scan)
    # A mean shift of the views themselves looks the same.
    assert found.offset_u - OFFSET == pytest.approx(scan.truth.shift_u.mean(), abs=0.05)
    assert found.tilt == pytest.approx(TILT, abs=math.radians(0.12))
    best, after, valid_views = (
        _error(scan, focus) for focus in (Focus(OFFSET, TILT, 1.0), found, Focus(0.0, 0.0, 1.0))
    )
    assert after.gauge_free_u < 1.1 * best.gauge_free_u
    assert after.gauge_free_v < 1.1 * best.gauge_free_v
    assert valid_views.mae_u > 2 * best.mae_u


def test_a_focus_out_of_reach_is_said():
    with pytest.raises(ValueError, match="still getting sharper at an offset of"):
        autofocus(_scan("circular", offset=8.3))
    still = clra.Scan(np.zeros((40, 64, 64), np.float32), paper_like("circular", 40, (64, 64)))
    with pytest.raises(ValueError, match="found no structure"):
        autofocus(still)
    with pytest.raises(ValueError, match="hardly a ray that is measured twice"):
        autofocus(_scan("circular").subset(slice(30)))


@pytest.mark.parametrize("trajectory", ["circular", "space-filling"])
def test_a_sample_that_turns_the_other_way_is_noticed(trajectory):
    scan = _scan(trajectory, jitter=2.0)
    motion = clra.Motion(shift_u=scan.truth.shift_u + OFFSET, shift_v=scan.truth.shift_v)
    assert sharpening_by_opposite_rotation(Stream(), scan, motion) < 0.8
    mirrored = clra.Scan(scan.projections, opposite_rotation(scan.geometry))
    assert sharpening_by_opposite_rotation(Stream(), mirrored, motion) > 1.2


def test_a_parallel_beam_does_not_tell_how_the_sample_turns():
    far = clra.circular(
        VIEWS, source_to_axis=1e6, source_to_detector=1e6, pixel_size=0.1, shape=SHAPE
    )
    scan = clra.Scan(sample("porous", far, 1).line_integrals(far), far)
    still = clra.Motion.identity(VIEWS)
    assert sharpening_by_opposite_rotation(Stream(), scan, still) == pytest.approx(1.0, abs=0.005)
