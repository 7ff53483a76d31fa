"""Which devices there are, and which is taken."""

import types
from dataclasses import dataclass

import pyopencl as cl
import pytest

from clra.errors import DeviceError
from clra.ops.runtime import devices


def test_devices_are_listed_and_can_be_chosen_by_what_is_listed(context):
    listed = devices.devices()
    assert listed
    for info in listed:
        assert devices.choose_device(info.index).name.strip() == info.name
        assert info.largest_buffer <= info.memory
        assert info.kind in ("GPU", "CPU", "other")


def test_unknown_device_lists_what_was_found():
    with pytest.raises(DeviceError, match=r"no OpenCL device 'voodoo'; found \d+:0 "):
        devices.choose_device("voodoo")


def test_argument_beats_clra_device_beats_pyopencl_ctx(monkeypatch):
    monkeypatch.setenv("PYOPENCL_CTX", "nothing like it")
    first = devices.devices()[0].index
    monkeypatch.setenv("CLRA_DEVICE", first)
    assert devices.choose_device() == devices.choose_device(first)
    monkeypatch.setenv("CLRA_DEVICE", "also nothing")
    assert devices.choose_device(first)
    with pytest.raises(DeviceError, match="also nothing"):
        devices.choose_device()
    monkeypatch.delenv("CLRA_DEVICE")
    with pytest.raises(DeviceError, match="nothing like it"):
        devices.choose_device()


def test_no_device_at_all_says_how_to_get_one(monkeypatch):
    def none():
        raise cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")

    monkeypatch.setattr(cl, "get_platforms", none)
    with pytest.raises(DeviceError, match=r"pip install 'clra\[pocl\]'"):
        devices.choose_device()
    assert devices.devices() == []


@dataclass(frozen=True)
class Driver:
    """As much of a device and its platform as the choice asks for."""

    version: str
    name: str = "pthread-AMD EPYC"
    max_compute_units: int = 2
    type: int = cl.device_type.CPU

    @property
    def platform(self) -> types.SimpleNamespace:
        name = "Portable Computing Language"
        return types.SimpleNamespace(name=name, version=self.version, get_devices=lambda: [self])


@pytest.mark.parametrize("swapped", [False, True])
def test_of_two_drivers_of_one_name_the_newer_unless_asked(monkeypatch, swapped):
    old, new = Driver("OpenCL 3.0 PoCL 3.1+debian"), Driver("OpenCL 3.0 PoCL 10.0")
    drivers = [new, old] if swapped else [old, new]
    monkeypatch.setattr(cl, "get_platforms", lambda: [one.platform for one in drivers])
    monkeypatch.delenv("CLRA_DEVICE", raising=False)
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)
    assert devices.choose_device() is new
    assert devices.choose_device("pocl 3.1") is old
    assert devices.choose_device(f"{drivers.index(old)}:0") is old
    with pytest.raises(DeviceError, match=r"PoCL 3\.1\+debian.*PoCL 10|PoCL 10.*PoCL 3\.1"):
        devices.choose_device("pocl 7")
