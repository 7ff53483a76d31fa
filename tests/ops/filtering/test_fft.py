import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pytest
from arrays import with_offset

from clra.ops.filtering.fft import BACKENDS, RealFFT, fast_length
from clra.ops.runtime import build

RELATIVE = 1e-6  # of the largest magnitude
SHAPES = [((3, 5, 8), (2,)), ((2, 4, 8), (1, 2)), ((2, 3, 9), (2,)), ((2, 5, 6), (1, 2))]
DEGENERATE = [((2, 1, 8), (1, 2)), ((3, 4, 1), (2,)), ((1, 3, 2), (1, 2))]


@pytest.fixture(scope="module", autouse=True)
def compiler(context: cl.Context) -> None:
    """Builds once, so that a PoCL device that needs mending is mended before reikna compiles."""
    build.builds(context).program("fft.cl")


def image_of(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def assert_close(found: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=RELATIVE * np.abs(expected).max())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("shape", "axes"), SHAPES + DEGENERATE)
def test_transforms_are_numpys(context, queue, backend, shape, axes):
    transform = RealFFT(context, shape, axes, backend)
    image = image_of(shape)
    expected = np.fft.rfftn(image.astype(float), axes=axes)
    on_device = with_offset(queue, image)
    spectrum = with_offset(queue, np.zeros(transform.spectrum_shape, np.complex64))
    transform.forward(queue, spectrum, on_device)
    assert_close(spectrum.get(), expected)
    on_device.fill(0)
    transform.inverse(queue, on_device, spectrum)
    assert_close(on_device.get(), image)
    assert_close(spectrum.get(), expected)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("shape", "axes"), SHAPES[:2])
def test_fewer_images_than_planned_leave_the_rest_alone(context, queue, backend, shape, axes):
    transform = RealFFT(context, shape, axes, backend)
    image = image_of((1, *shape[1:]))
    spectrum = cl_array.zeros(queue, transform.spectrum_shape, np.complex64)
    transform.forward(queue, spectrum[:1], cl_array.to_device(queue, image))
    expected = np.zeros(transform.spectrum_shape, complex)
    expected[:1] = np.fft.rfftn(image.astype(float), axes=axes)
    assert_close(spectrum.get(), expected)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("in_place", [False, True])
def test_apply_convolves_lines(context, queue, backend, in_place):
    shape = (3, 5, 8)
    transform = RealFFT(context, shape, (2,), backend)
    image, factors = image_of(shape), image_of((5,), seed=1)
    expected = np.fft.irfft(np.fft.rfft(image.astype(float)) * factors, 8)
    source = with_offset(queue, image)
    out = source if in_place else cl_array.zeros(queue, shape, np.float32)
    transform.apply(queue, out, source, cl_array.to_device(queue, factors))
    assert_close(out.get(), expected)


@pytest.mark.parametrize("backend", BACKENDS)
def test_apply_takes_complex_factors(context, queue, backend):
    shape = (3, 5, 8)
    image, kernel = image_of(shape), image_of((8,), seed=1).astype(float)
    factors = with_offset(queue, np.fft.rfft(kernel).astype(np.complex64))
    expected = np.fft.irfft(np.fft.rfft(image.astype(float)) * np.fft.rfft(kernel), 8)
    out = cl_array.to_device(queue, image)
    RealFFT(context, shape, (2,), backend).apply(queue, out, out, factors)
    assert_close(out.get(), expected)


@pytest.mark.parametrize("backend", BACKENDS)
def test_apply_convolves_images(context, queue, backend):
    shape = (2, 4, 8)
    transform = RealFFT(context, shape, (1, 2), backend)
    image, factors = image_of(shape), image_of((4, 5), seed=1)
    factors[3] = factors[1]  # of a real kernel
    spectrum = np.fft.rfft2(image.astype(float)) * factors
    out = cl_array.to_device(queue, image)
    transform.apply(queue, out, out, cl_array.to_device(queue, factors))
    assert_close(out.get(), np.fft.irfft2(spectrum, shape[1:]))


