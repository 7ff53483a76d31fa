"""Corrections against closed forms."""

import numpy as np
import pytest

from clra.errors import InputError
from clra.model.corrections.air_region import AirStatistics
from clra.model.corrections.corrections import Corrections
from clra.model.corrections.rings import ring_errors
from clra.model.corrections.zingers import replace_zingers

SHAPE = (48, 96)
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)


def body(view, radius=34.0, middle=48.0):
    """A ball that wanders by a few pixels."""
    j, i = 24 + np.sin(view), middle + 4 * np.cos(view)
    across = radius**2 - (COLUMNS - i) ** 2 - (ROWS - j) ** 2
    return np.sqrt(np.maximum(across, 0)).astype(np.float32) / 20


def air_of(images):
    statistics = AirStatistics(slice(0, SHAPE[0]), slice(0, SHAPE[1]))
    for image in images:
        statistics.add(image)
    return statistics.find()


def decayed(count=20, part=0.3, **changes):
    lost = -np.log(1 - part * np.arange(count) / count).astype(np.float32)
    return np.stack([body(k, **changes) + lost[k] for k in range(count)]), lost


def test_the_air_tells_what_the_beam_lost():
    images, lost = decayed()
    air = air_of(images)
    np.testing.assert_allclose([air.level(image) for image in images], lost, atol=1e-6)
    corrected = Corrections(air=air).apply(images)
    np.testing.assert_allclose(corrected, [body(k) for k in range(20)], atol=1e-6)


def test_the_air_is_right_at_few_photons():
    images, lost = decayed()
    random = np.random.default_rng(3)
    counts = random.poisson(50 * np.exp(-images.astype(np.float64)))
    images = np.log(50 / np.maximum(counts, 0.5)).astype(np.float32)
    levels = [air_of(images).level(image) for image in images]
    np.testing.assert_allclose(levels, lost, atol=0.04)  # 1.5 standard errors are 0.02
    assert np.mean(levels - lost) == pytest.approx(0, abs=4e-3)  # no bias of logarithms, 0.01


def test_one_side_is_enough_and_the_sample_is_no_air():
    images, lost = decayed(middle=20.0)
    np.testing.assert_allclose(air_of(images).level(images[-1]), lost[-1], atol=1e-6)
    assert air_of(decayed(radius=70.0)[0]) is None


def test_steady_beams_are_left_alone():
    assert air_of(decayed(part=0.0)[0]) is None
    images, _ = decayed(part=0.0)
    images[4] = 13.8  # a view without beam is no decay
    assert air_of(images) is None


def test_zingers_are_replaced_and_noise_is_not():
    random = np.random.default_rng(5)
    image = body(0)
    where = (np.array([10, 30, 24]), np.array([20, 60, 48]))
    hit = image.copy()
    hit[where] -= 2.0
    assert replace_zingers(hit) == 3
    np.testing.assert_allclose(hit, image, atol=0.02)
    for photons in (50, 500, 5000):
        for _ in range(5):
            counts = random.poisson(photons * np.exp(-image.astype(np.float64)))
            noisy = np.log(photons / np.maximum(counts, 0.5)).astype(np.float32)
            assert replace_zingers(noisy) == 0


def test_rings_are_what_the_rows_lack_of_smoothness():
    random = np.random.default_rng(6)
    error = np.zeros(SHAPE, np.float32)
    chosen = random.random(SHAPE) < 0.1
    error[chosen] = random.normal(0, 0.05, chosen.sum())
    mean = np.mean([body(k) for k in range(60)], axis=0)
    inside = np.s_[8:40, 24:72]  # away from the rim of the body, which is sharp
    left = (error - (ring_errors(mean + error) - ring_errors(mean)))[inside]
    assert np.sqrt(np.mean(left**2)) < 0.3 * error[inside].std()
    assert np.abs(ring_errors(mean)[inside]).max() < 0.01 * mean.max()


def test_polynomial_in_order():
    pixels = np.array([[[0.0, 1.0, 2.0]]], np.float32)
    corrected = Corrections(beam_hardening=(0.1, 0.01)).apply(pixels)
    np.testing.assert_allclose(corrected[0, 0], [0, 1.11, 2 + 0.4 + 0.08], rtol=1e-6)
    assert pixels[0, 0, 1] == 1.0


def test_bad_pixels_are_filled_before_the_air_is_taken():
    images, _ = decayed()
    bad = np.zeros(SHAPE, np.bool_)
    bad[:, 2] = bad[10, 93] = True
    air = air_of(images)
    images[:, bad] = -9.0
    corrected = Corrections(bad=bad, air=air).apply(images)
    np.testing.assert_allclose(corrected[-1], body(19), atol=1e-5)


def test_a_part_of_the_detector_keeps_its_corrections():
    images, _ = decayed()
    bad = np.zeros(SHAPE, np.bool_)
    bad[20, 30] = True
    whole = Corrections(bad=bad, air=air_of(images), rings=0.01 * ROWS)
    rows, columns = slice(5, 40), slice(1, 90)
    np.testing.assert_allclose(
        whole.cropped(rows, columns).apply(images[:, rows, columns]),
        whole.apply(images)[:, rows, columns],
        atol=1e-6,
    )
    assert Corrections(air=whole.air).cropped(rows, slice(20, 60)).air is None


def test_arrays_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match=r"corrections\.rings: found shape \(3, 4\)"):
        Corrections(rings=np.zeros((3, 4), np.float32)).check(SHAPE, "scan")
    with pytest.raises(InputError, match="no good pixel"):
        Corrections(bad=np.ones(SHAPE, np.bool_)).check(SHAPE, "scan")
