"""Static geometry that is off: closed-form radiographs taken by a panel shifted and turned."""

import math

import numpy as np
import pytest

import clra
from clra.app.simulate import paper_like, sample, simulated_motion
from clra.methods.autofocus import autofocus
from clra.model.panel import with_panel

OFFSET, TILT = 10.0, math.radians(1.0)
VIEWS, SHAPE = 120, (96, 96)


def _scan(trajectory, jitter=0.0, offset=OFFSET):
    geometry = paper_like(trajectory, VIEWS, SHAPE)
    truth = simulated_motion("random", geometry, shift=(-jitter, jitter), seed=3)
    real = with_panel(geometry, offset_u=offset, tilt=TILT).with_motion(truth)
    rock = sample("porous", geometry, 1)
    return clra.Scan(rock.line_integrals(real), geometry, truth=truth)


def test_offset_and_tilt_are_found():
    found = autofocus(_scan("circular"))
    assert found.offset_u == pytest.approx(OFFSET, abs=0.1)
    assert found.tilt == pytest.approx(TILT, abs=math.radians(0.1))
    assert found.sharpening > 1.2


def test_a_scan_that_moves_can_be_aligned_after_it():
    scan = _scan("helix", jitter=4.0)
    focus = autofocus(scan)
    # A mean shift of the views themselves looks the same.
    assert focus.offset_u - OFFSET == pytest.approx(scan.truth.shift_u.mean(), abs=0.7)
    assert focus.tilt == pytest.approx(TILT, abs=math.radians(0.4))
    before, after = (
        clra.align(s, schedule="1QR-1HR").history[-1] for s in (scan, focus.applied(scan))
    )
    assert after.correlation > before.correlation
    assert after.gauge_free_v < 0.75 * before.gauge_free_v


def test_a_focus_out_of_reach_is_said():
    with pytest.raises(ValueError, match="still getting sharper at an offset of"):
        autofocus(_scan("circular", offset=12.5))
    still = clra.Scan(np.zeros((40, 64, 64), np.float32), paper_like("circular", 40, (64, 64)))
    with pytest.raises(ValueError, match="found no structure"):
        autofocus(still)