def test_many_blocks_are_one_transform(context, queue):
    """More lines than one thread takes at a time."""
    shape = (2, 3001, 512)
    image = image_of(shape)
    transform = RealFFT(context, shape, (2,), "scipy")
    spectrum = cl_array.zeros(queue, transform.spectrum_shape, np.complex64)
    transform.forward(queue, spectrum, cl_array.to_device(queue, image))
    assert_close(spectrum.get(), np.fft.rfft(image))


@pytest.mark.parametrize("backend", BACKENDS)
def test_events_order_an_out_of_order_queue(context, unordered, backend):
    shape = (2, 4, 8)
    transform = RealFFT(context, shape, (1, 2), backend)
    image = image_of(shape)
    device = cl_array.Array(context, shape, np.float32)
    spectrum = cl_array.Array(context, transform.spectrum_shape, np.complex64)
    result = np.empty_like(image)
    gate = cl.UserEvent(context)
    uploaded = cl.enqueue_copy(
        unordered, device.base_data, image, is_blocking=False, wait_for=[gate]
    )
    gate.set_status(cl.command_execution_status.COMPLETE)
    event = transform.forward(unordered, spectrum, device, wait_for=[uploaded])
    cleared = cl.enqueue_fill_buffer(
        unordered, device.base_data, np.float32(0), 0, device.nbytes, wait_for=[event]
    )
    event = transform.inverse(unordered, device, spectrum, wait_for=[cleared])
    cl.enqueue_copy(unordered, result, device.base_data, wait_for=[event])
    assert_close(result, image)


@pytest.mark.parametrize(("backend", "expected"), [("scipy", 540), ("reikna", 1024)])
def test_fast_length(context, backend, expected):
    assert fast_length(context, 539, backend) == expected
    assert fast_length(context, expected, backend) == expected


def test_what_is_refused(context, queue):
    shape = (2, 6, 10)
    with pytest.raises(ValueError, match="backend: found 'fftw'"):
        RealFFT(context, shape, (2,), "fftw")
    with pytest.raises(ValueError, match="axes: found"):
        RealFFT(context, shape, (0,))
    with pytest.raises(ValueError, match="shape: found"):
        RealFFT(context, (2, 0, 10), (2,))
    transform = RealFFT(context, shape, (2,), "scipy")
    image = cl_array.zeros(queue, shape, np.float32)
    spectrum = cl_array.zeros(queue, transform.spectrum_shape, np.complex64)
    with pytest.raises(TypeError, match="image: found ndarray"):
        transform.forward(queue, spectrum, image.get())
    with pytest.raises(ValueError, match="spectrum_out: found float32"):
        transform.forward(queue, image, image)
    with pytest.raises(ValueError, match=r"image: found shape \(3, 6, 10\)"):
        transform.forward(queue, spectrum, cl_array.zeros(queue, (3, 6, 10), np.float32))
    with pytest.raises(ValueError, match="spectrum_out: found shape"):
        transform.forward(queue, spectrum, image[:1])


def test_where_reikna_finds_no_work_group_the_host_transforms(context, queue, monkeypatch):
    def small(params, device):
        ask(params, device)
        params.max_work_group_size = 1

    parameters = pytest.importorskip("reikna.cluda.ocl").DeviceParameters
    ask = parameters.__init__
    monkeypatch.setattr(parameters, "__init__", small)
    with pytest.warns(UserWarning, match=r"reikna: Could not find .*: transforms run on the host"):
        transform = RealFFT(context, (2, 3, 16), (2,), "reikna")
    image = image_of((2, 3, 16))
    spectrum = cl_array.empty(queue, (2, 3, 9), np.complex64)
    transform.forward(queue, spectrum, cl_array.to_device(queue, image)).wait()
    np.testing.assert_allclose(spectrum.get(), np.fft.rfft(image), rtol=0, atol=1e-5)
