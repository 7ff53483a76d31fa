"""Worked examples: the operators within other OpenCL stacks, where these are installed."""

import warnings

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pytest

import clra
from clra.ops.images.pyramid import Restrict2D

GEOMETRY = clra.circular(
    5, source_to_axis=25.0, source_to_detector=50.0, pixel_size=0.3, shape=(19, 23)
)
GRID = clra.VolumeGrid(shape=(7, 11, 9), voxel_size=0.2)
SHAPE = (GEOMETRY.views, *GEOMETRY.shape)
VOLUME = np.random.default_rng(1).uniform(0, 1, GRID.shape).astype(np.float32)
ROUNDING = 1e-6  # of the largest value: another device may have rounded


@pytest.fixture(scope="module")
def expected(context) -> np.ndarray:
    queue = cl.CommandQueue(context)
    projections = cl_array.empty(queue, SHAPE, np.float32)
    forward = clra.ForwardProjector(context, GEOMETRY, GRID)
    forward(queue, projections, cl_array.to_device(queue, VOLUME))
    return projections.get()


def assert_same(found: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING * expected.max())


def test_gputools_arrays_are_taken_as_they_are(context, expected):
    gputools = pytest.importorskip("gputools")
    try:
        gputools.init_device()
    except Exception as error:  # whatever its one global device fails with
        pytest.skip(f"gputools finds no device: {error}")
    volume = gputools.OCLArray.from_array(VOLUME)
    projections = gputools.OCLArray.empty(SHAPE, np.float32)
    forward = clra.ForwardProjector(volume.context, GEOMETRY, GRID)
    forward(volume.queue, projections, volume)
    assert_same(projections.get(), expected)


def test_a_context_that_silx_made(context, expected):
    common = pytest.importorskip("silx.opencl.common")
    if not common.ocl:
        pytest.skip("silx finds no OpenCL")
    theirs = common.ocl.create_context(devicetype="all")
    queue = cl.CommandQueue(theirs)
    projections = cl_array.empty(queue, SHAPE, np.float32)
    forward = clra.ForwardProjector(theirs, GEOMETRY, GRID)
    forward(queue, projections, cl_array.to_device(queue, VOLUME))
    assert_same(projections.get(), expected)


def test_a_reikna_thread_on_the_same_queue(context, queue, expected):
    ocl_api = pytest.importorskip("reikna.cluda").ocl_api
    thread = ocl_api().Thread(queue)
    volume = thread.to_device(VOLUME)
    projections = thread.array(SHAPE, np.float32)
    forward = clra.ForwardProjector(context, GEOMETRY, GRID)
    forward(queue, projections, volume)  # in order: reikna takes no events
    assert_same(projections.get(), expected)


def test_a_pyclesperanto_image_through_host_memory(context, queue, expected):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of each back end that is missing
        cle = pytest.importorskip("pyclesperanto", exc_type=ImportError)
    try:
        image = cle.push(VOLUME)
    except Exception as error:  # by version and platform another type, or a warning
        pytest.skip(f"pyclesperanto finds no device: {error}")
    volume = cl_array.to_device(queue, cle.pull(image))
    projections = cl_array.empty(queue, SHAPE, np.float32)
    clra.ForwardProjector(context, GEOMETRY, GRID)(queue, projections, volume)
    theirs = cle.push(projections.get())
    assert_same(cle.pull(theirs), expected)


def test_pyvkfft_on_the_same_queue(context, queue):
    """Halved images, whose spectra pyvkfft takes right behind."""
    vkfft = pytest.importorskip("pyvkfft.opencl", exc_type=ImportError)
    images = np.random.default_rng(2).uniform(0, 1, (3, 16, 32)).astype(np.float32)
    halved = cl_array.empty(queue, (3, 8, 16), np.float32)
    spectra = cl_array.empty(queue, (3, 8, 9), np.complex64)
    plan = vkfft.VkFFTApp(halved.shape, np.float32, queue, ndim=2, inplace=False, r2c=True)
    Restrict2D(context)(queue, halved, cl_array.to_device(queue, images))
    plan.fft(halved, spectra)
    means = images.reshape(3, 8, 2, 16, 2).mean((2, 4))
    exact = np.fft.rfft2(means)
    np.testing.assert_allclose(spectra.get(), exact, rtol=0, atol=ROUNDING * np.abs(exact).max())
