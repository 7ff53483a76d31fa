import math
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pytest
from scipy import ndimage

from clra.model.motion import Motion
from clra.ops.images.bandpass import Bandpass
from clra.ops.registration import gauss_newton
from clra.ops.registration.gauss_newton import ESTIMATE_FIELDS, Registration
from clra.ops.registration.windows import registration_window
from clra.ops.runtime.buffers import to_device
from clra.ops.runtime.kernel import Step
from clra.ops.runtime.lines import MARGIN, line_stride
from clra.ops.runtime.profile import GPU, device_of, forced

# Errors on 256 x 256 pixels, median over pairs.
SHIFT_BAR, MAGNIFICATION_BAR = 0.03, 2e-4
SHARP = 0.01, 1e-4  # no noise: what moves in and out at the borders
SAME = 2e-3, 5e-5  # against a float64 iteration carried to its end: the last step's length
SUM = 2e-5  # of the product of two terms' norms


@dataclass
class Texture:
    """Gaussian blobs, seen anywhere without resampling."""

    shape: tuple[int, int]
    seed: int = 0

    def __post_init__(self):
        random = np.random.default_rng(self.seed)
        rows, columns = self.shape
        count = max(20, rows * columns // 70)
        self.place = random.uniform(-0.75, 0.75, (count, 2)) * (columns, rows)
        self.width = random.uniform(1.5, 8, count)
        self.height = random.uniform(0.03, 0.15, count) * random.choice([-1, 1], count)

    def image(self, shift=(0.0, 0.0), magnification=1.0, blur=0.0) -> np.ndarray:
        width = np.hypot(magnification * self.width, blur)
        place = magnification * self.place + shift
        height = self.height * (magnification * self.width / width) ** 2
        along_v, along_u = (
            np.exp(-0.5 * ((np.arange(n) - (n - 1) / 2 - at[:, None]) / width[:, None]) ** 2)
            for n, at in zip(self.shape, (place[:, 1], place[:, 0]), strict=True)
        )
        return 1 + (along_v * height[:, None]).T @ along_u


def pairs(n, shape=(256, 256), shift=10.0, magnification=0.002, counts=4000, blur=2.0, slope=0.1):
    """Measured and simulated images, true (shift u, shift v, magnification); wrong gain, offset."""
    random = np.random.default_rng(5)
    truth = np.c_[
        random.uniform(-shift, shift, (n, 2)),
        1 + random.uniform(-magnification, magnification, n),
    ]
    measured, simulated = np.empty((2, n, *shape), np.float32)
    for k in range(n):
        texture = Texture(shape, k)
        image = texture.image(truth[k, :2], truth[k, 2])
        if counts:
            image = -np.log(np.maximum(random.poisson(counts * np.exp(-image)), 1) / counts)
        measured[k] = image
        ramp = slope * np.arange(shape[1]) / shape[1]
        simulated[k] = 0.8 * texture.image(blur=blur) + 0.05 + ramp
    return measured, simulated, truth


def run(context, queue, measured, simulated, **options) -> dict[str, np.ndarray]:
    operator = Registration(context, measured.shape[1:], **options)
    out = cl_array.empty(queue, (len(measured), len(ESTIMATE_FIELDS)), np.float32)
    operator(queue, out, *(cl_array.to_device(queue, i) for i in (measured, simulated)))
    return dict(zip(ESTIMATE_FIELDS, out.get().T, strict=True))


def errors(found, truth) -> tuple[np.ndarray, np.ndarray]:
    shift = np.hypot(found["shift_u"] - truth[:, 0], found["shift_v"] - truth[:, 1])
    return shift, abs(found["magnification"] - truth[:, 2])


def basis(at: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Cubic B-splines (points, n) and their derivatives."""
    d = at[:, None] - np.arange(n)
    a = abs(d)
    value = np.where(a < 1, 2 / 3 - a**2 + a**3 / 2, np.clip(2 - a, 0, None) ** 3 / 6)
    slope = np.where(a < 1, -2 * a + 1.5 * a**2, -(np.clip(2 - a, 0, None) ** 2) / 2)
    return value, np.sign(d) * slope


def terms_of(coefficients, shift, magnification) -> tuple[np.ndarray, ...]:
    """dB/dx, dB/dy, their radial part over half the diagonal, and B, at the moved pixels.

    The border's coefficients go on outside, for one column sideways.
    """
    (rows, columns), radius = coefficients.shape, 0.5 * math.hypot(*coefficients.shape)
    coefficients = np.pad(np.pad(coefficients, [(6, 6), (1, 1)], mode="edge"), [(0, 0), (5, 5)])
    u, v = (
        (np.arange(n) - (n - 1) / 2 - s) / magnification
        for n, s in zip((columns, rows), shift, strict=True)
    )
    (bu, du), (bv, dv) = (basis(at + (n + 11) / 2, n + 12) for at, n in ((u, columns), (v, rows)))
    p, q, b = bv @ coefficients @ du.T, dv @ coefficients @ bu.T, bv @ coefficients @ bu.T
    return p, q, (p * u + q * v[:, None]) / radius, b


def blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    k = np.arange(-math.ceil(3.5 * sigma), math.ceil(3.5 * sigma) + 1)
    taps = np.exp(-0.5 * (k / sigma) ** 2)
    for axis in (0, 1):
        part = ndimage.correlate1d(np.ones(image.shape), taps, axis, mode="constant")
        image = ndimage.correlate1d(image, taps, axis, mode="constant") / part
    return image


def reference(measured, simulated, weights, low_pass=1.0) -> dict[str, float]:
    """The fit in float64 from spline coefficients, iterated to its end."""
    rows, columns = measured.shape
    mixed = [terms_of(measured, (0, 0), 1)[3]]
    mixed += [blurred(mixed[0], 2.0)]
    mixed += [blurred(mixed[1], math.sqrt(12))]
    used, w = weights > 0, weights[weights > 0]
    shift, m, radius = np.zeros(2), 1.0, 0.5 * math.hypot(rows, columns)
    for _ in range(40):
        p, q, s, b = (term[used] for term in terms_of(simulated, shift, m))
        one = np.ones(b.size)
        regressors = np.stack([*(a[used] for a in mixed), one], 1)
        share = np.linalg.lstsq(regressors * np.sqrt(w)[:, None], b * np.sqrt(w), rcond=None)[0]
        a = regressors[:, :3] @ share[:3]
        jacobian = np.stack([p, q, s, b, one], 1)
        x = np.linalg.lstsq(jacobian * np.sqrt(w)[:, None], a * np.sqrt(w), rcond=None)[0]
        step = -m * x[:3] / x[3]
        shift, m = shift + step[:2], m + step[2] / radius
    residual = a - jacobian @ x
    total, variances = share[:3].sum(), low_pass**2 + np.array([0.0, 4.0, 16.0])
    white = share[:3] @ (1 / (2 * np.pi * np.add.outer(variances, variances))) @ share[:3]
    area = total**2 / white
    samples = w.sum() / area
    variance = (w @ residual**2) / w.sum() * area * samples / (samples - 5)
    inverse = np.linalg.inv((jacobian * w[:, None]).T @ jacobian)
    sigma = m / x[3] * np.sqrt(variance * np.diag(inverse)[:3])
    centred_a, centred_b = (i - (w @ i) / w.sum() for i in (a, b))
    norm = math.sqrt((w @ centred_a**2) * (w @ centred_b**2))
    return {
        "shift_u": shift[0],
        "shift_v": shift[1],
        "magnification": m,
        "gain": x[3] / total,
        "offset": x[4] / total,
        "correlation": (w * centred_a) @ centred_b / norm,
        "residual": math.sqrt((w @ residual**2) / w.sum()) / total,
        "sigma_u": sigma[0],
        "sigma_v": sigma[1],
        "sigma_m": sigma[2] / radius,
    }


def test_noisy_blurred_pairs(context, queue):
    measured, simulated, truth = pairs(16)
    found = run(context, queue, measured, simulated)
    shift, magnification = errors(found, truth)
    assert np.median(shift) < SHIFT_BAR and shift.max() < 5 * SHIFT_BAR
    assert np.median(magnification) < MAGNIFICATION_BAR
    np.testing.assert_allclose(found["gain"], 1 / 0.8, rtol=0.03)
    assert found["correlation"].min() > 0.99


def test_sigmas_are_those_of_the_noise(context, queue):
    """Errors over their sigmas, 24 pairs: nearly all below 2, and rms around 1."""
    measured, simulated, truth = pairs(24, (128, 144), shift=3.0, counts=1000)
    found = run(context, queue, measured, simulated)
    for k, (name, sigma) in enumerate(
        [("shift_u", "sigma_u"), ("shift_v", "sigma_v"), ("magnification", "sigma_m")]
    ):
        ratio = (found[name] - truth[:, k]) / found[sigma]
        assert 0.4 < math.sqrt(np.mean(ratio**2)) < 1.5


@pytest.mark.parametrize("coarse", [True, False])
def test_sharp_pairs(context, queue, coarse):
    measured, simulated, truth = pairs(6, counts=0, blur=0.0)
    found = run(context, queue, measured, simulated, coarse=coarse, iterations=10)
    shift, magnification = errors(found, truth)
    assert np.median(shift) < SHARP[0] and np.median(magnification) < SHARP[1]


def test_fourier_shifts(context, queue):
    """Exact shifts of band-limited noise; what leaves at one border comes in at the other."""
    random = np.random.default_rng(1)
    fv, fu = np.fft.fftfreq(180)[:, None], np.fft.rfftfreq(200)[None]
    spectrum = np.fft.rfft2(random.normal(size=(5, 180, 200))) * np.exp(-60 * (fu**2 + fv**2))
    truth = np.c_[random.uniform(-10, 10, (5, 2)), np.ones(5)]
    phase = np.exp(-2j * np.pi * (truth[:, 0, None, None] * fu + truth[:, 1, None, None] * fv))
    measured, simulated = (
        np.fft.irfft2(i, (180, 200)).astype(np.float32) for i in (spectrum * phase, spectrum)
    )
    shift, magnification = errors(run(context, queue, measured, simulated), truth)
    assert shift.max() < 2 * SHARP[0] and magnification.max() < 2 * SHARP[1]


@pytest.mark.parametrize(
    ("shape", "shift", "bar"),
    [((93, 131), 4.0, 0.05), ((48, 64), 2.0, 0.1), ((16, 250), 1.0, 0.2), ((301, 65), 3.0, 0.05)],
)
def test_odd_and_small_shapes(context, queue, shape, shift, bar):
    measured, simulated, truth = pairs(5, shape, shift, counts=0, blur=1.0)
    found = run(context, queue, measured, simulated, magnification=False)
    assert np.median(errors(found, truth)[0]) < bar
    np.testing.assert_array_equal(found["magnification"], 1)
    np.testing.assert_array_equal(found["sigma_m"], 0)


def test_shift_u_is_toward_higher_columns_and_motions_append(context, queue):
    y, x = np.mgrid[:80, :90]
    blob = np.exp(-((x - 50) ** 2 + (y - 38) ** 2) / 40) + np.exp(
        -((x - 30) ** 2 + (y - 45) ** 2) / 20
    )
    moved = np.roll(blob, (-2, 3), (0, 1))
    found = run(context, queue, *(i[None].astype(np.float32) for i in (moved, blob)))
    assert found["shift_u"] == pytest.approx(3, abs=0.02)
    assert found["shift_v"] == pytest.approx(-2, abs=0.02)
    names = ("shift_u", "shift_v", "magnification")
    residual = Motion(**{name: found[name].astype(float) for name in names})
    assert Motion.identity(1).then(residual).shift_u[0] == pytest.approx(3, abs=0.02)


@pytest.mark.parametrize("blur", [0.0, 1.5])
def test_is_the_least_squares_fit(context, queue, blur):
    shape = (44, 52)
    measured, simulated, _ = pairs(3, shape, 1.5, 0.01, counts=3000, blur=blur)
    found = run(context, queue, measured, simulated, high_pass=8.0, iterations=20)
    band = Bandpass(context, shape, views=3, high_pass=8.0)
    coefficients = []
    for images in (measured, simulated):
        out = band.empty()
        band.coefficients(queue, out, band.empty_expanded(), cl_array.to_device(queue, images))
        coefficients.append(out.get(queue)[:, :, MARGIN : MARGIN + shape[1]].astype(float))
    weights = registration_window(shape, 0.12, 1.0)
    for k in range(3):
        expected = reference(coefficients[0][k], coefficients[1][k], weights)
        for name, value in expected.items():
            tolerance = {"shift_u": SAME[0], "shift_v": SAME[0], "magnification": SAME[1]}
            allowed = tolerance.get(name, 1e-5 + 0.01 * abs(value))
            assert found[name][k] == pytest.approx(value, abs=allowed), name


@pytest.mark.parametrize("group", [1, 4, 64])
def test_sums_of_the_normal_equations(context, queue, group):
    views, rows, columns = 2, 23, 37
    random = np.random.default_rng(4)
    stride = line_stride(columns)
    inner = np.s_[..., MARGIN : MARGIN + columns]
    simulated, mixed, weights, valid = (
        np.zeros((*shape, rows, stride), np.float32) for shape in ((views,), (3, views), (), ())
    )
    for image in (simulated, mixed):  # smooth, as after a band-pass
        noise = random.normal(size=(*image.shape[:-1], columns))
        image[inner] = ndimage.gaussian_filter(noise, (*[0] * (noise.ndim - 2), 1, 1))
    simulated[..., MARGIN - 1] = simulated[..., MARGIN]
    simulated[..., MARGIN + columns] = simulated[..., MARGIN + columns - 1]
    weights[4:-3, MARGIN + 5 : MARGIN + 30] = random.uniform(size=(rows - 7, 25))
    valid[inner] = random.uniform(size=(rows, columns)) > 0.1
    motions = np.array([[1.3, -2.6, 0.004], [-0.2, 0.7, -0.01]])
    state = np.zeros((views, 8), np.float32)
    state[:, :3] = motions
    blocks, block_rows, radius = 4, 5, 0.5 * math.hypot(rows, columns)
    sums = cl_array.zeros(queue, (views, blocks, 36), np.float32)
    defines = {"GROUP": group}
    Step(context, "gauss_newton_sums.cl", "normal_equations", (group, 1, 1), defines)(
        queue,
        (group, blocks, views),
        *(sums, to_device(context, mixed), views),
        *(to_device(context, image) for image in (simulated, weights, valid, state)),
        *(rows, columns, stride, 4, rows - 3, 5, 30, block_rows, 1 / radius, views),
    )
    for view, (shift_u, shift_v, growth) in enumerate(motions):
        coefficients = simulated[view][inner].astype(float)
        p, q, s, b = terms_of(coefficients, (shift_u, shift_v), 1 + growth)
        m = 1 + growth
        u = (np.arange(columns) - (columns - 1) / 2 - shift_u) / m
        v = (np.arange(rows) - (rows - 1) / 2 - shift_v) / m
        at = [np.floor(x + (n - 1) / 2 + 0.5).astype(int) for x, n in ((v, rows), (u, columns))]
        reach = np.pad(valid[inner], 12)[np.ix_(at[0] + 12, at[1] + 12)]
        w = weights[inner] * reach
        parts = [p, q, s, b, np.ones((rows, columns)), *mixed[:, view][inner].astype(float)]
        found = sums.get()[view]
        for block in range(blocks):
            used = slice(4 + block * block_rows, min(rows - 3, 4 + (block + 1) * block_rows))
            stack = np.stack([part[used].ravel() for part in parts])
            expected = (stack * w[used].ravel()) @ stack.T
            norm = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
            upper = np.triu_indices(8)
            np.testing.assert_array_less(abs(found[block] - expected[upper]), SUM * norm[upper])


def test_gpu_form_agrees(context, queue):
    """Work-groups that share a view, a pixel an item, the device's own FFT."""
    measured, simulated, _ = pairs(3, (60, 72), 4.0, counts=2000)
    expected = run(context, queue, measured, simulated)
    with forced(GPU):
        found = run(context, queue, measured, simulated)
    for name in ("shift_u", "shift_v"):
        np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=2e-3)
    np.testing.assert_allclose(found["magnification"], expected["magnification"], atol=5e-5)


def test_masked_pixels_do_not_matter(context, queue):
    shape = (128, 150)
    measured, simulated, truth = pairs(4, shape, 2.0, counts=0, blur=1.0)
    mask = np.random.default_rng(2).uniform(size=shape) > 0.005
    mask[:, 60] = mask[:20] = False
    whole = run(context, queue, measured, simulated, mask=mask)
    spoilt = np.where(mask, measured, np.float32(math.nan))
    found = run(context, queue, spoilt, simulated, mask=mask)
    for name in ESTIMATE_FIELDS:
        np.testing.assert_array_equal(found[name], whole[name])
    shift, magnification = errors(found, truth)
    assert np.median(shift) < SHIFT_BAR and np.median(magnification) < 5e-4


@pytest.mark.parametrize("kind", ["blank", "constant", "nan", "inf", "one nan", "rounding"])
@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("coarse", [True, False])
def test_views_without_signal(context, queue, kind, which, coarse):
    shape = (64, 80)
    images = pairs(3, shape, 2.0)[:2]
    expected = run(context, queue, *images, coarse=coarse)
    images[which][1] = {
        "blank": 0,
        "constant": 3.7,
        "nan": math.nan,
        "inf": math.inf,
        "one nan": images[which][1],
        "rounding": 1000 + 1e-4 * images[which][1],
    }[kind]
    if kind == "one nan":
        images[which][1, 30, 41] = math.nan
    found = run(context, queue, *images, coarse=coarse)
    defaults = (0, 0, 1, 1, 0, 0, 0, 80, 80, 1)
    for name, default in zip(ESTIMATE_FIELDS, defaults, strict=True):
        assert found[name][1] == default, name
        np.testing.assert_array_equal(found[name][[0, 2]], expected[name][[0, 2]])


def test_a_view_that_is_not_finite_leaves_nothing_behind(context, queue):
    measured, simulated, _ = pairs(2, (57, 75), 2.0)
    operator = Registration(context, (57, 75))
    devices = [cl_array.to_device(queue, i) for i in (measured, simulated)]
    first, spoilt, second = (cl_array.empty(queue, (2, 10), np.float32) for _ in range(3))
    operator(queue, first, *devices)
    operator(queue, spoilt, *(device * np.float32(math.nan) for device in devices))
    operator(queue, second, *devices)
    np.testing.assert_array_equal(second.get(), first.get())
    assert not spoilt.get()[:, 5].any()


def test_unlike_images_are_told(context, queue):
    """Noise against texture: nothing diverges, and the correlation says that it is nothing."""
    simulated = pairs(8, (96, 96), 0.0)[1]
    measured = np.random.default_rng(0).normal(size=simulated.shape).astype(np.float32)
    found = run(context, queue, measured, simulated)
    assert all(np.isfinite(values).all() for values in found.values())
    assert abs(found["shift_u"]).max() <= 16 and abs(found["shift_v"]).max() <= 16
    assert found["correlation"].max() < 0.5
    assert found["sigma_u"].min() > 0.1


def test_a_direction_without_structure_stays(context, queue):
    x = np.arange(100)
    stripes = sum(np.exp(-(((x - c) / w) ** 2)) for c, w in ((20, 5), (45, 8), (60, 4), (81, 9)))
    images = np.stack([np.tile(np.roll(stripes, k), (80, 1))[None] for k in (2, 0)])
    found = run(context, queue, *images.astype(np.float32), magnification=False)
    assert found["shift_u"] == pytest.approx(2, abs=0.05)
    assert abs(found["shift_v"]) < 0.5
    assert found["sigma_v"] > 20 * found["sigma_u"]


def test_expected_spread_of_the_magnification(context, queue):
    """The mean of what the image says and what is expected, weighted by their variances."""
    measured, simulated, _ = pairs(6, (64, 72), 1.0, 0.01, counts=2000)
    free = run(context, queue, measured, simulated, iterations=12)
    spread, before = 0.005, 0.004
    operator = Registration(context, (64, 72), iterations=12, spread=spread)
    devices = [cl_array.to_device(queue, i) for i in (measured, simulated)]
    out = cl_array.empty(queue, (6, len(ESTIMATE_FIELDS)), np.float32)
    known = cl_array.to_device(queue, np.full(6, before, np.float32))
    operator(queue, out, *devices, known)
    found = dict(zip(ESTIMATE_FIELDS, out.get().T, strict=True))
    image, expected = 1 / free["sigma_m"] ** 2, 1 / spread**2
    growth = (np.log(free["magnification"]) * image - before * expected) / (image + expected)
    moved = abs(np.log(free["magnification"]) - growth)
    assert moved.max() > 1e-3
    assert abs(np.log(found["magnification"]) - growth).max() < 0.1 * moved.max()
    assert (found["sigma_m"] < free["sigma_m"]).all()


def test_shifts_beyond_the_limit_are_not_followed(context, queue):
    measured, simulated, _ = pairs(4, (96, 96), 9.0, counts=0)
    found = run(context, queue, measured, simulated, max_shift=4.0)
    assert max(abs(found["shift_u"]).max(), abs(found["shift_v"]).max()) <= 4.0


def test_any_cut_and_any_offset_give_the_same(context, queue):
    measured, simulated, _ = pairs(5, (70, 85), 3.0)
    whole = run(context, queue, measured, simulated)
    operator = Registration(context, (70, 85), views=2)
    devices = [cl_array.to_device(queue, i) for i in (measured, simulated)]
    out = cl_array.zeros(queue, (7, len(ESTIMATE_FIELDS)), np.float32)
    operator(queue, out[1:5], devices[0][1:], devices[1][1:])
    for k, name in enumerate(ESTIMATE_FIELDS):
        np.testing.assert_array_equal(out.get()[1:5, k], whole[name][1:])
    assert not out.get()[[0, 5, 6]].any()
    single = run(context, queue, measured[3:4], simulated[3:4])
    assert all(single[name] == whole[name][3] for name in ESTIMATE_FIELDS)


def test_out_of_order_queue(context):
    order = cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE
    queue = cl.CommandQueue(context, properties=order)
    operator = Registration(context, (64, 80), views=2)
    batches = [pairs(3, (64, 80), shift)[:2] for shift in (1.0, 2.0, 3.0)]
    devices = [[cl_array.to_device(queue, i) for i in batch] for batch in batches]
    outs = [cl_array.empty(queue, (3, 10), np.float32) for _ in batches]
    queue.finish()
    events = [operator(queue, out, *two) for out, two in zip(outs, devices, strict=True)]
    cl.wait_for_events(events)
    for out, batch in zip(outs, batches, strict=True):
        expected = run(context, cl.CommandQueue(context), *batch)
        np.testing.assert_array_equal(out.get(queue).T, np.stack(list(expected.values())))


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"shape": (12, 80)}, r"shape: found \(12, 80\)"),
        ({"views": 0}, "views: found 0"),
        ({"margin": 0.4}, "margin: found 0.4"),
        ({"iterations": 0}, "iterations: found 0"),
        ({"max_shift": 0.0}, "max_shift: found 0.0"),
        ({"low_pass": 0.1}, "low_pass: found 0.1"),
        ({"mask": np.ones((2, 2))}, "mask: found shape"),
    ],
)
def test_bad_options_are_named(context, options, named):
    with pytest.raises(ValueError, match=named):
        Registration(context, options.pop("shape", (64, 80)), **options)


def test_bad_arrays_are_refused(context, queue):
    operator = Registration(context, (64, 80), views=2)
    good = cl_array.zeros(queue, (2, 64, 80), np.float32)
    out = cl_array.zeros(queue, (2, 10), np.float32)
    with pytest.raises(TypeError, match="measured: found ndarray"):
        operator(queue, out, good.get(), good)
    with pytest.raises(ValueError, match="simulated: found shape"):
        operator(queue, out, good, good[:1])
    with pytest.raises(ValueError, match="estimates_out: found shape"):
        operator(queue, out[:1], good, good)
    other = cl.Context([device_of(context)])
    foreign = cl_array.zeros(cl.CommandQueue(other), (2, 64, 80), np.float32)
    with pytest.raises(ValueError, match="simulated: its context"):
        operator(queue, out, good, foreign)


def test_state_is_as_long_as_the_kernels_say():
    assert (gauss_newton._STATE, gauss_newton._SUMS) == (8, 36)
