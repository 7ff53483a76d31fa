"""Statistics of counted photons against the same formulas in float64."""

import numpy as np
import pyopencl.array as cl_array
import pytest
from arrays import with_offset

from clra.ops.statistics.poisson import RayStatistics, VolumeStep

SHAPE = (5, 7, 9)  # views, rows, columns
BACKGROUND = 3.0
TOLERANCE = 2e-5


@pytest.fixture(scope="module")
def rays():
    random = np.random.default_rng(0)
    simulated = random.uniform(0, 6, SHAPE).astype(np.float32)
    measured = (simulated + random.normal(0, 0.2, SHAPE)).astype(np.float32)
    simulated[0, 0, :3] = 0.0, 0.001, 0.03
    measured[1, 1, 1] = -7.0  # a hot pixel
    measured[1, 1, 2] = 40.0  # a dead one
    open_beam = random.uniform(500, 1500, SHAPE[1:])
    open_beam[2, 3:6] = 0  # masked
    return simulated, measured, open_beam


@pytest.fixture(params=[0.0, BACKGROUND])
def case(request, context, rays):
    simulated, measured, open_beam = rays
    b, r = open_beam.astype(np.float32).astype(float), request.param
    p = np.clip(measured.astype(float), -1, 30)
    y, direct = b * np.exp(-p) + r, b * np.exp(-simulated.astype(float))
    return RayStatistics(context, open_beam, r), b, r, y, direct


def test_gradient_is_the_likelihoods(context, queue, rays, case):
    statistics, b, r, y, direct = case
    simulated, measured = (with_offset(queue, image) for image in rays[:2])
    statistics.gradient(queue, simulated, simulated, measured)
    with np.errstate(invalid="ignore"):
        expected = np.where(b > 0, (1 - y / (direct + r)) * direct, 0)
    np.testing.assert_allclose(simulated.get(), expected, rtol=TOLERANCE, atol=1e-3)
    # The same by differences of the likelihood itself.
    step, some = 1e-4, (3, 4, 5)
    l = rays[0][some].astype(float)  # noqa: E741  # the formula's own symbol
    q = b[some[1:]] * np.exp(-(l + np.array([-step, step]))) + r
    rise = np.diff(y[some] * np.log(q) - q)[0] / (2 * step)
    assert simulated.get()[some] == pytest.approx(rise, rel=1e-3)


def test_deviances_add_up_until_they_are_asked_for(context, queue, rays, case):
    statistics, b, r, y, direct = case
    q = direct + r
    with np.errstate(divide="ignore", invalid="ignore"):
        each = np.where(y > 0, 2 * (q - y + y * np.log(y / q)), 0)
    expected = np.where(b > 0, each, 0).sum() / (np.count_nonzero(b) * SHAPE[0])
    images = [with_offset(queue, image) for image in rays[:2]]
    for views in (slice(0, 2), slice(2, 5)):
        statistics.deviance(queue, *(image[views] for image in images))
    assert statistics.misfit(queue, SHAPE[0]) == pytest.approx(expected, rel=1e-4)
    assert statistics.misfit(queue, SHAPE[0]) == 0


def test_deviance_keeps_its_digits_where_counts_nearly_agree(context, queue):
    statistics = RayStatistics(context, np.full((1, 1), 1e6))
    simulated = cl_array.to_device(queue, np.full((1, 1, 1), 1.001, np.float32))
    measured = cl_array.to_device(queue, np.full((1, 1, 1), 1.0, np.float32))
    statistics.deviance(queue, simulated, measured)
    t = np.float64(np.float32(1.001)) - 1
    expected = 2e6 * np.exp(-1) * (np.expm1(-t) + t)
    assert statistics.misfit(queue, 1) == pytest.approx(expected, rel=1e-3)


