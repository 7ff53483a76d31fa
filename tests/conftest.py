"""Fixtures that every test may use."""

import os
from collections.abc import Iterator
from pathlib import Path

import pyopencl as cl
import pytest

from clra.ops.runtime import build
from clra.ops.runtime.devices import create_context
from clra.ops.runtime.profile import DeviceProfile, forced


@pytest.fixture(scope="session")
def context() -> Iterator[cl.Context]:
    context = create_context()
    builds = build.builds(context)  # held, so that the tests compile once
    yield context
    del builds


@pytest.fixture
def queue(context: cl.Context) -> cl.CommandQueue:
    return cl.CommandQueue(context)


@pytest.fixture
def unordered(context: cl.Context) -> cl.CommandQueue:
    """A queue that runs what it holds in any order that events allow."""
    flag = cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE
    return cl.CommandQueue(context, properties=flag)


@pytest.fixture
def form(request: pytest.FixtureRequest) -> Iterator[DeviceProfile]:
    """Give every device the profile that a test is parametrised with."""
    with forced(request.param):
        yield request.param


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of public real data, which is no part of the repository."""
    folder = os.environ.get("CLRA_TEST_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("CLRA_TEST_DATA names no folder of test data")
    return Path(folder)
