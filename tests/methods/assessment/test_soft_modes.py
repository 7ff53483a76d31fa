"""What a known motion shows of how far data determine each mode."""

import json
import math

import numpy as np
import pytest

import clra
from clra.app.simulation import paper_like, sample, simulated_scan
from clra.methods.alignment.result import AlignmentResult
from clra.methods.assessment.assess import assess
from clra.methods.assessment.residual_regions import by_part_of_scan, residual_by_part
from clra.methods.assessment.soft_modes import Modes, SoftMode
from clra.methods.assessment.standard_errors import below_four_cycles
from clra.model.gauge.gauge import sample_points
from clra.model.grid import default_grid
from clra.ops.streaming.stream import Stream

VIEWS, SHAPE = 60, (48, 64)
RADIUS = 0.25 * np.hypot(*SHAPE)


def judged(arc):
    geometry = paper_like("circular", VIEWS, SHAPE)
    if arc < 2 * np.pi:
        geometry = clra.circular(
            VIEWS,
            source_to_axis=3.2,
            source_to_detector=16.0,
            pixel_size=5 / SHAPE[1],
            shape=SHAPE,
            arc=arc,
        )
    still = clra.Motion.identity(VIEWS)
    scan = simulated_scan(geometry, sample("porous", geometry, 1), still, noise=1e4)
    scan = clra.Scan(scan.read(0, VIEWS), geometry)
    result = AlignmentResult.from_motion(still)
    quality = assess(Stream(), scan, result, still, scale=True).quality
    return {mode.name: mode for mode in quality.modes}


def test_an_axis_offset_is_determined_by_a_full_turn_and_not_by_half_of_it():
    full, half = (judged(arc) for arc in (2 * np.pi, np.pi))
    assert full["axis offset"].seen > 0.9 and not full["axis offset"].hardly_determined  # 0.99
    assert half["axis offset"].seen < 0.4 and half["axis offset"].hardly_determined  # 0.15
    for modes in (full, half):
        assert modes["translation x"].hardly_determined and modes["translation z"].hardly_determined
        assert modes["slow shift v"].seen > 0.6


def test_sizes_of_modes_are_those_of_what_was_found():
    geometry = paper_like("circular", VIEWS, SHAPE)
    modes = Modes(geometry, sample_points(default_grid(geometry), 200), magnification=True)
    wave = np.cos(2 * np.pi * (np.arange(VIEWS) + 0.5) / VIEWS)
    motion = clra.Motion(
        shift_u=np.full(VIEWS, 0.5), shift_v=0.2 * wave, magnification=np.exp(1e-3 * wave)
    )
    put_in = modes.added(2)
    left = np.stack([0 * wave, 0.1 * wave, 2e-3 * wave], axis=1)
    # Views that answer with a half of what was put in.
    found = modes.found(motion, {}, left, put_in, -0.5 * put_in, np.ones(VIEWS, np.bool_))
    by_name = {mode.name: mode for mode in found}
    for mode in found:
        assert mode.seen == pytest.approx(0.5)
    assert by_name["axis offset"].amplitude == pytest.approx(0.5)
    assert by_name["slow shift v"].amplitude == pytest.approx(0.2 / np.sqrt(2), abs=1e-5)
    assert by_name["slow shift v"].sigma == pytest.approx(2 * 0.1 / np.sqrt(2), abs=1e-5)
    assert by_name["slow magnification"].sigma == pytest.approx(
        2 * RADIUS * 2e-3 / np.sqrt(2), abs=1e-5
    )


def test_what_is_not_seen_has_no_uncertainty():
    mode = SoftMode("tilt x", 0.3, 0.0, math.inf)
    plain = json.loads(json.dumps(mode.as_dict(), allow_nan=False))
    assert plain["sigma"] is None and SoftMode.from_dict(plain) == mode


def test_slow_is_below_four_cycles_of_a_scan():
    place = (np.arange(100) + 0.5) / 100
    slow, fast = np.cos(6 * np.pi * place), np.cos(10 * np.pi * place)
    np.testing.assert_allclose(below_four_cycles(2 + slow + fast), slow, atol=1e-12)


def test_the_residual_is_told_where_it_is():
    random = np.random.default_rng(1)
    measured = random.normal(size=(8, 48, 66)).astype(np.float32)
    simulated = 1.5 * measured  # the gain is fitted
    simulated[:, :16, 44:] = 0
    parts = residual_by_part(measured, simulated, (1.0, 4.0))
    assert parts.shape == (8, 3, 3)
    # Nearly all of the radiograph's own contrast there, nothing elsewhere but at the border.
    assert 0.7 < np.sqrt(parts[:, 0, 2]).mean() < 1.2
    assert np.sqrt(parts[:, 2, 0]).max() < 0.2
    known = np.full((12, 3, 3), np.nan)
    known[:8] = parts
    blocks = by_part_of_scan(known)
    assert blocks.shape == (4, 3, 3)
    np.testing.assert_allclose(blocks[1], np.sqrt(parts[2:4].mean(axis=0)))
