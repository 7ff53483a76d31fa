"""Gauge columns against displaced points, and errors without the gauge."""

import math

import numpy as np
import pytest

from clra.model.gauge.gauge import Gauge, sample_points, without_gauge
from clra.model.gauge.modes import GAUGE_MODES, gauge_columns
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid, default_grid
from clra.model.motion import Motion
from clra.model.phantoms.perturbation import random_motion, smooth_motion
from clra.model.trajectory import circular, helix

# Finite differences of 1e-6 of the sample's size, in float64.
DIFFERENCE = 1e-5
# Least squares in float64.
ROUNDING = 1e-9

STAGE = {
    "source_to_axis": 4.3627,
    "source_to_detector": 436.27,
    "pixel_size": 3.6,
    "shape": (61, 67),
}


@pytest.fixture(scope="module")
def scan():
    return helix(97, angle_step=0.31, z_step=0.04, **STAGE)


@pytest.fixture(scope="module")
def points(scan):
    return sample_points(default_grid(scan), count=400)


def moved_points(mode, points, amount):
    """The points after a movement of the sample."""
    x, y, z = points.T
    c, s = math.cos(amount), math.sin(amount)
    return np.stack(
        {
            "translation x": (x + amount, y, z),
            "translation y": (x, y + amount, z),
            "translation z": (x, y, z + amount),
            "tilt x": (x, c * y - s * z, s * y + c * z),
            "tilt y": (c * x + s * z, y, c * z - s * x),
            "scale": (x * (1 + amount), y * (1 + amount), z * (1 + amount)),
            "stretch z": (x, y, z * (1 + amount)),
        }[mode],
        axis=1,
    )


def fitted_by_loop(geometry, before, after):
    """(du, dv, dm) of each view from the pixels of the points before and after."""
    centre = np.array([(geometry.columns - 1) / 2, (geometry.rows - 1) / 2])
    found = np.zeros((3, geometry.views))
    for view in range(geometry.views):
        one = geometry.subset(view)
        q, p = one.project(before)[0] - centre, one.project(after)[0] - centre
        seen = (np.abs(q) < np.array([geometry.columns, geometry.rows]) / 2).all(axis=1)
        if seen.sum() < 8:
            continue
        q, p = q[seen], p[seen]
        design, target = [], []
        for (a, b), (da, db) in zip(q, p - q, strict=True):
            design += [[1, 0, a], [0, 1, b]]
            target += [da, db]
        found[:, view] = np.linalg.lstsq(np.array(design), np.array(target), rcond=None)[0]
    return found.ravel()


@pytest.mark.parametrize("mode", GAUGE_MODES)
def test_columns_are_the_derivatives_of_what_moved_points_look_like(scan, points, mode):
    few, cloud, step = scan.subset(slice(0, None, 12)), points[:60], 1e-6
    ahead = fitted_by_loop(few, cloud, moved_points(mode, cloud, step))
    expected = ahead / step
    found = gauge_columns(few, cloud, [mode])[:, 0]
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(found, expected, atol=DIFFERENCE * np.abs(expected).max())


def test_columns_of_detectors_in_general_position(points):
    random = np.random.default_rng(1)
    ideal = circular(4, **STAGE).to_astra()
    tilted = ConeBeamGeometry.from_astra(
        ideal + random.normal(size=ideal.shape) * np.repeat([0.2, 5, 0.2, 0.2], 3), STAGE["shape"]
    )
    for mode in ("translation y", "tilt x"):
        expected = fitted_by_loop(tilted, points, moved_points(mode, points, 1e-6)) / 1e-6
        found = gauge_columns(tilted, points, [mode])[:, 0]
        np.testing.assert_allclose(found, expected, atol=DIFFERENCE * np.abs(expected).max())


def test_columns_do_not_depend_on_chunks_of_views(scan, points, monkeypatch):
    whole = gauge_columns(scan, points)
    monkeypatch.setattr("clra.model.gauge.modes._CHUNK", 1)
    np.testing.assert_allclose(gauge_columns(scan, points), whole, atol=ROUNDING)


