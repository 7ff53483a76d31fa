import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pytest
from arrays import with_offset

from clra.ops.images.pyramid import Prolong3D, Restrict2D, Restrict3D

ROUNDING = 4e-7  # of values up to 1
SHAPES = [(2, 2, 2), (3, 5, 7), (4, 6, 37), (5, 3, 64), (2, 9, 33)]


def values(shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(1).uniform(-1, 1, shape).astype(np.float32)


def half(shape: tuple[int, ...], axes: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(n // 2 if axis in axes else n for axis, n in enumerate(shape))


def restricted(array: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    array = array.astype(float)
    for axis in axes:
        even = np.take(array, range(0, array.shape[axis] // 2 * 2, 2), axis)
        odd = np.take(array, range(1, array.shape[axis], 2), axis)
        array = (even + odd) / 2
    return array


def prolonged(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    array = array.astype(float)
    for axis, size in enumerate(shape):
        centres = (np.arange(size) - 0.5) / 2
        array = np.apply_along_axis(
            lambda line, at=centres: np.interp(at, np.arange(len(line)), line), axis, array
        )
    return array


@pytest.mark.parametrize("shape", [*SHAPES, (1, 2, 2), (3, 130, 131)])
def test_restriction_of_images_is_the_mean(context, queue, shape):
    image = values(shape)
    out = with_offset(queue, np.zeros(half(shape, (1, 2)), np.float32))
    Restrict2D(context)(queue, out, with_offset(queue, image))
    np.testing.assert_allclose(out.get(), restricted(image, (1, 2)), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("shape", SHAPES)
def test_restriction_of_volumes_is_the_mean(context, queue, shape):
    volume = values(shape)
    out = with_offset(queue, np.zeros(half(shape, (0, 1, 2)), np.float32))
    Restrict3D(context)(queue, out, with_offset(queue, volume))
    np.testing.assert_allclose(out.get(), restricted(volume, (0, 1, 2)), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("shape", [*SHAPES, (3, 66, 67)])
def test_prolongation_is_trilinear(context, queue, shape):
    volume = values(half(shape, (0, 1, 2)))
    out = with_offset(queue, np.zeros(shape, np.float32))
    Prolong3D(context)(queue, out, with_offset(queue, volume))
    np.testing.assert_allclose(out.get(), prolonged(volume, shape), rtol=0, atol=ROUNDING)


def test_prolongation_keeps_a_slope_in_place(context, queue):
    """Centres stay where they are: coarse centre k is at fine 2 k + 1/2."""
    coarse = np.broadcast_to(2 * np.arange(20, dtype=np.float32) + 0.5, (3, 4, 20))
    out = cl_array.zeros(queue, (6, 8, 40), np.float32)
    Prolong3D(context)(queue, out, cl_array.to_device(queue, np.ascontiguousarray(coarse)))
    np.testing.assert_allclose(out.get()[0, 0, 1:-1], np.arange(1, 39), rtol=1e-6)


def test_out_of_order_queue(context, unordered):
    volume = values((4, 6, 38))
    fine = cl_array.Array(context, volume.shape, np.float32)
    coarse = cl_array.Array(context, (2, 3, 19), np.float32)
    uploaded = cl.enqueue_copy(unordered, fine.base_data, volume, is_blocking=False)
    event = Restrict3D(context)(unordered, coarse, fine, wait_for=[uploaded])
    event = Prolong3D(context)(unordered, fine, coarse, wait_for=[event])
    found = np.empty_like(volume)
    cl.enqueue_copy(unordered, found, fine.base_data, wait_for=[event])
    expected = prolonged(restricted(volume, (0, 1, 2)), volume.shape)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2 * ROUNDING)


def test_what_is_refused(context, queue):
    fine = cl_array.zeros(queue, (4, 6, 10), np.float32)
    with pytest.raises(TypeError, match="fine: found ndarray"):
        Restrict2D(context)(queue, fine, fine.get())
    with pytest.raises(ValueError, match=r"coarse_out: found shape \(4, 6, 10\)"):
        Restrict2D(context)(queue, fine, fine)
    with pytest.raises(ValueError, match="fine: found shape"):
        Restrict3D(context)(queue, fine, fine[:1])
    with pytest.raises(ValueError, match=r"coarse: found shape \(4, 6, 10\), expected \(2, 3, 5\)"):
        Prolong3D(context)(queue, fine, fine)
    with pytest.raises(ValueError, match="fine: found shape"):
        Restrict2D(context)(queue, fine, fine[0])
    with pytest.raises(ValueError, match="fine: found complex64"):
        Restrict2D(context)(queue, fine, cl_array.zeros(queue, (4, 6, 10), np.complex64))
