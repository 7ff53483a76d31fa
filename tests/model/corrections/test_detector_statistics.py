"""Bad pixels are found where there are some, and none where there are none."""

from functools import cache

import numpy as np
import pytest

from clra.app.simulation import counted, paper_like, sample, simulated_motion
from clra.model.corrections import detector_statistics
from clra.model.corrections.detector_statistics import DetectorStatistics

SHAPE = (72, 80)


@cache
def radiographs(trajectory="circular", phantom="porous", motion="random", views=40, seed=1):
    geometry = paper_like(trajectory, views, SHAPE)
    moved = simulated_motion(motion, geometry, shift=(-4, 4), seed=seed)
    return sample(phantom, geometry, seed).line_integrals(geometry.with_motion(moved))


def noisy(images, photons, seed=0):
    return np.stack([counted(image, photons, seed=(seed, k)) for k, image in enumerate(images)])


def found(images):
    statistics = DetectorStatistics(images.shape[1:])
    for image in images:
        statistics.add(image)
    return statistics.find()


def spoilt(images, seed, columns=3, side_by_side=False, rows=0):
    """0.5 % hot or dead pixels and dead lines; values as after -log."""
    random = np.random.default_rng(seed)
    bad = np.zeros(SHAPE, np.bool_)
    bad.ravel()[random.choice(bad.size, round(0.005 * bad.size), replace=False)] = True
    hot = bad & (random.random(SHAPE) < 0.5)
    first = random.integers(6, SHAPE[1] - 10)
    inside = np.arange(4, SHAPE[1] - 4)
    across = first + np.arange(columns) if side_by_side else random.choice(inside, columns, False)
    along = random.choice(np.arange(6, SHAPE[0] - 6), rows, replace=False)
    bad[:, across] = bad[along] = True
    images = images.copy()
    images[:, bad] = 6.0
    images[:, hot] = -1.0
    return images, bad


@pytest.mark.parametrize("photons", [None, 50, 5000])
@pytest.mark.parametrize("phantom", ["porous", "spheres", "wood"])
@pytest.mark.parametrize(
    ("trajectory", "motion", "views"),
    [("circular", "none", 9), ("circular", "none", 40), ("helix", "random", 40),
     ("space-filling", "both", 21)],
)  # fmt: skip
@pytest.mark.slow
def test_good_detectors_raise_no_alarm(trajectory, motion, views, phantom, photons):
    images = radiographs(trajectory, phantom, motion, views, seed=views + 11)
    if photons:
        images = noisy(images, photons, seed=views)
    assert str(found(images)) == "no bad pixels"


@pytest.mark.parametrize("seed", range(6))
def test_small_samples_in_much_air_raise_no_alarm(seed):
    random = np.random.default_rng(seed)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    images = np.zeros((30, *SHAPE), np.float32)
    for image in images:
        for _ in range(4):
            j, i = random.uniform(20, 50, 2)
            image += np.sqrt(np.maximum(9 - (v - j) ** 2 - (u - i) ** 2, 0)) / 4
    assert not found(noisy(images, 300, seed)).bad.any()


@pytest.mark.parametrize("photons", [None, 2000])
@pytest.mark.parametrize("wall", [0.7, 1.5, 3.0])
def test_walls_that_stand_still_are_no_dead_lines(wall, photons):
    images = radiographs(motion="none", views=40).copy()
    across = np.abs(np.arange(SHAPE[1]) - 0.5 * SHAPE[1] + np.linspace(0, 1, 9)[:, None])
    outer, inner = (np.sqrt(np.maximum(r**2 - across**2, 0)) for r in (33, 33 - wall))
    images += (0.1 * (outer - inner).mean(axis=0)).astype(np.float32)  # a tube on the axis
    images[:, 30 : 30 + round(wall)] += 0.7  # a layer across it
    assert not found(noisy(images, photons) if photons else images).bad.any()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("trajectory", "photons"), [("circular", None), ("helix", 500)])
@pytest.mark.parametrize("side_by_side", [False, True])
@pytest.mark.slow
def test_hot_and_dead_pixels_and_columns_are_found(trajectory, photons, side_by_side, seed):
    clean = radiographs(trajectory, views=60, seed=seed + 40)
    images, bad = spoilt(noisy(clean, photons) if photons else clean, seed, 3, side_by_side)
    np.testing.assert_array_equal(found(images).bad, bad)


@pytest.mark.parametrize("value", [0.0, 0.7, 13.8])
def test_stuck_pixels_are_found_whatever_they_show(value):
    images = noisy(radiographs(views=40), 2000)
    bad = np.zeros(SHAPE, np.bool_)
    bad[20:60:7, 15:30:9] = bad[30:33, 40:43] = True  # single ones, and a square
    bad[50] = True
    images[:, bad] = value
    defects = found(images)
    np.testing.assert_array_equal(defects.bad, bad)
    assert defects.rows.tolist() == [50] and not len(defects.columns)
    assert str(defects).endswith("1 dead row")


@pytest.mark.parametrize("line", [np.s_[:, 0], np.s_[:, -2:], np.s_[0], np.s_[-1]])
def test_dead_lines_at_the_border_are_found(line):
    images = noisy(radiographs(views=40), 2000)
    bad = np.zeros(SHAPE, np.bool_)
    bad[line] = True
    images[:, bad] = 0.5
    defects = found(images)
    np.testing.assert_array_equal(defects.bad, bad)
    assert defects.single == 0


def test_single_events_do_not_count():
    images = noisy(radiographs(views=40), 2000)
    images[7, 20, 30], images[9, 40, 50] = -3.0, 9.0
    assert not found(images).bad.any()


def test_too_few_views_tell_nothing():
    images, _ = spoilt(radiographs(views=4), 0)
    assert not found(images).bad.any()


def test_bands_of_a_large_detector_give_what_the_whole_does(monkeypatch):
    images, bad = spoilt(noisy(radiographs("helix", views=60), 2000), 4, rows=1)
    monkeypatch.setattr(detector_statistics, "_BAND", 1200)
    np.testing.assert_array_equal(found(images).bad, bad)