def test_curvatures(context, queue, rays, case):
    statistics, b, r, y, direct = case
    chords = np.random.default_rng(1).uniform(0, 4, SHAPE).astype(np.float32)
    weighted, measured = with_offset(queue, chords), with_offset(queue, rays[1])
    statistics.curvature(queue, weighted, weighted, measured)
    with np.errstate(invalid="ignore"):
        expected = np.where(b > 0, chords * (y - r) ** 2 / y, 0)
    np.testing.assert_allclose(weighted.get(), expected, rtol=TOLERANCE)

    simulated, lengths = with_offset(queue, rays[0]), with_offset(queue, chords)
    statistics.optimal_curvature(queue, simulated, simulated, lengths, measured)
    found = simulated.get() / np.maximum(chords, 1e-6)
    # The parabola touches h at l and lies above it everywhere.
    l = rays[0].astype(float)  # noqa: E741  # the formula's own symbol
    used = np.broadcast_to(b > 0, SHAPE)

    def h(integral):
        q = b * np.exp(-integral) + r
        return q - y * np.log(np.where(q > 0, q, 1))

    slope = -direct + np.where(used, y * direct / np.where(used, direct + r, 1), 0)
    for other in np.linspace(0, 8, 33):
        parabola = h(l) + slope * (other - l) + found / 2 * (other - l) ** 2
        assert (parabola[used] > h(other)[used] - 1e-3 * np.abs(h(other)[used])).all()
    assert (found[~used] == 0).all()
    # And no lower one would, but for l = 0: it meets h there again.
    away = used & (l > 0.5) & (found > 1e-3)
    meets = h(l) - slope * l + found / 2 * l**2
    np.testing.assert_allclose(meets[away], h(0 * l)[away], rtol=1e-3, atol=0.1)


def test_balance(context, queue, rays, case):
    statistics, b, r, y, direct = case
    simulated, measured = (with_offset(queue, image) for image in rays[:2])
    found = with_offset(queue, np.zeros(SHAPE, np.float32))
    statistics.balance(queue, simulated, found, measured)
    np.testing.assert_allclose(simulated.get(), direct, rtol=TOLERANCE)
    with np.errstate(invalid="ignore"):
        expected = np.where(b > 0, direct * y / (direct + r), 0)
    np.testing.assert_allclose(found.get(), expected, rtol=TOLERANCE)


def test_volume_steps(context, queue):
    random = np.random.default_rng(2)
    volume, numerator, denominator = random.uniform(0.1, 1, (3, 4, 3, 5)).astype(np.float32)
    numerator -= 0.6
    denominator[0, 0] = 1e-6  # hardly met by a ray
    arrays = [with_offset(queue, part) for part in (volume, numerator, denominator)]
    VolumeStep(context).add(queue, *arrays, 3.0, 1e-5)
    expected = np.maximum(0, volume + 3 * numerator / denominator)
    expected[0, 0] = volume[0, 0]
    np.testing.assert_allclose(arrays[0].get(), expected, rtol=1e-6, atol=1e-6)
    assert (expected == 0).any()

    numerator = np.abs(numerator)
    numerator[1, 1], denominator[1, 1] = 0, 0  # met by no ray
    arrays = [with_offset(queue, part) for part in (volume, numerator, denominator)]
    VolumeStep(context).multiply(queue, *arrays)
    with np.errstate(invalid="ignore"):
        ratio = np.clip(numerator / denominator, 0.25, 4)
    ratio[1, 1] = 1
    np.testing.assert_allclose(arrays[0].get(), volume * ratio, rtol=1e-6)


@pytest.mark.parametrize("open_beam", [np.ones(3), -np.ones((2, 2)), np.full((2, 2), np.nan)])
def test_bad_photons_are_refused(context, open_beam):
    with pytest.raises(ValueError, match=r"open_beam: found shape .* expected photons"):
        RayStatistics(context, open_beam)


def test_other_shapes_are_refused(context, queue):
    statistics = RayStatistics(context, np.ones((3, 4)))
    right, wrong = (cl_array.zeros(queue, (2, 3, n), np.float32) for n in (4, 5))
    with pytest.raises(ValueError, match="measured: found shape"):
        statistics.gradient(queue, right, right, wrong)
    with pytest.raises(ValueError, match="background"):
        RayStatistics(context, np.ones((3, 4)), -1.0)
