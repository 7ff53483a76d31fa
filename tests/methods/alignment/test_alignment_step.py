"""One iteration of alignment on the device; radiographs are closed forms whose motion is known."""

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pytest

import clra
from clra.model.gauge.gauge import Gauge, sample_points, without_gauge
from clra.model.phantoms.ellipsoids import porous
from clra.model.phantoms.perturbation import random_motion
from clra.ops.registration.gauss_newton import ESTIMATE_FIELDS

VIEWS, SHAPE = 121, (49, 65)
GEOMETRY = clra.circular(
    VIEWS, source_to_axis=30.0, source_to_detector=60.0, pixel_size=0.2, shape=SHAPE
)
GRID = clra.VolumeGrid(shape=(51, 65, 65), voxel_size=0.1)
ROCK = porous(2.4, 3.4, seed=4, count=120)
INTENSITY = 0.04  # of the mean inside, between full circles of a cone beam and the truth
STILL = 0.1  # pixels, mean of what is found where nothing moved
# Mean errors of what three calls find of motions up to 2 pixels: along u they shrink slowly.
FOUND_U, FOUND_V = 0.25, 0.1
ROUNDING = 1e-5  # of the largest value


@pytest.fixture(scope="module")
def truth():
    motion = random_motion(VIEWS, seed=3, shift=(-2, 2), magnification=0)
    return without_gauge(motion, GEOMETRY, [sample_points(GRID)], magnification=False)


def once(step, queue, radiographs, shape=GRID.shape):
    estimates = cl_array.empty(queue, (VIEWS, len(ESTIMATE_FIELDS)), np.float32)
    volume = cl_array.empty(queue, shape, np.float32)
    step(queue, estimates, volume, cl_array.to_device(queue, radiographs)).wait()
    return estimates.get(), volume.get()


def test_the_volume_is_the_sample(context, queue):
    still = ROCK.line_integrals(GEOMETRY)
    step = clra.AlignmentStep(context, GEOMETRY, GRID, positive=False)
    estimates, volume = once(step, queue, still)
    exact = ROCK.volume(GRID)
    inside = (slice(20, 31), slice(25, 40), slice(25, 40))
    assert volume[inside].mean() == pytest.approx(exact[inside].mean(), rel=INTENSITY)
    assert np.corrcoef(volume[inside].ravel(), exact[inside].ravel())[0, 1] > 0.9
    assert np.abs(estimates[:, :2]).mean() < STILL


def test_the_volume_is_not_negative_unless_asked_for(context, queue):
    still = ROCK.line_integrals(GEOMETRY)
    volumes = [
        once(clra.AlignmentStep(context, GEOMETRY, GRID, positive=positive), queue, still)[1]
        for positive in (True, False)
    ]
    assert volumes[0].min() == 0 > volumes[1].min()
    assert np.abs(volumes[0] - np.maximum(volumes[1], 0)).max() < ROUNDING * volumes[1].max()


def test_repeated_it_finds_the_motion(context, queue, truth):
    measured = ROCK.line_integrals(GEOMETRY.with_motion(truth))
    step = clra.AlignmentStep(context, GEOMETRY, GRID, magnification=False)
    motion, errors = clra.Motion.identity(VIEWS), []
    for _ in range(3):
        step.set_geometry(GEOMETRY.with_motion(motion))
        estimates, _ = once(step, queue, measured)
        motion = motion.then(clra.Motion(shift_u=estimates[:, 0], shift_v=estimates[:, 1]))
        error = Gauge(GEOMETRY, sample_points(GRID)).error(motion, truth)
        errors.append((error.gauge_free_u, error.gauge_free_v))
    assert errors[-1][0] < FOUND_U
    assert errors[-1][1] < FOUND_V
    assert (np.diff(errors, axis=0) < 0).all()


def test_cut_into_any_parts_and_orders_it_gives_the_same(context, queue, truth):
    measured = ROCK.line_integrals(GEOMETRY.with_motion(truth))
    expected = once(clra.AlignmentStep(context, GEOMETRY, GRID), queue, measured)
    cut = clra.AlignmentStep(
        context, GEOMETRY, GRID, volume_order="yxz", scratch_limit=7 * 4 * SHAPE[0] * SHAPE[1]
    )
    estimates, volume = once(cut, queue, measured, (*GRID.shape[1:], GRID.shape[0]))
    largest = np.abs(expected[1]).max()
    np.testing.assert_allclose(
        np.moveaxis(volume, 2, 0), expected[1], rtol=0, atol=ROUNDING * largest
    )
    # A view's last step may just be or not be worth another, which moves it by a thousandth.
    np.testing.assert_allclose(estimates[:, :3], expected[0][:, :3], rtol=0, atol=2e-3)


def test_expected_magnifications_are_neighbour_weights(context, queue):
    """With no spread allowed the magnification stays what it is known to be."""
    measured = cl_array.to_device(queue, ROCK.line_integrals(GEOMETRY))
    estimates = cl_array.empty(queue, (VIEWS, len(ESTIMATE_FIELDS)), np.float32)
    volume = cl_array.empty(queue, GRID.shape, np.float32)
    known = cl_array.to_device(queue, np.full(VIEWS, 0.01, np.float32))
    step = clra.AlignmentStep(context, GEOMETRY, GRID, spread=1e-6)
    step(queue, estimates, volume, measured, known).wait()
    np.testing.assert_allclose(estimates.get()[:, 2], np.exp(-0.01), rtol=0, atol=1e-4)


def test_what_does_not_fit_is_refused(context, queue):
    step = clra.AlignmentStep(context, GEOMETRY, GRID)
    with pytest.raises(ValueError, match=r"found \(7, 49, 65\), expected \(121, 49, 65\) as"):
        step.set_geometry(GEOMETRY.subset(slice(7)))
    estimates = cl_array.zeros(queue, (VIEWS, len(ESTIMATE_FIELDS)), np.float32)
    volume = cl_array.zeros(queue, GRID.shape, np.float32)
    radiographs = cl_array.zeros(queue, (VIEWS, *SHAPE), np.float32)
    with pytest.raises(ValueError, match="estimates_out: found shape"):
        step(queue, volume, volume, radiographs)
    with pytest.raises(ValueError, match="volume_out: found shape"):
        step(queue, estimates, radiographs, radiographs)
    with pytest.raises(ValueError, match=r"known: found shape \(121, 10\), expected \(121,\)"):
        step(queue, estimates, volume, radiographs, estimates)
    theirs = cl.Context(context.devices)
    with pytest.raises(ValueError, match="queue: its context"):
        step(cl.CommandQueue(theirs), estimates, volume, radiographs)
