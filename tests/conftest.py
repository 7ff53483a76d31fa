"""Fixtures that every test may use."""

import os
from collections.abc import Iterator
from pathlib import Path

import pyopencl as cl
import pytest

from clra.errors import DeviceError
from clra.ops.runtime import build, devices
from clra.ops.runtime.profile import DeviceProfile, forced

TESTS = Path(__file__).parent
# Folders whose tests run kernels.
_ON_A_DEVICE = ("app", "kernels", "methods", "ops", "tools")
# Folders whose tests align and reconstruct whole scans, or build for every kind of device.
_SLOW = ("app", "kernels", "methods", "tools")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests by their folder, so that -m chooses what a change calls for."""
    for item in items:
        folder = item.path.relative_to(TESTS).parts[0]
        if folder in _ON_A_DEVICE:
            item.add_marker("device")
        if folder in _SLOW:
            item.add_marker("slow")


def pytest_report_header() -> str:
    """Say which of the machine's devices is tested."""
    try:
        chosen = devices.choose_device()
    except DeviceError as error:
        return f"device: {error}"
    return f"device: {chosen.name.strip()}, {chosen.platform.version.partition('  ')[0]}"


@pytest.fixture(scope="session")
def device_failure() -> str:
    """What the device fails at in a process of its own; empty if it passes."""
    try:
        devices.usable_device()
    except DeviceError as error:
        return str(error)
    return ""


@pytest.fixture(autouse=True)
def _skip_on_a_broken_device(request: pytest.FixtureRequest, device_failure: str) -> None:
    # A compiler that aborts so fails one test, which is marked, and not the run.
    folder = request.path.relative_to(TESTS).parts[0]
    marked = request.node.get_closest_marker("broken_device")
    if device_failure and folder in _ON_A_DEVICE and not marked:
        pytest.skip(device_failure)


@pytest.fixture(scope="session")
def context() -> Iterator[cl.Context]:
    context = devices.create_context()
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
