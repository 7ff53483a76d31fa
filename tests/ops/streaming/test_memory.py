"""Memory that is counted, and arrays that go to disk."""

import gc

import numpy as np
import pyopencl as cl
import pytest

from clra.ops.runtime.devices import create_context
from clra.ops.runtime.profile import device_of, profile_of
from clra.ops.streaming.memory import (
    Budgets,
    DeviceMemory,
    DeviceMemoryError,
    HostRoom,
    Reused,
    Store,
)


@pytest.fixture(scope="module")
def context():
    return create_context()


def test_device_memory_is_counted_and_given_back(context):
    memory = DeviceMemory(context, 1000)
    first, second = memory(300), memory(400)
    assert (memory.taken, memory.peak) == (700, 700)
    del first
    gc.collect()
    assert (memory.taken, memory.peak) == (400, 700)
    assert memory(600).size == 600
    assert second.size == 400


def test_more_than_the_budget_says_what_to_do(context):
    memory = DeviceMemory(context, 3 << 20)
    kept = memory(2 << 20)
    with pytest.raises(
        DeviceMemoryError,
        match=r"4 MiB.* needed, 3 MiB are allowed: raise --max-device-memo",
    ):
        memory(2 << 20)
    assert kept.size == memory.taken


def test_arrays_keep_their_memory_counted_through_views(context):
    memory = DeviceMemory(context, 4000)
    array = cl.array.Array(context, (10, 10), np.float32, allocator=memory)
    view = array[3:5]
    del array
    gc.collect()
    assert memory.taken == 400
    del view
    gc.collect()
    assert memory.taken == 0


def test_reused_memory_is_one_buffer_until_it_must_grow(context):
    memory = DeviceMemory(context, 1000)
    reused = Reused(memory)
    assert reused(100) is reused(60)
    assert reused(200).size == 200


@pytest.mark.parametrize("budget", [0, 4 * 60])
def test_store_returns_what_was_written(budget):
    room = HostRoom(budget)
    store = Store((5, 3, 4), room)
    assert store.in_memory == (budget > 0)
    assert room.left == 0
    values = np.random.default_rng(0).random((5, 3, 4), np.float32)
    store.write(3, values[3:])
    store.write(0, values[:3])
    assert np.array_equal(store.read(1, 4), values[1:4])
    del store
    gc.collect()
    assert room.left == budget


def test_budget_of_a_cpu_is_part_of_the_host_s(context):
    device = device_of(context)
    if not profile_of(device).shared_memory:
        pytest.skip("no CPU device")
    budgets = Budgets.of(device, 80 << 20, 100 << 20)
    assert budgets.device == 50 << 20
    assert budgets.chunk(1) <= budgets.host // 64


@pytest.mark.parametrize("name", ["max_device_memory", "max_host_memory"])
def test_a_budget_is_positive(context, name):
    given = {"max_device_memory": None, "max_host_memory": None, name: -1}
    with pytest.raises(ValueError, match=f"{name}: found -1, expected a positive number"):
        Budgets.of(device_of(context), given["max_device_memory"], given["max_host_memory"])
