import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pytest
from scipy import ndimage

from clra.ops.images.warp import Warp

IDENTITY = 1e-6  # of values up to 1: rounding of the coefficients
SPLINE = 1e-5  # likewise, where they are interpolated
SHAPES = [(37, 45), (64, 64), (9, 130), (40, 7), (1, 33), (21, 1), (2, 3)]


def images(n: int, shape: tuple[int, int], seed: int = 2) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (n, *shape)).astype(np.float32)


def corrected(image: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Float64 reference: scipy's spline of one image."""
    (rows, columns), (shift_u, shift_v, magnification) = image.shape, motion.astype(float)
    v, u = (
        np.clip(magnification * (np.arange(n) - (n - 1) / 2) + (n - 1) / 2 + shift, 0, n - 1)
        for n, shift in ((rows, shift_v), (columns, shift_u))
    )
    for axis, at in enumerate((v, u)):
        if image.shape[axis] > 1:  # scipy knows no mirror image of a single sample
            spline = ndimage.spline_filter1d(image.astype(float), 3, axis=axis, mode="mirror")
            image = along(spline, at, axis)
    return image


def along(spline: np.ndarray, at: np.ndarray, axis: int) -> np.ndarray:
    """Values of one-dimensional splines of the given coefficients."""

    def line(coefficients: np.ndarray) -> np.ndarray:
        return ndimage.map_coordinates(coefficients, [at], order=3, prefilter=False, mode="mirror")

    return np.apply_along_axis(line, axis, spline)


def run(context, queue, image: np.ndarray, motion: np.ndarray) -> np.ndarray:
    out = cl_array.zeros(queue, image.shape, np.float32)
    device = cl_array.to_device(queue, image)
    Warp(context, image.shape[1:])(queue, out, device, cl_array.to_device(queue, motion))
    return out.get()


@pytest.mark.parametrize("shape", SHAPES)
def test_no_motion_changes_nothing(context, queue, shape):
    image = images(2, shape)
    found = run(context, queue, image, np.array([[0, 0, 1]] * 2, np.float32))
    np.testing.assert_allclose(found, image, rtol=0, atol=IDENTITY)


@pytest.mark.parametrize("shape", SHAPES)
def test_motion_is_scipys_spline(context, queue, shape):
    """Small and large shifts, shifts off the image, magnifications near 1 and far from it."""
    motion = np.array(
        [[0.3, -0.7, 1.0], [-2.25, 1.5, 1.003], [5.5, -40.0, 0.93], [200.0, 3.1, 1.6]], np.float32
    )
    image = images(len(motion), shape)
    expected = [corrected(one, m) for one, m in zip(image, motion, strict=True)]
    np.testing.assert_allclose(run(context, queue, image, motion), expected, rtol=0, atol=SPLINE)


def test_a_feature_goes_back_to_where_it_was(context, queue):
    """A blob that the motion put at c + m (q - c) + t is at q again."""
    rows, columns, q = 60, 81, np.array([50.0, 22.0])
    centre = np.array([(columns - 1) / 2, (rows - 1) / 2])
    shift, magnification = np.array([3.4, -2.2]), 1.04
    u, v = magnification * (q - centre) + centre + shift
    j, i = np.mgrid[:rows, :columns]
    blob = np.exp(-((i - u) ** 2 + (j - v) ** 2) / (2 * 3.0**2)).astype(np.float32)
    motion = np.array([[*shift, magnification]], np.float32)
    found = run(context, queue, blob[None], motion)[0].astype(float)
    at = np.array([np.sum(found * i), np.sum(found * j)]) / np.sum(found)
    np.testing.assert_allclose(at, q, atol=2e-3)


def test_wide_detectors_keep_the_fraction_of_a_pixel(context, queue):
    """A position of 6000 in single precision is 5e-4 wide."""
    columns, inner = 6000, slice(20, 5980)
    image = np.sin(np.arange(columns, dtype=float))
    motion = np.array([[0.123, 0, 1]], np.float32)
    found = run(context, queue, image.astype(np.float32)[None, None], motion)[0, 0]
    spline = ndimage.spline_filter1d(image, 3, mode="mirror")
    expected = along(spline, np.arange(columns)[inner] + float(motion[0, 0]), 0)
    np.testing.assert_allclose(found[inner], expected, rtol=0, atol=SPLINE)


def test_any_chunk_gives_the_same(context, queue):
    image = images(5, (20, 33))
    rng = np.random.default_rng(3)
    motion = np.column_stack([rng.uniform(-3, 3, (5, 2)), rng.uniform(0.98, 1.02, 5)])
    motion = motion.astype(np.float32)
    expected = run(context, queue, image, motion)
    two_images = 2 * 4 * 20 * 80
    operator = Warp(context, (20, 33), scratch_limit=2 * two_images)
    device, moves = cl_array.to_device(queue, image), cl_array.to_device(queue, motion)
    for part in (slice(1, 2), slice(2, 5), slice(0, 1)):
        operator(queue, device[part], device[part], moves[part])  # in place, with an offset
    np.testing.assert_array_equal(device.get(), expected)


def test_a_motion_of_nan_reads_no_foreign_memory(context, queue):
    motion = np.array([[np.nan, 0, 1], [0, 0, np.inf], [1e30, -1e30, 1]], np.float32)
    found = run(context, queue, images(3, (8, 9)), motion)
    assert found.shape == (3, 8, 9)
    assert np.all(np.isfinite(found[2]))


def test_out_of_order_queue(context, unordered):
    motion = np.array([[1.5, -0.5, 1.01]], np.float32)
    operator = Warp(context, (30, 41))
    found = np.empty((2, 1, 30, 41), np.float32)
    both = [images(1, (30, 41), seed) for seed in (0, 1)]
    for image, result in zip(both, found, strict=True):
        device, out = (cl_array.Array(context, image.shape, np.float32) for _ in range(2))
        moves = cl_array.Array(context, motion.shape, np.float32)
        events = [
            cl.enqueue_copy(unordered, device.base_data, image, is_blocking=False),
            cl.enqueue_copy(unordered, moves.base_data, motion, is_blocking=False),
        ]
        done = operator(unordered, out, device, moves, wait_for=events)
        cl.enqueue_copy(unordered, result, out.base_data, wait_for=[done])
    for image, result in zip(both, found, strict=True):
        np.testing.assert_allclose(result[0], corrected(image[0], motion[0]), rtol=0, atol=SPLINE)


def test_what_is_refused(context, queue):
    operator = Warp(context, (8, 9))
    image = cl_array.zeros(queue, (2, 8, 9), np.float32)
    motion = cl_array.zeros(queue, (2, 3), np.float32)
    with pytest.raises(TypeError, match="measured: found ndarray"):
        operator(queue, image, image.get(), motion)
    with pytest.raises(ValueError, match="measured: found shape"):
        operator(queue, image, cl_array.zeros(queue, (2, 9, 8), np.float32), motion)
    with pytest.raises(ValueError, match="corrected_out: found shape"):
        operator(queue, image[:1], image, motion)
    with pytest.raises(ValueError, match=r"motion: found shape \(1, 3\), expected \(2, 3\)"):
        operator(queue, image, image, motion[:1])
    with pytest.raises(ValueError, match="shape: found"):
        Warp(context, (0, 9))
