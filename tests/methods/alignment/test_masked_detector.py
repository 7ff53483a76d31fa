"""A detector of which only a part sees the sample, as in the paper: 2304 of 3040 columns, in
small."""

import numpy as np
import pytest

import clra
from clra.app.simulation import paper_like, sample, simulated_motion

VIEWS, SHAPE = 120, (96, 96)
TOP, LEFT, DETECTOR = 7, 20, (110, 128)


@pytest.fixture(scope="module")
def seen():
    geometry = paper_like("space-filling", VIEWS, SHAPE)
    truth = simulated_motion("both", geometry, shift=(-4, 4), magnification=0.004, seed=3)
    rock = sample("porous", geometry, 1)
    return clra.Scan(rock.line_integrals(geometry.with_motion(truth)), geometry, truth=truth)


@pytest.fixture(scope="module")
def masked(seen):
    """The same radiographs on a larger detector whose sides are shadowed."""
    small = seen.geometry
    offset_u = LEFT + SHAPE[1] / 2 - DETECTOR[1] / 2
    offset_v = TOP + SHAPE[0] / 2 - DETECTOR[0] / 2
    geometry = clra.ConeBeamGeometry(
        source=small.source,
        detector=small.detector - offset_u * small.u - offset_v * small.v,
        u=small.u,
        v=small.v,
        shape=DETECTOR,
    )
    pixels = np.full((VIEWS, *DETECTOR), 7.0, np.float32)
    mask = np.zeros(DETECTOR, np.bool_)
    window = np.s_[TOP : TOP + SHAPE[0], LEFT : LEFT + SHAPE[1]]
    mask[window] = True
    pixels[:, *window] = seen.read(0, VIEWS)
    return clra.Scan(pixels, geometry, mask=mask, truth=seen.truth.about(-offset_u, -offset_v))


def test_cropping_gives_the_part_that_sees_the_sample(seen, masked):
    part = masked.cropped()
    np.testing.assert_allclose(part.geometry.to_astra(), seen.geometry.to_astra(), atol=1e-12)
    np.testing.assert_array_equal(part.read(3, 9), seen.read(3, 9))
    np.testing.assert_allclose(part.truth.shift_u, seen.truth.shift_u, atol=1e-12)
    assert part.mask is None
    assert seen.cropped() is seen


def test_the_true_motion_means_the_same_on_both_detectors(seen, masked):
    # A motion of the whole detector, absorbed, shows the window what the window's own shows.
    whole = masked.geometry.with_motion(masked.truth)
    part = seen.geometry.with_motion(seen.truth)
    points = np.random.default_rng(0).normal(scale=0.2, size=(9, 3))
    np.testing.assert_allclose(whole.project(points) - [LEFT, TOP], part.project(points), atol=1e-8)


def test_alignment_and_volume_are_those_of_the_part(seen, masked):
    found = clra.align(masked, schedule="1QR-1HR")
    expected = clra.align(seen, schedule="1QR-1HR")
    np.testing.assert_allclose(
        found.motion.about(*masked.window_offset).shift_u, expected.motion.shift_u, atol=1e-3
    )
    assert found.history[-1].gauge_free_u == pytest.approx(
        expected.history[-1].gauge_free_u, abs=1e-3
    )
    volume = clra.reconstruct(masked, motion=masked.truth)
    other = clra.reconstruct(seen, motion=seen.truth)
    assert volume.shape == other.shape
    np.testing.assert_allclose(volume, other, atol=1e-4 * other.max())