def test_views_that_see_nothing_have_no_columns(points):
    above = helix(3, angle_step=0.3, z_step=50.0, **STAGE)
    columns = gauge_columns(above, points).reshape(3, 3, -1)
    assert (columns[:, [0, 2]] == 0).all()
    assert (columns[:, 1] != 0).any()


def test_unknown_modes_are_refused(scan, points):
    with pytest.raises(ValueError, match="modes: found 'rotation z', expected some of"):
        gauge_columns(scan, points, ["rotation z"])


def gauge_motion(geometry, points, coefficients):
    """Motion that movements of the sample look like."""
    u, v, m = (gauge_columns(geometry, points) @ coefficients).reshape(3, -1)
    return Motion(shift_u=u, shift_v=v, magnification=1 + m)


COEFFICIENTS = np.array([0.02, -0.01, 0.03, 0.002, 0.003, 0.004, -0.002])


def test_a_motion_of_the_sample_is_all_gauge(scan, points):
    fit = Gauge(scan, points).fit(gauge_motion(scan, points, COEFFICIENTS))
    np.testing.assert_allclose(fit.remainder, 0, atol=ROUNDING)
    np.testing.assert_allclose(list(fit.coefficients.values()), COEFFICIENTS, atol=1e-7)
    assert tuple(fit.coefficients) == tuple(fit.rms_by_mode) == GAUGE_MODES


def test_remainder_is_what_no_mode_can_make_smaller(scan, points):
    motion = random_motion(97, seed=1, magnification=1e-3)
    fit = Gauge(scan, points).fit(motion)
    table = np.stack([motion.shift_u, motion.shift_v, motion.magnification - 1], axis=1)
    np.testing.assert_allclose(fit.part + fit.remainder, table, atol=ROUNDING)
    pixels = np.array([1, 1, 0.25 * math.hypot(61, 67)])
    columns = gauge_columns(scan, points).reshape(3, 97, 7) * pixels[:, None, None]
    left = np.einsum("vk,kvm->m", fit.remainder * pixels, columns)
    np.testing.assert_allclose(left / np.abs(columns).sum(axis=(0, 1)), 0, atol=ROUNDING)
    again = Gauge(scan, points).fit(
        Motion(shift_u=fit.part[:, 0], shift_v=fit.part[:, 1], magnification=1 + fit.part[:, 2])
    )
    np.testing.assert_allclose(again.part, fit.part, atol=ROUNDING)


def test_without_magnification_neither_scale_nor_dm_is_fitted(scan, points):
    motion = smooth_motion(97, seed=1, magnification=1e-3)
    fit = Gauge(scan, points, magnification=False).fit(motion)
    assert tuple(fit.coefficients) == tuple(m for m in GAUGE_MODES if m != "scale")
    np.testing.assert_array_equal(fit.part[:, 2], 0)
    np.testing.assert_allclose(fit.remainder[:, 2], motion.magnification - 1, atol=ROUNDING)
    still = Motion(shift_u=motion.shift_u, shift_v=motion.shift_v)
    other = Gauge(scan, points, magnification=False).fit(still)
    np.testing.assert_array_equal(other.part, fit.part)


def test_rms_by_mode_is_in_pixels_of_that_mode(scan, points):
    motion = gauge_motion(scan, points, np.array([0, 0, 0.03, 0, 0, 0, 0]))
    fit = Gauge(scan, points).fit(motion)
    quarter = 0.25 * math.hypot(61, 67)
    length = motion.shift_u**2 + motion.shift_v**2 + (quarter * (motion.magnification - 1)) ** 2
    assert fit.rms_by_mode["translation z"] == pytest.approx(math.sqrt(length.mean()))
    assert fit.rms_by_mode["translation x"] < 0.2 * fit.rms_by_mode["translation z"]


