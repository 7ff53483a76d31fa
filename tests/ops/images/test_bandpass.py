import math

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pytest
from scipy import ndimage

from clra.ops.images.bandpass import Bandpass
from clra.ops.runtime.profile import CPU, GPU

ROUNDING = 3e-6  # of images of values around 1
GAUSSIAN = 0.01  # of the filtered image's largest value: splines and cut-off taps for Gaussians
SHAPES = [(37, 45), (64, 64), (93, 131), (48, 70)]


def images(shape: tuple[int, int], n: int = 2, seed: int = 3) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(n, *shape))
    return (1 + ndimage.gaussian_filter(noise, (0, 1.5, 1.5))).astype(np.float32)


def run(context, queue, image: np.ndarray, **options) -> np.ndarray:
    operator = Bandpass(context, image.shape[1:], views=len(image), **options)
    out = cl_array.zeros(queue, image.shape, np.float32)
    operator(queue, out, cl_array.to_device(queue, image))
    return out.get()


def gaussian(sigma: float) -> np.ndarray:
    k = np.arange(-math.ceil(3.5 * sigma), math.ceil(3.5 * sigma) + 1)
    taps = np.exp(-0.5 * (k / sigma) ** 2)
    return taps / taps.sum()


def separable(image: np.ndarray, taps_v: np.ndarray, taps_u: np.ndarray) -> np.ndarray:
    once = ndimage.correlate1d(image, taps_v, 0, mode="constant")
    return ndimage.correlate1d(once, taps_u, 1, mode="constant")


