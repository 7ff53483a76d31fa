"""Every operator in somebody else's context, queue and memory."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.tools
import pytest

import clra
from clra.ops import fft, opencl
from clra.ops.bandpass import Bandpass
from clra.ops.correlation import PhaseCorrelation
from clra.ops.coverage import Coverage
from clra.ops.fft import RealFFT
from clra.ops.filtering import RampFilter
from clra.ops.pyramid import Prolong3D, Restrict2D, Restrict3D
from clra.ops.registration import Registration
from clra.ops.warp import Warp

OUT_OF_ORDER = cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE
FORMS = 2e-5  # of the largest value: forms of a kernel for CPU and GPU differ by roundings
REGISTERED = 1e-3  # likewise, for estimates that iterate to this
OVERHEAD = 0.2e-3  # s, of a call over the bare launch

VIEWS, ROWS, COLUMNS = 5, 19, 23
GRID = clra.VolumeGrid(shape=(7, 11, 9), voxel_size=0.2)
GEOMETRY = clra.circular(
    VIEWS, source_to_axis=25.0, source_to_detector=50.0, pixel_size=0.3, shape=(ROWS, COLUMNS)
)
IMAGES = (VIEWS, ROWS, COLUMNS)
RANDOM = np.random.default_rng(7)


def values(*shape: int) -> np.ndarray:
    return RANDOM.uniform(0.1, 1, shape).astype(np.float32)


def radiographs() -> np.ndarray:
    """Blobs that registration can hold on to."""
    spectrum = np.fft.rfft2(RANDOM.normal(size=IMAGES))
    v, u = np.fft.fftfreq(ROWS)[:, None], np.fft.rfftfreq(COLUMNS)
    blurred = np.fft.irfft2(spectrum * np.exp(-60 * (u**2 + v**2)), s=(ROWS, COLUMNS))
    return blurred.astype(np.float32)


def normalised(coverage: Coverage) -> Callable[..., cl.Event]:
    """Coverage divides a volume in place; copied afterwards, it looks like the others."""

    def call(queue, out, volume, wait_for=None):
        counted = coverage.compute(queue, wait_for)
        divided = coverage.normalise(queue, volume, 2.0, wait_for=[counted])
        return cl.enqueue_copy(
            queue,
            out.base_data,
            volume.base_data,
            byte_count=volume.nbytes,
            src_offset=volume.offset,
            dst_offset=out.offset,
            wait_for=[divided],
        )

    return call


@dataclass(frozen=True)
class Case:
    """An operator with its result's shape and its inputs."""

    make: Callable[..., Any]
    out: tuple[int, ...]
    inputs: tuple[np.ndarray, ...]
    run: Callable[[Any], Callable[..., cl.Event]] = lambda operator: operator
    closeness: float = FORMS