def test_a_wrong_centre_of_rotation_is_no_gauge(scan, points):
    aside = Motion(shift_u=np.full(97, 1.0), shift_v=np.zeros(97))
    error = Gauge(scan, points).error(aside, Motion.identity(97))
    assert error.mae_u == 1
    assert error.gauge_free_u > 0.98


def test_error_is_raw_and_gauge_free(scan, points):
    truth = random_motion(97, seed=2, magnification=1e-3)
    gauge = gauge_motion(scan, points, COEFFICIENTS)
    estimate = Motion(
        shift_u=truth.shift_u + gauge.shift_u,
        shift_v=truth.shift_v + gauge.shift_v,
        magnification=truth.magnification + gauge.magnification - 1,
    )
    error = Gauge(scan, points).error(estimate, truth)
    assert error.mae_u == pytest.approx(np.abs(gauge.shift_u).mean())
    assert error.mae_v == pytest.approx(np.abs(gauge.shift_v).mean())
    assert error.mae_m == pytest.approx(np.abs(gauge.magnification - 1).mean())
    assert error.std_u == pytest.approx(np.abs(gauge.shift_u).std())
    assert max(error.gauge_free_u, error.gauge_free_v, error.gauge_free_m) < ROUNDING
    with pytest.raises(ValueError, match="estimate: found 96 views, expected 97"):
        Gauge(scan, points).error(estimate.subset(slice(96)), truth)


def test_errors_do_not_depend_on_the_unit_of_length(scan, points):
    motion = smooth_motion(97, seed=3, magnification=1e-3)
    expected = Gauge(scan, points).error(motion, Motion.identity(97))
    for unit in (1e-6, 1e3):
        scaled = ConeBeamGeometry.from_astra(scan.to_astra() * unit, scan.shape)
        found = Gauge(scaled, points * unit).error(motion, Motion.identity(97))
        assert vars(found) == pytest.approx(vars(expected), rel=1e-6)


@pytest.mark.parametrize("magnification", [False, True])
def test_without_gauge_leaves_a_truth_that_errors_cannot_hide_in(scan, magnification):
    grid = default_grid(scan)
    clouds = [sample_points(grid, seed=seed) for seed in (1, 2)]
    moved = smooth_motion(97, seed=4, magnification=2e-3 * magnification)
    truth = without_gauge(moved, scan, clouds, magnification)
    before, after = (
        np.abs(Gauge(scan, sample_points(grid), magnification=magnification).fit(motion).part)
        for motion in (moved, truth)
    )
    assert without_gauge(moved.caused_by("source"), scan, clouds).cause == "source"
    assert before[:, :2].max() > 3
    # Clouds of other samples would look a little different.
    assert after[:, :2].max() < 0.15
    if magnification:
        assert np.mean(np.log(truth.magnification)) == pytest.approx(0, abs=ROUNDING)
    ratio = truth.magnification / moved.magnification
    np.testing.assert_allclose(ratio, ratio[0] if magnification else 1)


def test_without_gauge_scales_shifts_by_one_factor(scan, points):
    moved = smooth_motion(97, seed=5, magnification=1e-3)
    plain = without_gauge(moved, scan, [points])
    wide = without_gauge(moved, scan, [points], span=18.0)
    assert max(np.ptp(wide.shift_u), np.ptp(wide.shift_v)) == pytest.approx(18)
    factor = np.ptp(wide.shift_u) / np.ptp(plain.shift_u)
    np.testing.assert_allclose(wide.shift_v, factor * plain.shift_v)
    assert wide.magnification == pytest.approx(plain.magnification)


def test_one_view_and_a_circle_have_a_gauge():
    for geometry in (circular(1, **STAGE), circular(12, **STAGE)):
        cloud = sample_points(default_grid(geometry), count=100)
        motion = random_motion(geometry.views, seed=0, magnification=1e-3)
        fit = Gauge(geometry, cloud).fit(motion)
        assert np.isfinite(fit.remainder).all()
        assert np.linalg.norm(fit.remainder[:, :2]) < np.linalg.norm(
            [motion.shift_u, motion.shift_v]
        )
    with pytest.raises(ValueError, match="motion: found 1 views, expected 12"):
        Gauge(geometry, cloud).fit(Motion.identity(1))


