"""The axis of arcs whose detectors are off by a known offset."""

import math

import numpy as np
import pytest

import clra
from clra.methods.alignment.autofocus import autofocus
from clra.methods.assessment.axis_of_arc import axis_offset
from clra.model.detector_pose import with_detector
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.ops.streaming.stream import Stream

FAN = {"source_to_axis": 50.0, "source_to_detector": 100.0, "pixel_size": 0.5, "shape": (7, 96)}
PARALLEL = FAN | {"source_to_axis": 5e4, "source_to_detector": 5e4, "pixel_size": 0.25}


def _scan(geometry, offset, noise=0.0, seed=4):
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-6, 6, (25, 3)) * [1, 1, 0.2]
    sizes = rng.uniform(0.6, 2, (25, 3))
    body = Ellipsoids(centres, sizes, rng.uniform(0.05, 0.3, 25))
    pixels = body.line_integrals(with_detector(geometry, offset_u=offset), oversample=2)
    return clra.Scan(pixels + noise * rng.normal(size=pixels.shape).astype(np.float32), geometry)


@pytest.mark.parametrize("offset", [-7.3, 0.0, 4.6])
@pytest.mark.parametrize(
    ("geometry", "tolerance"),
    [
        (clra.circular(180, arc=math.pi, **PARALLEL), 0.1),
        (clra.circular(181, arc=181 / 180 * math.pi, **PARALLEL), 0.1),
        (clra.circular(200, arc=math.radians(200), **FAN), 0.1),
        (clra.circular(240, arc=math.radians(-240), start=2.0, **FAN), 0.1),
        (clra.circular(360, **FAN), 0.1),
    ],
    ids=["180 parallel", "0 and 180 parallel", "200 fan", "-240 fan", "360 fan"],
)
def test_the_axis_is_found(geometry, tolerance, offset):
    found, gain = axis_offset(Stream(), _scan(geometry, offset))
    assert found == pytest.approx(offset, abs=tolerance)
    assert gain > (5 if offset else 0.99)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_less_than_half_a_turn_is_enough_for_the_spectrum(seed):
    # Of 178 degrees no ray is measured twice. Measured: 0.09.
    geometry = clra.circular(178, arc=math.radians(178), **PARALLEL)
    for offset in (-7.3, 4.6):
        found, gain = axis_offset(Stream(), _scan(geometry, offset, noise=0.05, seed=seed))
        assert found == pytest.approx(offset, abs=0.13)
        assert gain > 3


def test_noise_costs_little():
    geometry = clra.circular(240, arc=math.radians(240), **FAN)
    found, _ = axis_offset(Stream(), _scan(geometry, 3.0, noise=0.05))
    assert found == pytest.approx(3.0, abs=0.15)


def test_autofocus_takes_it_on_arcs():
    geometry = clra.circular(240, arc=math.radians(240), **FAN)
    focus = autofocus(_scan(geometry, 3.0))
    assert focus.offset_u == pytest.approx(3.0, abs=0.1)
    assert focus.tilt == 0


def test_without_redundant_rays_there_is_no_axis():
    geometry = clra.circular(100, arc=math.radians(120), **PARALLEL)
    with pytest.raises(clra.InputError, match="hardly a ray that is measured twice"):
        axis_offset(Stream(), _scan(geometry, 0.0))
