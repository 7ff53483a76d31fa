import math

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pytest
from scipy import ndimage

from clra.ops.images.bandpass import Bandpass
from clra.ops.registration.phase_correlation import CoarseShift, PhaseCorrelation
from clra.ops.registration.windows import registration_window, tukey
from clra.ops.runtime.profile import device_of

SAME = 2e-3  # pixels, against the same steps in float64
BIAS = 0.2  # pixels: a parabola through a peak that is none, and a window that stands still
COARSE = 1.0  # pixels, where Gauss-Newton starts


def noise(shape, n=4, width=1.0, seed=0) -> np.ndarray:
    values = np.random.default_rng(seed).normal(size=(n, *shape))
    return ndimage.gaussian_filter(values, (0, width, width), mode="wrap")


def shifted(images: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Exact cyclic shifts (u, v)."""
    rows, columns = images.shape[1:]
    fv, fu = np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)[None]
    phase = np.exp(-2j * np.pi * (shifts[:, 0, None, None] * fu + shifts[:, 1, None, None] * fv))
    return np.fft.irfft2(np.fft.rfft2(images) * phase, (rows, columns))


def run(context, queue, measured, simulated, **options) -> np.ndarray:
    operator = PhaseCorrelation(context, measured.shape[1:], **options)
    out = cl_array.empty(queue, (len(measured), 2), np.float32)
    device = [cl_array.to_device(queue, i.astype(np.float32)) for i in (measured, simulated)]
    operator(queue, out, *device)
    return out.get()


def reference(measured, simulated) -> np.ndarray:
    """The paper's estimator in float64."""
    found = []
    for pair in zip(measured, simulated, strict=True):
        rows, columns = pair[0].shape
        window = np.outer(tukey(rows, 0.35), tukey(columns, 0.35))
        a, b = (np.fft.fft2((i - i.mean()) * window) for i in pair)
        power = a * b.conj()
        mean = abs(power[:, : columns // 2 + 1]).mean()
        peaks = np.fft.ifft2(power / (abs(power) + 0.01 * mean)).real
        v, u = np.unravel_index(peaks.argmax(), peaks.shape)
        near = np.array(
            [[peaks[(v + j) % rows, (u + i) % columns] for i in (-1, 0, 1)] for j in (-1, 0, 1)]
        )
        j, i = (k.ravel() for k in np.mgrid[-1:2, -1:2])
        terms = np.stack([np.ones(9), i, j, i * i, i * j, j * j], 1)
        q = np.linalg.lstsq(terms, near.ravel(), rcond=None)[0]
        top = np.linalg.solve([[2 * q[3], q[4]], [q[4], 2 * q[5]]], -q[1:3])
        whole = [k - n if k > n // 2 else k for k, n in ((u, columns), (v, rows))]
        found.append(np.clip(top, -1, 1) + whole)
    return np.array(found)


@pytest.mark.parametrize("group", [1, 8])
@pytest.mark.parametrize("shape", [(64, 80), (90, 45), (75, 81)])
def test_is_the_papers_estimator(context, queue, monkeypatch, shape, group):
    monkeypatch.setattr("clra.ops.registration.phase_correlation.group", lambda *_: group)
    images = noise(shape)
    truth = np.random.default_rng(1).uniform(-6, 6, (4, 2))
    measured = 0.3 + shifted(images, truth)
    found = run(context, queue, measured, images)
    np.testing.assert_allclose(found, reference(measured, images), rtol=0, atol=SAME)
    np.testing.assert_allclose(found, truth, rtol=0, atol=BIAS)


def test_length_without_small_factors(context, queue):
    """Padded by zeros, which the window's zero borders allow."""
    images = noise((93, 131))
    truth = np.random.default_rng(1).uniform(-6, 6, (4, 2))
    found = run(context, queue, shifted(images, truth), images)
    np.testing.assert_allclose(found, truth, rtol=0, atol=BIAS)


def test_shift_u_is_toward_higher_columns(context, queue):
    images = noise((64, 80), 1)
    found = run(context, queue, np.roll(images, (-2, 3), (1, 2)), images)
    np.testing.assert_allclose(found, [[3, -2]], rtol=0, atol=BIAS)


def test_limit_of_the_search(context, queue):
    images = noise((64, 80))
    truth = np.array([[9.0, 0.0], [0.0, -12.0], [3.0, 2.0], [-10.0, 10.0]])
    found = run(context, queue, shifted(images, truth), images, max_shift=4)
    assert abs(found).max() <= 5
    np.testing.assert_allclose(found[2], truth[2], rtol=0, atol=BIAS)


def test_a_faint_share_of_itself_does_not_hold_a_radiograph_back(context, queue):
    """Blurred by motion, a re-projection has high frequencies from its own radiograph alone."""
    sharp = noise((128, 128), width=0.7)
    truth = np.random.default_rng(2).uniform(-6, 6, (4, 2))
    measured = shifted(sharp, truth)
    blurred = ndimage.gaussian_filter(sharp, (0, 3, 3), mode="wrap") + 1e-5 * measured
    found = run(context, queue, measured, blurred)
    np.testing.assert_allclose(found, truth, rtol=0, atol=BIAS)


@pytest.mark.parametrize("value", [0.0, 2.5, math.nan, math.inf])
def test_images_without_signal_give_no_shift(context, queue, value):
    images = noise((64, 80), 3)
    measured = shifted(images, np.full((3, 2), 2.0))
    measured[1] = value
    found = run(context, queue, measured, images)
    assert np.isfinite(found).all()
    if not value:
        np.testing.assert_array_equal(found[1], 0)
    np.testing.assert_allclose(found[[0, 2]], 2, rtol=0, atol=BIAS)


def test_any_cut_and_any_offset_give_the_same(context, queue):
    images = noise((64, 75), 5).astype(np.float32)
    measured = shifted(images, np.full((5, 2), -3.3)).astype(np.float32)
    whole = run(context, queue, measured, images, views=5)
    operator = PhaseCorrelation(context, (64, 75), views=2)
    out = cl_array.zeros(queue, (6, 2), np.float32)
    device = [cl_array.to_device(queue, i) for i in (measured, images)]
    operator(queue, out[1:5], device[0][1:], device[1][1:])
    np.testing.assert_array_equal(out.get()[1:5], whole[1:])
    assert not out.get()[[0, 5]].any()


def test_out_of_order_queue(context):
    order = cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE
    queue = cl.CommandQueue(context, properties=order)
    operator = PhaseCorrelation(context, (64, 80), views=2)
    images = noise((64, 80)).astype(np.float32)
    truths = [np.full((4, 2), shift) for shift in (-4.0, 1.0, 5.0)]
    simulated = cl_array.to_device(queue, images)
    devices = [
        cl_array.to_device(queue, shifted(images, truth).astype(np.float32)) for truth in truths
    ]
    outs = [cl_array.empty(queue, (4, 2), np.float32) for _ in truths]
    queue.finish()
    events = [operator(queue, o, d, simulated) for o, d in zip(outs, devices, strict=True)]
    cl.wait_for_events(events)
    for out, truth in zip(outs, truths, strict=True):
        np.testing.assert_allclose(out.get(queue), truth, rtol=0, atol=BIAS)


@pytest.mark.parametrize("shape", [(128, 140), (93, 131)])
def test_coarse_shift(context, queue, shape):
    images = noise(shape, 6, 1.5)
    truth = np.random.default_rng(3).uniform(-10, 10, (6, 2))
    blurred = ndimage.gaussian_filter(images, (0, 2, 2), mode="wrap")
    pair = (shifted(images, truth), blurred)
    band = Bandpass(context, shape, views=6)
    coefficients = []
    for image in pair:
        coefficients.append(band.empty())
        device = cl_array.to_device(queue, image.astype(np.float32))
        band.coefficients(queue, coefficients[-1], band.empty_expanded(), device)
    window = registration_window(shape, 0.12, 1.0)
    coarse = CoarseShift(context, window, views=6, max_shift=16)
    out = cl_array.empty(queue, (6, 2), np.float32)
    coarse(queue, out, *coefficients)
    np.testing.assert_allclose(out.get(), truth, rtol=0, atol=COARSE)


def test_bad_arrays_are_refused(context, queue):
    operator = PhaseCorrelation(context, (64, 80))
    good = cl_array.zeros(queue, (2, 64, 80), np.float32)
    out = cl_array.zeros(queue, (2, 2), np.float32)
    with pytest.raises(TypeError, match="measured: found ndarray"):
        operator(queue, out, good.get(), good)
    with pytest.raises(ValueError, match="simulated: found float64"):
        operator(queue, out, good, good.astype(np.float64))
    with pytest.raises(ValueError, match="measured: found shape"):
        operator(queue, out, cl_array.zeros(queue, (2, 80, 64), np.float32), good)
    with pytest.raises(ValueError, match="shifts_out: found shape"):
        operator(queue, out[:1], good, good)
    other = cl.Context([device_of(context)])
    foreign = cl_array.zeros(cl.CommandQueue(other), (2, 64, 80), np.float32)
    with pytest.raises(ValueError, match="simulated: its context"):
        operator(queue, out, good, foreign)
