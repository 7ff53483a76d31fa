"""Odd harmonics of the shifts along u of truncated samples, by closed-form radiographs."""

import math
from dataclasses import replace

import numpy as np
import pytest

import clra
from clra.errors import Cancelled
from clra.methods.alignment.options import Solver
from clra.methods.alignment.region import region_of
from clra.methods.alignment.result import AlignmentInterrupted
from clra.methods.alignment.steps import odd_harmonics
from clra.methods.alignment.steps.odd_harmonics import (
    are_open,
    fitted_harmonics,
)
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.ops.streaming.stream import Stream

VIEWS = 48
DETECTOR = {
    "source_to_axis": 16.0,
    "source_to_detector": 32.0,
    "pixel_size": 0.3125,
    "shape": (24, 32),
}
# Of the field of view [mm].
RADIUS = 2.5
# Of a circle, all valid.
ALL = np.ones(VIEWS, np.bool_)


def _sample(*, body):
    """Return grains and pores 1.2 fields of view wide, in a body or with air in between."""
    random, radius = np.random.default_rng(3), 1.2 * RADIUS
    count = 90 if body else 30
    axes = np.repeat(radius * random.uniform(0.06, 0.15, (count, 1)), 3, axis=1)
    angle, distance = 2 * np.pi * random.random(count), 0.8 * radius * random.random(count) ** 0.5
    z = random.uniform(-1, 1, count)
    centres = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), z])
    weight = random.choice([-0.1, 0.15, 0.3], count) if body else np.full(count, 0.5)
    if body:
        centres = np.vstack([[[0, 0, 0]], centres])
        axes = np.vstack([[[radius, 0.96 * radius, 1.5]], axes])
        weight = np.append(0.2, weight)
    return Ellipsoids(centres, axes, weight)


def _scan(*, body=True, **changes):
    geometry = clra.circular(VIEWS, **{**DETECTOR, **changes})
    return clra.Scan(_sample(body=body).line_integrals(geometry), geometry)


def _region(scan):
    return region_of(Stream(), scan, default_grid(scan.geometry))


def _wrong(scan):
    """Return a motion by which a still scan is wrong."""
    angle = np.arctan2(scan.geometry.source[:, 1], scan.geometry.source[:, 0])
    shift = 0.5 * np.sin(3 * angle + 0.4) + 0.2 * np.cos(5 * angle)
    return clra.Motion(shift_u=shift, shift_v=0 * shift, magnification=0 * shift + 1)


@pytest.fixture(scope="module")
def aligned():
    """Return a scan, its region, and what one iteration makes of it."""
    scan = _scan()
    solver = Solver(harmonics=False, shifts_first=False)
    return scan, _region(scan), clra.align(scan, schedule="1FR", quality=False, solver=solver)


@pytest.mark.slow
def test_wrong_harmonics_are_found():
    scan = _scan()
    motion = _wrong(scan)
    found = fitted_harmonics(Stream(), scan, _region(scan), motion, ALL)
    assert np.abs(found + motion.shift_u).max() < 0.08


@pytest.mark.slow
def test_harmonics_that_re_projections_show_are_left_alone():
    scan = _scan(body=False)
    assert not fitted_harmonics(Stream(), scan, _region(scan), _wrong(scan), ALL).any()


@pytest.mark.slow
def test_a_fit_that_gains_nothing_is_dropped(monkeypatch):
    monkeypatch.setattr(odd_harmonics, "_SEEN", math.inf)
    scan, still = _scan(body=False), clra.Motion.identity(VIEWS)
    assert not fitted_harmonics(Stream(), scan, _region(scan), still, ALL).any()


def test_truncated_samples_on_circles_have_open_harmonics(aligned):
    scan, region, result = aligned
    assert are_open(scan, region, result)
    of_source = replace(result, motion=result.motion.caused_by("source"))
    assert not are_open(scan, region, of_source)
    assert not are_open(scan, replace(region, truncated=False), result)
    own = region_of(Stream(), scan, default_grid(scan.geometry), own=False)
    assert own.truncated and not are_open(scan, own, result)


def test_other_scans_have_none(aligned):
    scan, region, result = aligned
    circle = scan.geometry
    offset = replace(circle, detector=circle.detector + 0.3 * circle.columns * circle.u)
    helix = clra.helix(VIEWS, angle_step=2 * math.pi / VIEWS, z_step=0.1, **DETECTOR)
    arc = clra.circular(VIEWS, arc=math.radians(200), **DETECTOR)
    for geometry in (offset, helix, arc):
        assert not are_open(clra.Scan(scan.projections, geometry), region, result)


@pytest.mark.parametrize("error", [Cancelled, KeyboardInterrupt])
def test_what_is_found_stays_if_the_fit_is_ended(aligned, error):
    scan, _, result = aligned

    def progress(told):
        if "odd harmonics" in told.stage:
            raise error

    def align():
        solver = Solver(shifts_first=False)
        return clra.align(scan, schedule="1FR", quality=False, solver=solver, progress=progress)

    if error is Cancelled:
        with pytest.warns(clra.ClraWarning, match="ended early"):
            kept = align()
    else:
        with pytest.raises(AlignmentInterrupted) as stopped:
            align()
        kept = stopped.value.result
    np.testing.assert_array_equal(kept.motion.shift_u, result.motion.shift_u)
