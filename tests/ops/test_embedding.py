"""Every operator in somebody else's context, queue and memory."""

import threading
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pyopencl.tools
import pytest
from operator_cases import CASES, WITH_SCRATCH, Case, result, values

from clra.ops.filtering import fft
from clra.ops.filtering.fft import RealFFT
from clra.ops.runtime.profile import CPU, GPU, forced


@pytest.fixture(params=CASES)
def case(request) -> Case:
    return CASES[request.param]


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
    for _ in range(500):
        if holds():
            return True
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


@pytest.mark.parametrize("form", [CPU, GPU], ids=["cpu", "gpu"], indirect=True)
def test_a_call_makes_flushes_and_finishes_no_queue(case, context, queue, monkeypatch, form):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*transforms run on the host")  # see test_every_kernel
        operator = case.run(case.make(context))
    arrays = [case.empty(queue), *(cl_array.to_device(queue, host) for host in case.inputs)]
    done = []

    def noted(name: str) -> Callable[..., Any]:
        return lambda *arguments, **named: done.append(name)

    with monkeypatch.context() as patch:
        for name in ("flush", "finish", "__init__"):
            patch.setattr(cl.CommandQueue, name, noted(name))
        event = operator(queue, *arrays)
    event.wait()
    assert done == []


def test_out_of_order_it_waits_for_what_it_is_told(case, context, unordered, expected):
    """Inputs arrive late, behind an event that a host thread completes during the call."""
    operator = case.make(context)
    for _ in range(2):  # the second call must not run into the first one's scratch
        out = case.empty(unordered)  # blocks, until all is done where PoCL is concerned
        late = cl.UserEvent(context)
        inputs = [cl_array.to_device(unordered, np.full_like(host, np.nan)) for host in case.inputs]
        # Started first: if no thread can be, nothing waits for it for ever.
        timer = threading.Timer(0.03, late.set_status, [cl.command_execution_status.COMPLETE])
        timer.start()
        arrived = [
            cl.enqueue_copy(unordered, array.base_data, host, wait_for=[late], is_blocking=False)
            for array, host in zip(inputs, case.inputs, strict=True)
        ]
        event = case.run(operator)(unordered, out, *inputs, wait_for=arrived)
        timer.join()
        event.wait()
        np.testing.assert_array_equal(out.get(unordered), expected)


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
    out.fill(np.float32(case.before))
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
    out = case.empty(queue)
    case.run(case.make(context))(queue, out, *inputs).wait()
    np.testing.assert_array_equal(out.get(), expected)


def test_host_memory_of_another_library(case, context, queue, expected):
    """The documented line: a buffer in place of what the buffer protocol or DLPack shows."""
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR
    inputs, theirs = [], []
    for host in case.inputs:
        theirs.append(bytearray(host.tobytes()))
        values = np.from_dlpack(np.frombuffer(theirs[-1], np.float32).reshape(host.shape))
        buffer = cl.Buffer(context, flags, hostbuf=values)
        inputs.append(cl_array.Array(queue, values.shape, np.float32, data=buffer))
    out = case.empty(queue)
    case.run(case.make(context))(queue, out, *inputs).wait()
    np.testing.assert_array_equal(out.get(), expected)


def context_of_two(context: cl.Context) -> cl.Context:
    """Two devices of the platform or else sub-devices of one, as somebody else's context."""
    device = context.devices[0]
    alike = device.platform.get_devices()
    if len(alike) > 1:
        return cl.Context(alike[:2])
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
    # reikna's transforms see to their groups themselves, or leave it to the host.
    monkeypatch.setattr(fft, "_backend", lambda *_: "scipy")
    with forced(GPU):
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
    # On a GPU some need none.
    assert (sum(taken) > 0) == (operator.scratch_bytes > 0)
    assert sum(taken) <= operator.scratch_bytes
    assert pool.active_blocks >= max(blocks, int(operator.scratch_bytes > 0))
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
        arrays[-1] = cl_array.to_device(queue, np.zeros(arrays[-1].shape, np.float64))
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