def reference(image: np.ndarray, low: float, high: float, factor: int, mask=None) -> np.ndarray:
    """Float64, and the plane fitted point by point instead of by moments."""
    image = image.astype(float)
    counts = np.ones(image.shape) if mask is None else mask.astype(float)
    narrow = gaussian(math.sqrt(low**2 - 1 / 3))
    c = separable(image * counts, narrow, narrow)
    c /= np.maximum(separable(counts, narrow, narrow), 0.1)

    # Complete blocks, and a rim around them where the plane is continued.
    blocks = [n // factor for n in image.shape]
    cut = (blocks[0], factor, blocks[1], factor)
    inside = np.s_[: blocks[0] * factor, : blocks[1] * factor]
    means, parts = (
        np.pad((i * counts)[inside].reshape(cut).mean((1, 3)), (2, 3))
        for i in (image, np.ones(image.shape))
    )
    sigma = math.sqrt(high**2 - 1 / 3 - (factor**2 - 1) / 12 - factor**2 / 3) / factor
    reach = math.ceil(3.5 * sigma)
    y, x = np.mgrid[: means.shape[0], : means.shape[1]]
    wide = np.empty(means.shape)
    for j in range(means.shape[0]):
        for i in range(means.shape[1]):
            near = (abs(y - j) <= reach) & (abs(x - i) <= reach)
            weight = near * np.exp(-0.5 * ((y - j) ** 2 + (x - i) ** 2) / sigma**2)
            plane = np.stack([np.ones(means.shape), x - i, y - j]).reshape(3, -1)
            matrix = (plane * (weight * parts).ravel()) @ plane.T
            wide[j, i] = np.linalg.solve(matrix, plane @ (weight * means).ravel())[0]
    at = [(np.arange(n) - (factor - 1) / 2) / factor + 2 for n in image.shape]
    c -= spline(at[0], means.shape[0]) @ wide @ spline(at[1], means.shape[1]).T
    pixels = [spline(np.arange(n), n) for n in image.shape]
    return pixels[0] @ c @ pixels[1].T


def spline(at: np.ndarray, n: int) -> np.ndarray:
    """Cubic B-spline matrix (points, coefficients), the border's coefficients going on outside."""
    matrix = np.zeros((len(at), n))
    for k in range(-2, n + 2):
        d = abs(at - k)
        weight = np.where(d < 1, 2 / 3 - d**2 + d**3 / 2, np.clip(2 - d, 0, None) ** 3 / 6)
        matrix[:, np.clip(k, 0, n - 1)] += weight
    return matrix


@pytest.mark.parametrize("form", [CPU, GPU], ids=["cpu", "gpu"], indirect=True)
@pytest.mark.parametrize(
    ("shape", "low", "high", "factor"),
    [((37, 45), 1.0, 9.0, 4), ((33, 64), 0.7, 3.9, 1), ((40, 35), 1.5, 8.0, 2)],
)
def test_is_the_formula(context, queue, form, shape, low, high, factor):
    image = images(shape)
    found = run(context, queue, image, low_pass=low, high_pass=high)
    for one, expected in zip(found, image, strict=True):
        expected = reference(expected, low, high, factor)
        np.testing.assert_allclose(one, expected, rtol=0, atol=ROUNDING)


def test_masked_is_the_formula(context, queue):
    image = images((41, 52))
    mask = np.ones((41, 52), bool)
    mask[:, 17] = mask[9, 30] = mask[30:, 40:] = False
    found = run(context, queue, image, high_pass=9.0, mask=mask)
    supported = ndimage.binary_dilation(mask)
    for one, expected in zip(found, image, strict=True):
        expected = reference(expected, 1.0, 9.0, 4, mask)
        # Far from all that counts the coefficients are 0, which the spline mixes in.
        inside = ndimage.binary_erosion(supported, iterations=3, border_value=1)
        np.testing.assert_allclose(one[inside], expected[inside], rtol=0, atol=ROUNDING)


def test_is_a_difference_of_gaussians(context, queue):
    image = images((200, 230), n=1)
    found = run(context, queue, image, low_pass=1.2, high_pass=16.0)[0]
    wanted = ndimage.gaussian_filter(image[0].astype(float), 1.2)
    wanted -= ndimage.gaussian_filter(image[0].astype(float), 16.0)
    inner = np.s_[64:-64, 64:-64]
    np.testing.assert_allclose(found[inner], wanted[inner], rtol=0, atol=GAUSSIAN * wanted.max())


@pytest.mark.parametrize("shape", SHAPES)
def test_slopes_leave_nothing(context, queue, shape):
    y, x = np.mgrid[: shape[0], : shape[1]]
    image = (2 + 0.01 * x - 0.02 * y)[None].astype(np.float32)
    found = run(context, queue, image)[0]
    # The narrow filter, which is a mean of what there is, bends the outermost pixels.
    np.testing.assert_allclose(found[5:-5, 5:-5], 0, atol=ROUNDING)


@pytest.mark.parametrize("value", [7.0, math.nan, math.inf])
def test_masked_values_do_not_matter(context, queue, value):
    image = images((50, 61))
    mask = np.random.default_rng(0).uniform(size=(50, 61)) > 0.05
    mask[:8] = False
    spoilt = np.where(mask, image, np.float32(value))
    expected, found = (run(context, queue, i, mask=mask) for i in (image, spoilt))
    np.testing.assert_array_equal(found, expected)


def test_large_sigma_is_clipped_to_the_image(context):
    assert Bandpass(context, (48, 64), views=1).high_pass == 12
    assert Bandpass(context, (128, 232), views=1).high_pass == 16


def test_arrays_with_an_offset_and_fewer_views(context, queue):
    image = images((37, 45), n=3)
    operator = Bandpass(context, (37, 45), views=5)
    device = cl_array.to_device(queue, image)
    out = cl_array.zeros(queue, (4, 37, 45), np.float32)
    operator(queue, out[1:3], device[1:])
    whole = run(context, queue, image)
    np.testing.assert_array_equal(out.get()[1:3], whole[1:])
    assert not out.get()[[0, 3]].any()


def test_out_of_order_queue(context, queue, unordered):
    operator = Bandpass(context, (64, 64), views=2)
    batches = [images((64, 64), seed=k) for k in range(4)]
    devices = [cl_array.to_device(unordered, batch) for batch in batches]
    outs = [cl_array.empty_like(device) for device in devices]
    unordered.finish()
    events = [operator(unordered, out, one) for out, one in zip(outs, devices, strict=True)]
    cl.wait_for_events(events)
    for out, batch in zip(outs, batches, strict=True):
        np.testing.assert_array_equal(out.get(unordered), run(context, queue, batch))


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"low_pass": 0.5}, "low_pass: found 0.5"),
        ({"low_pass": 5.0}, "low_pass: found 5.0"),
        ({"low_pass": 2.0, "high_pass": 3.0}, "high_pass: found 3.0"),
        ({"mask": np.ones((3, 4))}, r"mask: found shape \(3, 4\)"),
        ({"mask": np.zeros((32, 40))}, "mask: found no pixel"),
    ],
)
def test_bad_options_are_named(context, options, named):
    with pytest.raises(ValueError, match=named):
        Bandpass(context, (32, 40), views=1, **options)


def test_bad_arrays_are_refused(context, queue):
    operator = Bandpass(context, (32, 40), views=2)
    good = cl_array.zeros(queue, (2, 32, 40), np.float32)
    with pytest.raises(TypeError, match="images: found ndarray"):
        operator(queue, good, good.get())
    with pytest.raises(ValueError, match="images: found shape"):
        operator(queue, good, cl_array.zeros(queue, (2, 40, 32), np.float32))
    with pytest.raises(ValueError, match="found 3 of them, expected 1 to 2"):
        operator(queue, good, cl_array.zeros(queue, (3, 32, 40), np.float32))
