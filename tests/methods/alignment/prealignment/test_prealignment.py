"""Pre-alignment of scans whose radiographs are closed forms."""

import math
from functools import partial

import numpy as np
import pytest

import clra
from clra.methods.alignment.options import Solver
from clra.methods.alignment.prealignment.prealignment import prealigned
from clra.methods.alignment.rejected_views import Rejections
from clra.methods.alignment.result import PREALIGNED
from clra.model.gauge.gauge import Gauge, sample_points
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.progress import Progress

VIEWS, SHAPE, PIXEL = 60, (80, 80), 0.02
# Gauge-free, mean absolute [pixel], noise of 0.02 a pixel.
WALK, LARGE = 0.03, 0.15
CONE = {"source_to_axis": 6.0, "source_to_detector": 12.0, "pixel_size": 2 * PIXEL}


def _arc(views=VIEWS, shape=SHAPE):
    return clra.circular(
        views,
        source_to_axis=5000.0,
        source_to_detector=10000.0,
        pixel_size=2 * PIXEL,
        shape=shape,
        start=-math.radians(75),
        arc=math.radians(150),
    )


def _sample(radius=0.4, half_height=0.5):
    random = np.random.default_rng(11)
    count = 40
    angle, distance = (
        2 * np.pi * random.random(count),
        0.75 * radius * np.sqrt(random.random(count)),
    )
    z = 0.8 * half_height * random.uniform(-1, 1, count)
    centres = np.stack([distance * np.cos(angle), distance * np.sin(angle), z], axis=1)
    sizes = radius * random.uniform(0.1, 0.25, (count, 3))
    weight = random.choice([-0.5, 0.8], count)
    body = ([[0, 0, 0]], [[radius, 0.95 * radius, half_height]], [1.0])
    return Ellipsoids(
        np.concatenate([body[0], centres]),
        np.concatenate([body[1], sizes]),
        np.concatenate([body[2], weight]),
    )


def _walk(views, step, seed=0):
    steps = np.random.default_rng(seed).normal(0, step, (2, views)).cumsum(axis=1)
    u, v = steps - steps.mean(axis=1, keepdims=True)
    return clra.Motion(shift_u=u, shift_v=v)


def _scan(geometry, motion, sample, noise=0.02, level=0.0):
    lines = sample.line_integrals(geometry.with_motion(motion))
    noise = np.random.default_rng(9).normal(0, noise, lines.shape)
    return clra.Scan((lines + noise + level).astype(np.float32), geometry)


def _gauge(geometry):
    return Gauge(geometry, sample_points(default_grid(geometry)), magnification=False)


def _found(scan):
    stream, geometry = Stream(), scan.geometry
    binned = partial(Radiographs, stream, scan)
    return prealigned(stream, geometry, binned, 4, Rejections(scan.views), _gauge(geometry))


def _errors(geometry, found, truth):
    error = _gauge(geometry).error(found, truth)
    return error.gauge_free_u, error.gauge_free_v


@pytest.fixture(scope="module")
def walked():
    # Up to 12 rows: the sample leaves the detector at top and bottom.
    geometry, motion = _arc(), _walk(VIEWS, 2.0)
    return _scan(geometry, motion, _sample(0.4, 0.68)), motion


def test_a_walk_on_an_arc_is_found(walked):
    scan, motion = walked
    found = _found(scan)
    assert found.known.all() and found.exact.all()
    assert max(_errors(scan.geometry, found.motion, motion)) < WALK


def test_alignment_begins_with_it_and_keeps_it(walked):
    scan, motion = walked
    result = clra.align(scan, estimate="shift", quality=False)
    assert [entry.level for entry in result.history].count(PREALIGNED) == 1
    assert result.history[0].level == PREALIGNED and len(result.history) > 2
    assert max(_errors(scan.geometry, result.motion, motion)) < WALK
    off = clra.align(scan, estimate="shift", quality=False, solver=Solver(prealign=False))
    assert PREALIGNED not in {entry.level for entry in off.history}


def test_an_interrupted_alignment_goes_on_from_it(walked, tmp_path):
    scan, motion = walked

    def stop(progress: Progress) -> None:
        if (tmp_path / "c" / "state.json").exists():
            raise MemoryError

    options = {"estimate": "shift", "quality": False, "checkpoint": tmp_path / "c"}
    with pytest.raises(MemoryError):
        clra.align(scan, **options, progress=stop)
    result = clra.align(scan, **options, resume=True)
    assert [entry.level for entry in result.history].count(PREALIGNED) == 1
    assert max(_errors(scan.geometry, result.motion, motion)) < WALK


@pytest.mark.parametrize("slope", [3e-5, 1e-4])
def test_air_that_is_not_even_is_taken_off(slope):
    geometry, motion = _arc(), _walk(VIEWS, 1.0)
    level = 0.005 + slope * (np.arange(SHAPE[1]) - SHAPE[1] / 2)
    found = _found(_scan(geometry, motion, _sample(), level=level))
    assert found.known.all() and max(_errors(geometry, found.motion, motion)) < WALK


def test_a_few_cut_off_views_are_left_to_registration():
    geometry, motion = _arc(), _walk(VIEWS, 0.5)
    shift_u = motion.shift_u.copy()
    shift_u[20:24] += 30.0
    motion = clra.Motion(shift_u=shift_u, shift_v=motion.shift_v)
    found = _found(_scan(geometry, motion, _sample()))
    assert np.flatnonzero(~found.known[0]).tolist() == [20, 21, 22, 23]
    aside = found.motion.shift_u - motion.shift_u
    beside = np.interp(range(20, 24), [19, 24], aside[[19, 24]])
    assert np.abs(aside[20:24] - beside).max() < LARGE


@pytest.mark.parametrize("radius", [0.9, 1.4])
def test_a_truncated_sample_is_left_alone(radius):
    geometry = _arc()
    assert _found(_scan(geometry, _walk(VIEWS, 2.0), _sample(radius))) is None


@pytest.mark.parametrize("path", ["circle", "helix"])
@pytest.mark.parametrize("jitter", [2.0, 15.0])
def test_only_large_motions_of_a_cone_beam_need_it(path, jitter):
    if path == "circle":
        geometry, sample = clra.circular(VIEWS, **CONE, shape=SHAPE), _sample(0.35, 0.4)
    else:
        geometry = clra.helix(VIEWS, angle_step=0.3, z_step=0.02, **CONE, shape=SHAPE)
        sample = _sample(0.35, 1.0)
    u, v = jitter * np.random.default_rng(2).uniform(-1, 1, (2, VIEWS))
    motion = clra.Motion(shift_u=u, shift_v=v)
    found = _found(_scan(geometry, motion, sample))
    if jitter < 5:
        assert found is None
    else:
        assert not found.known.any()
        assert max(_errors(geometry, found.motion, motion)) < LARGE