def test_sample_points_fill_the_cylinder_of_the_grid():
    grid = VolumeGrid(shape=(40, 10, 12), voxel_size=0.5, centre=(1, 2, 3))
    cloud = sample_points(grid, count=4000)
    x, y, z = (cloud - [1, 2, 3]).T
    radius = np.hypot(x, y)
    assert 2.45 < radius.max() <= 2.5
    assert np.mean(radius < 2.5 / 2) == pytest.approx(0.25, abs=0.03)
    assert np.abs(z).max() <= 10
    assert np.mean(z) == pytest.approx(0, abs=0.3)
    assert np.array_equal(cloud, sample_points(grid, count=4000))
    assert not np.array_equal(cloud, sample_points(grid, count=4000, seed=1))


def test_anchoring_takes_out_what_the_sample_could_have_done() -> None:
    geometry = helix(400, angle_step=0.2, z_step=0.014, **STAGE)
    points = sample_points(default_grid(geometry))
    columns = gauge_columns(geometry, points).reshape(3, 400, -1)
    shift = columns[:2] @ [0.01, -0.02, 0.015, 0.0, 0.0, 0.0, 0.004]
    moved = Motion(shift_u=shift[0], shift_v=shift[1])
    anchored = Gauge(geometry, points, magnification=False).anchored(moved)
    assert np.abs(shift).max() > 0.5
    assert np.abs(anchored.shift_u).max() < 1e-9
    assert np.abs(anchored.shift_v).max() < 1e-9


def test_a_few_views_that_went_far_do_not_move_the_sample(scan, points) -> None:
    rest = random_motion(97, seed=5, shift=(-2, 2))
    gauge = Gauge(scan, points, magnification=False)
    still = gauge.anchored(rest)
    jumped = rest.shift_u.copy()
    jumped[[20, 60]] += 40.0
    anchored = gauge.anchored(Motion(shift_u=jumped, shift_v=rest.shift_v))
    others = np.delete(np.arange(97), [20, 60])
    assert np.abs(anchored.shift_u - still.shift_u)[others].mean() < 0.1
    assert np.abs(anchored.shift_u - still.shift_u)[[20, 60]].min() > 35


def test_movements_that_shifts_cannot_imitate_are_no_gauge() -> None:
    """On a circle whose views see all of the sample a tilt turns its image, it hardly shifts it."""
    geometry = circular(90, **STAGE)
    gauge = Gauge(geometry, sample_points(default_grid(geometry)), magnification=False)
    wobble = np.sin(np.linspace(0, 2 * np.pi, 90, endpoint=False))
    visible = Motion(shift_u=np.zeros(90), shift_v=wobble)
    assert np.abs(gauge.anchored(visible).shift_v - wobble).max() < 0.02


def test_tilts_that_the_data_see_are_not_taken_out(scan, points) -> None:
    """Translations and stretches of this helix are, its tilts shift the images by half of them."""
    gauge = Gauge(scan, points, magnification=False)
    for mode, stays in (("translation x", 0), ("stretch z", 0), ("tilt x", 1)):
        moved = gauge_motion(scan, points, 0.01 * np.equal(GAUGE_MODES, mode))
        shifts = Motion(shift_u=moved.shift_u, shift_v=moved.shift_v)
        left = gauge.anchored(shifts)
        assert gauge.fit(shifts).remainder == pytest.approx(0, abs=ROUNDING)
        kept = np.linalg.norm([left.shift_u, left.shift_v]) / np.linalg.norm(
            [moved.shift_u, moved.shift_v]
        )
        assert kept == pytest.approx(stays, abs=0.1), mode
