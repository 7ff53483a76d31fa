"""Each part of the solver, on and off."""

import dataclasses
import math

import numpy as np
import pytest

import clra
from clra.methods.alignment.options import Solver
from clra.methods.reconstruction import fbp
from clra.model.gauge.gauge import Gauge, sample_points, without_gauge
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import porous
from clra.model.phantoms.perturbation import random_motion, smooth_motion

# The paper's helix at a quarter of its resolution and a 32nd of its views.
VIEWS, SCALE = 108, 4
RADIUS, HEIGHT = 240 * 0.004544, 1248 * 0.004544
QUARTER = 58, 32  # rows and columns at QR


@pytest.fixture(scope="module")
def geometry():
    return clra.helix(
        VIEWS,
        angle_step=math.radians(5.5),
        z_step=HEIGHT / VIEWS,
        source_to_axis=4.3627,
        source_to_detector=436.27,
        pixel_size=0.4544 * SCALE,
        shape=(232, 128),
    )


@pytest.fixture(scope="module")
def sample():
    return porous(0.9 * RADIUS, 0.9 * HEIGHT, seed=2)


@pytest.fixture(scope="module")
def moved(geometry, sample):
    jitter = random_motion(VIEWS, seed=0, shift=(-2, 2), magnification=0.001)
    drift = smooth_motion(VIEWS, seed=1, shift=(-2, 2), magnification=0.001)
    points = sample_points(default_grid(geometry))
    truth = without_gauge(jitter.then(drift), geometry, [points])
    return clra.Scan(sample.line_integrals(geometry.with_motion(truth)), geometry, truth=truth)


def _align(scan, schedule, estimate="shift+scale", gauge="anchored", motion=None, **parts):
    solver = Solver(**parts)
    options = {"gauge": gauge, "motion": motion, "solver": solver}
    return clra.align(scan, schedule=schedule, estimate=estimate, quality=False, **options)


def test_an_estimator_that_is_none():
    with pytest.raises(ValueError, match="estimator: found 'eyes', expected one of"):
        Solver(estimator="eyes")


def test_the_paper_has_none_of_our_parts():
    paper = dataclasses.asdict(Solver.paper())
    assert paper.pop("estimator") == "phase-correlation"
    assert not any(paper.values())
    assert all(dataclasses.asdict(Solver()).values())


def test_phase_correlation_finds_shifts_alone(moved):
    found = _align(moved, "1QR", estimator="phase-correlation", unbias=False)
    assert (found.motion.magnification == 1).all()
    error = found.history[0]
    none = np.abs(moved.truth.shift_u).mean(), np.abs(moved.truth.shift_v).mean()
    assert error.mae_u < 0.75 * none[0] and error.mae_v < 0.6 * none[1]


def test_without_memory_every_step_is_the_one_that_registration_asks_for(moved):
    def last_steps(memory):
        two, three = (_align(moved, f"{n}QR", "shift", memory=memory) for n in (2, 3))
        taken = np.median(np.abs(three.motion.shift_v - two.motion.shift_v))
        return taken, three.history[-1].update_v_median

    taken, asked = last_steps(0)
    assert taken == pytest.approx(asked, rel=1e-3)
    taken, asked = last_steps(3)
    assert taken != pytest.approx(asked, rel=1e-2)


def test_the_gauge_goes_if_it_is_anchored(moved):
    points = sample_points(default_grid(moved.geometry).padded(round(0.15 * 312)))
    gauge = Gauge(moved.geometry, points, magnification=False)

    def left(choice):
        found = _align(moved, "1QR", "shift", choice).motion
        rest = gauge.anchored(found)
        taken = [found.shift_u - rest.shift_u, found.shift_v - rest.shift_v]
        return np.abs(taken).mean()

    assert left("anchored") < 0.01
    assert left("free") > 0.05


@pytest.mark.parametrize("circle", [True, False])
def test_the_circle_bounds_every_reconstruction(moved, monkeypatch, circle):
    radii = []

    class Watched(fbp.Coverage):
        def set_geometry(self, geometry):
            super().set_geometry(geometry)
            radii.append(self.radius)

    monkeypatch.setattr(fbp, "Coverage", Watched)
    _align(moved, "2QR", "shift", circle=circle)
    assert radii and all(math.isfinite(radius) == circle for radius in radii)


def test_artefacts_of_the_reconstruction_displace_less_without_their_bias(geometry, sample):
    still = clra.Scan(sample.line_integrals(geometry), geometry)
    plain, mended = (
        _align(still, "1QR", "shift", "free", unbias=unbias) for unbias in (False, True)
    )
    # Nothing moved: all that is found is displacement by artefacts.
    assert np.abs(mended.motion.shift_v).mean() < 0.6 * np.abs(plain.motion.shift_v).mean()


def test_only_small_images_of_whole_turns_are_biased(geometry):
    half = clra.circular(
        20,
        arc=math.pi,
        source_to_axis=50.0,
        source_to_detector=100.0,
        pixel_size=0.1,
        shape=(60, 60),
    )
    assert Solver().is_biased(geometry) and not Solver(unbias=False).is_biased(geometry)
    assert not Solver().is_biased(dataclasses.replace(geometry, shape=(464, 256)))
    assert not Solver().is_biased(half)


def test_magnification_waits_if_others_follow_and_none_is_known(moved):
    truth = moved.truth
    unknown = np.abs(truth.magnification - 1).mean()

    def after_first(schedule="2QR", **options):
        return _align(moved, schedule, **options).history[0].mae_m

    assert after_first() == pytest.approx(unknown, rel=1e-9)
    assert after_first(shifts_first=False) != pytest.approx(unknown, rel=1e-4)
    assert after_first("1QR") != pytest.approx(unknown, rel=1e-4)
    assert after_first(motion=truth) != pytest.approx(unknown, rel=1e-4)


def test_the_expected_spread_holds_the_magnification(moved):
    found = [np.std(_align(moved, "1QR", spread=s).motion.magnification) for s in (1e-4, 3e-3, 0)]
    assert found[0] < 0.2 * found[1]
    assert found[1] < found[2]