MOTION = np.array([[0.3, -0.4, 1.01]] * VIEWS, np.float32)
PAIR = (radiographs(), radiographs())
PAIR[1][:] += 4 * np.roll(PAIR[0], (0, -1), (1, 2))
CASES = {
    "forward": Case(
        lambda c, **a: clra.ForwardProjector(c, GEOMETRY, GRID, **a),
        IMAGES,
        (values(*GRID.shape),),
    ),
    "back": Case(
        lambda c, **a: clra.BackProjector(c, GEOMETRY, GRID, **a), GRID.shape, (values(*IMAGES),)
    ),
    "adjoint": Case(
        lambda c, **a: clra.BackProjector(c, GEOMETRY, GRID, matched=True, **a),
        GRID.shape,
        (values(*IMAGES),),
    ),
    "ramp": Case(lambda c, **a: RampFilter(c, GEOMETRY, **a), IMAGES, (values(*IMAGES),)),
    "coverage": Case(
        lambda c, **a: Coverage(c, GEOMETRY, GRID, np.ones(ROWS), **a),
        GRID.shape,
        (values(*GRID.shape),),
        normalised,
    ),
    "transform": Case(
        lambda c, **a: RealFFT(c, IMAGES, **a),
        IMAGES,
        (values(*IMAGES), values(ROWS, COLUMNS // 2 + 1)),
        lambda operator: operator.apply,
    ),
    "warp": Case(lambda c, **a: Warp(c, IMAGES[1:], **a), IMAGES, (values(*IMAGES), MOTION)),
    "restrict images": Case(Restrict2D, (VIEWS, ROWS // 2, COLUMNS // 2), (values(*IMAGES),)),
    "restrict": Case(Restrict3D, (2, ROWS // 2, COLUMNS // 2), (values(*IMAGES),)),
    "prolong": Case(Prolong3D, IMAGES, (values(2, ROWS // 2, COLUMNS // 2),)),
    "band-pass": Case(
        lambda c, **a: Bandpass(c, IMAGES[1:], views=VIEWS, high_pass=4.0, **a),
        IMAGES,
        (values(*IMAGES),),
    ),
    "phase correlation": Case(
        lambda c, **a: PhaseCorrelation(c, IMAGES[1:], views=3, **a),
        (VIEWS, 2),
        PAIR,
        closeness=REGISTERED,
    ),
    "registration": Case(
        lambda c, **a: Registration(c, IMAGES[1:], views=3, high_pass=4.0, **a),
        (VIEWS, 10),
        PAIR,
        closeness=REGISTERED,
    ),
}
WITH_SCRATCH = (
    "forward",
    "back",
    "adjoint",
    "ramp",
    "coverage",
    "warp",
    "band-pass",
    "phase correlation",
    "registration",
)


@pytest.fixture(params=CASES)
def case(request) -> Case:
    return CASES[request.param]


def result(case: Case, operator: Any, queue: cl.CommandQueue) -> np.ndarray:
    """Result of one call with arrays of the queue's context."""
    inputs = [cl_array.to_device(queue, host) for host in case.inputs]
    out = cl_array.empty(queue, case.out, np.float32)
    event = case.run(operator)(queue, out, *inputs)
    assert event.command_queue == queue
    event.wait()
    return out.get()


_expected: dict[int, np.ndarray] = {}


@pytest.fixture
def expected(case, context, queue) -> np.ndarray:
    """What the operator gives by itself."""
    if id(case) not in _expected:
        found = result(case, case.make(context), queue)
        assert np.isfinite(found).all()
        assert np.ptp(found) > 0
        _expected[id(case)] = found
    return _expected[id(case)]


def settles(holds: Callable[[], bool]) -> bool:
    """Whether it holds soon: drivers let go of what they have done when they get round to it."""
    deadline = time.monotonic() + 5
    while not holds() and time.monotonic() < deadline:
        time.sleep(0.01)
    return holds()


def test_in_a_foreign_context_and_queue_which_it_leaves_as_they_are(case, context, expected):
    theirs = cl.Context(context.devices)
    queue = cl.CommandQueue(theirs)
    references = queue.reference_count
    operator = case.make(theirs)
    np.testing.assert_array_equal(result(case, operator, queue), expected)
    assert queue.context == theirs
    del operator
    assert settles(lambda: queue.reference_count == references)


def test_out_of_order_it_waits_for_what_it_is_told(case, context, expected):
    """Inputs arrive late, behind an event that a host thread completes during the call."""
    queue = cl.CommandQueue(context, properties=OUT_OF_ORDER)
    operator = case.make(context)
    for _ in range(2):  # the second call must not run into the first one's scratch
        late = cl.UserEvent(context)
        inputs = [cl_array.to_device(queue, np.full_like(host, np.nan)) for host in case.inputs]
        arrived = [
            cl.enqueue_copy(queue, array.base_data, host, wait_for=[late], is_blocking=False)
            for array, host in zip(inputs, case.inputs, strict=True)
        ]
        out = cl_array.empty(queue, case.out, np.float32)
        timer = threading.Timer(0.03, late.set_status, [cl.command_execution_status.COMPLETE])
        timer.start()
        event = case.run(operator)(queue, out, *inputs, wait_for=arrived)
        timer.join()
        event.wait()
        np.testing.assert_array_equal(out.get(queue), expected)


def test_arrays_with_an_offset(case, context, queue, expected):
    """Each is a view into a larger array that starts at an odd element; the rest stays."""

    def inside(shape: tuple[int, ...]) -> tuple[cl_array.Array, cl_array.Array]:
        size = int(np.prod(shape))
        whole = cl_array.to_device(queue, np.full(size + 7, 9, np.float32))
        return whole, whole[3 : 3 + size].reshape(shape)

    inputs = []
    for host in case.inputs:
        inputs.append(inside(host.shape)[1])
        inputs[-1].set(host)
    whole, out = inside(case.out)
    case.run(case.make(context))(queue, out, *inputs).wait()
    np.testing.assert_array_equal(out.get(), expected)
    around = whole.get()
    assert (np.concatenate([around[:3], around[-4:]]) == 9).all()


def test_a_foreign_buffer_wrapped_in_an_array(case, context, queue, expected):
    """The documented line: an array around a handle that another library owns."""
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
    theirs = [cl.Buffer(context, flags, hostbuf=host) for host in case.inputs]
    inputs = [
        cl_array.Array(queue, host.shape, host.dtype, data=cl.Buffer.from_int_ptr(buffer.int_ptr))
        for host, buffer in zip(case.inputs, theirs, strict=True)
    ]
    out = cl_array.empty(queue, case.out, np.float32)
    case.run(case.make(context))(queue, out, *inputs).wait()
    np.testing.assert_array_equal(out.get(), expected)


def context_of_two(context: cl.Context) -> cl.Context:
    """Two sub-devices of the device, as somebody else's context."""
    device = context.devices[0]
    if device.partition_max_sub_devices < 2:  # Rusticl of Mesa 22 crashes where it should refuse
        pytest.skip("no sub-devices")
    return cl.Context(device.create_sub_devices([cl.device_partition_property.EQUALLY, 1])[:2])


def test_on_the_queues_device_of_a_context_of_two(case, context, expected):
    theirs = context_of_two(context)
    operator = case.make(theirs)
    for device in theirs.devices:
        queue = cl.CommandQueue(theirs, device)
        np.testing.assert_array_equal(result(case, operator, queue), expected)


def test_reiknas_transform_follows_the_queues_device(context):
    theirs = context_of_two(context)
    transform = RealFFT(theirs, (3, 1, 16), (2,), "reikna")
    lines = values(3, 1, 16)
    for device in (*theirs.devices, theirs.devices[0]):
        queue = cl.CommandQueue(theirs, device)
        spectrum = cl_array.empty(queue, (3, 1, 9), np.complex64)
        transform.forward(queue, spectrum, cl_array.to_device(queue, lines)).wait()
        np.testing.assert_allclose(spectrum.get(), np.fft.rfft(lines), rtol=0, atol=1e-5)
    assert set(transform._backend._plans) == set(theirs.devices)


def test_each_thread_with_its_own_operator(case, context, expected):
    def work(_: int) -> list[np.ndarray]:
        queue = cl.CommandQueue(context)
        operator = case.make(context)
        return [result(case, operator, queue) for _ in range(3)]

    with ThreadPoolExecutor(3) as pool:
        for found in pool.map(work, range(3)):
            for one in found:
                np.testing.assert_array_equal(one, expected)


def test_a_device_that_refuses_the_work_group(case, context, queue, expected, monkeypatch):
    """The kernels' form for GPUs, whose groups are large, where groups of 4 are allowed."""
    ask = cl.Kernel.get_work_group_info

    def grudging(kernel, what, device):
        found = ask(kernel, what, device)
        return min(found, 4) if what == cl.kernel_work_group_info.WORK_GROUP_SIZE else found

    monkeypatch.setattr(cl.Kernel, "get_work_group_info", grudging)
    monkeypatch.setattr(opencl, "is_cpu", lambda device: False)
    # reikna's transforms see to their groups themselves, and need larger ones.
    monkeypatch.setattr(fft, "_backend", lambda *_: "scipy")
    found = result(case, case.make(context), queue)
    atol = case.closeness * np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


class Failing:
    """Allocator that fails at its n-th request, once."""

    def __init__(self, context: cl.Context, n: int) -> None:
        self._context, self._left = context, n

    def __call__(self, size: int) -> cl.Buffer:
        self._left -= 1
        if self._left == 0:
            raise cl.MemoryError("clCreateBuffer failed: MEM_OBJECT_ALLOCATION_FAILURE")
        return cl.Buffer(self._context, cl.mem_flags.READ_WRITE, size)


@pytest.mark.parametrize("n", [1, 2])
@pytest.mark.parametrize("name", WITH_SCRATCH)
def test_after_a_failed_allocation_the_next_call_works(name, n, context, queue):
    case, failing = CASES[name], Failing(context, n)
    operator = None
    for _ in range(2):
        try:
            operator = operator or case.make(context, allocator=failing)
            found = result(case, operator, queue)
        except cl.MemoryError:
            continue
        break
    np.testing.assert_array_equal(found, result(case, case.make(context), queue))


@pytest.mark.parametrize("name", WITH_SCRATCH)
def test_the_callers_pool_gives_the_scratch_memory(name, context, queue):
    case = CASES[name]
    pool = pyopencl.tools.MemoryPool(pyopencl.tools.ImmediateAllocator(queue))
    taken = []

    def allocator(size: int) -> Any:
        taken.append(size)
        return pool.allocate(size)

    operator = case.make(context, allocator=allocator)
    blocks = pool.active_blocks
    first, second = (result(case, operator, queue) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first, result(case, case.make(context), queue))
    assert 0 < sum(taken) <= operator.scratch_bytes
    assert pool.active_blocks >= max(blocks, 1)
    del operator
    assert pool.active_blocks == 0


class TestRefusals:
    """Errors name what was found and what was expected."""

    @pytest.fixture
    def arrays(self, case, queue) -> list[cl_array.Array]:
        shapes = [case.out, *(host.shape for host in case.inputs)]
        return [cl_array.zeros(queue, shape, np.float32) for shape in shapes]

    def test_queue_of_another_context(self, case, context, arrays):
        theirs = cl.Context(context.devices)  # held: Intel's queues do not keep their context
        other = cl.CommandQueue(theirs)
        with pytest.raises(ValueError, match=r"queue: its context .*is not the operator's"):
            case.run(case.make(context))(other, *arrays)

    def test_array_of_another_context(self, case, context, queue, arrays):
        theirs = cl.Context(context.devices)
        other = cl.CommandQueue(theirs)
        arrays[-1] = cl_array.zeros(other, arrays[-1].shape, np.float32)
        with pytest.raises(ValueError, match=r"its context .* is not the operator's"):
            case.run(case.make(context))(queue, *arrays)

    def test_numpy(self, case, context, queue, arrays):
        arrays[-1] = arrays[-1].get()
        with pytest.raises(TypeError, match=r"found ndarray, expected a pyopencl\.array\.Array"):
            case.run(case.make(context))(queue, *arrays)

    def test_double_precision(self, case, context, queue, arrays):
        arrays[-1] = arrays[-1].astype(np.float64)
        with pytest.raises(ValueError, match="found float64, expected float32"):
            case.run(case.make(context))(queue, *arrays)

    def test_another_shape(self, case, context, queue, arrays):
        shape = (*arrays[-1].shape[:-1], arrays[-1].shape[-1] + 2)
        arrays[-1] = cl_array.zeros(queue, shape, np.float32)
        with pytest.raises(ValueError, match=r"found shape \(.*\), expected \("):
            case.run(case.make(context))(queue, *arrays)

    def test_fortran_order(self, case, context, queue, arrays):
        arrays[-1] = cl_array.zeros(queue, arrays[-1].shape, np.float32, order="F")
        with pytest.raises(ValueError, match=r"found strides \(.*\), expected C order"):
            case.run(case.make(context))(queue, *arrays)


def test_a_call_costs_little_more_than_the_bare_launch(context, queue):
    fine = cl_array.zeros(queue, (1, 4, 4), np.float32)
    out = cl_array.zeros(queue, (1, 2, 2), np.float32)
    operator = Restrict2D(context)
    kernel = opencl.builds(context).kernel("pyramid.cl", "restrict_2d", {"LANES": 8})
    buffers = (*opencl.buffer_argument(out), *opencl.buffer_argument(fine))
    sizes = [np.int32(n) for n in (1, 2, 2, 4, 4)]

    def seconds(call: Callable[[], cl.Event]) -> float:
        times = []
        for _ in range(200):
            start = time.perf_counter()
            event = call()
            times.append(time.perf_counter() - start)
            event.wait()
        return float(np.median(times))

    bare = seconds(lambda: kernel(queue, (32, 4, 1), (32, 4, 1), *buffers, *sizes))
    assert seconds(lambda: operator(queue, out, fine)) - bare < OVERHEAD
