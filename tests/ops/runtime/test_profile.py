"""Which profile a device has, and how it is overridden."""

from dataclasses import replace

import pyopencl as cl
import pytest

from clra.errors import DeviceError
from clra.ops.runtime.profile import CPU, GPU, WIDE_CPU, device_of, forced, profile_of


def test_a_device_its_context_and_its_queues_have_one_profile(context, queue):
    device = device_of(context)
    assert device_of(queue) == device == device_of(device)
    assert profile_of(context) is profile_of(queue) is profile_of(device)


def test_the_kind_of_the_device_decides(context, monkeypatch):
    monkeypatch.delenv("CLRA_PROFILE", raising=False)
    device = device_of(context)
    if not device.type & cl.device_type.CPU:
        assert profile_of(device) is GPU
        return
    wide = device.native_vector_width_float >= 16
    assert profile_of(device) is (WIDE_CPU if wide else CPU)


@pytest.mark.parametrize(("name", "form"), [("gpu", "gpu"), ("cpu", "cpu")])
def test_the_environment_overrides_it(context, monkeypatch, name, form):
    monkeypatch.setenv("CLRA_PROFILE", name)
    assert profile_of(context).form == form


def test_another_word_in_the_environment_is_an_error(context, monkeypatch):
    monkeypatch.setenv("CLRA_PROFILE", "fpga")
    with pytest.raises(DeviceError, match="CLRA_PROFILE: found 'fpga', expected 'cpu' or 'gpu'"):
        profile_of(context)


def test_forced_profiles_end_with_their_block(context, monkeypatch):
    before = profile_of(context)
    monkeypatch.setenv("CLRA_PROFILE", "cpu")
    with forced(GPU), pytest.raises(RuntimeError):
        with forced(replace(GPU, columns=False)):
            assert not profile_of(context).columns
        assert profile_of(context) is GPU
        raise RuntimeError
    monkeypatch.undo()
    assert profile_of(context) is before
