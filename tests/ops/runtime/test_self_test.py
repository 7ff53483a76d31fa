"""What becomes of the verdict on a device, and of a device that fails."""

import re

import pyopencl as cl
import pytest
from broken_devices import ABORTS, BROKEN, HANGS, RIGHT, WRONG, forget, replace_trials

from clra.errors import ClraWarning, DeviceError
from clra.ops.runtime import devices, pocl, self_test


@pytest.mark.broken_device
def test_the_device_of_these_tests_passes(device_failure):
    assert device_failure == ""


@pytest.fixture(autouse=True)
def folder(monkeypatch, tmp_path):
    forget(monkeypatch, tmp_path)
    monkeypatch.delenv("CLRA_DEVICE", raising=False)
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)
    yield tmp_path
    pocl.prefer_cpu(None)


@pytest.fixture
def only(monkeypatch):
    """One device, which no narrower CPU name helps."""
    device = devices.choose_device()
    monkeypatch.setattr(devices, "_all_devices", lambda: [("0:0", device)])
    monkeypatch.setattr(pocl, "covered", lambda cpus, flags: [])
    return device


@pytest.fixture
def two(monkeypatch, only):
    """The same device twice, the second a copy that is less liked."""
    other = cl.Device.from_int_ptr(only.int_ptr)
    monkeypatch.setattr(self_test, "_key", lambda device: "one" if device is only else "two")
    found = [("0:0", only), ("1:0", _Other(other))]
    monkeypatch.setattr(devices, "_all_devices", lambda: found)
    return found


class _Other:
    """A device of another name."""

    name, max_compute_units, parent_device = "other", 1, None

    def __init__(self, device):
        self._device = device

    def __getattr__(self, name):
        return getattr(self._device, name)


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_device_is_a_device_error_of_one_line(how, monkeypatch, only):
    program, words = BROKEN[how]
    replace_trials(monkeypatch, [program])
    with pytest.raises(DeviceError, match=rf"fails clra's self-test: {words}") as raised:
        devices.usable_device()
    line = str(raised.value)
    assert "\n" not in line
    assert "pip install 'clra[pocl]'" in line and "clra devices --test" in line


def test_a_trial_is_had_once_and_told_of(monkeypatch, only, folder):
    asked, told = replace_trials(monkeypatch, [RIGHT]), []
    for _ in range(2):
        assert devices.usable_device(progress=told.append) is only
    assert asked == [
        {"index": "0:0", "identity": self_test.identity(only), "cpu": None, "rate": False}
    ]
    assert [one.stage for one in told] == [self_test.STAGE]
    self_test._verdicts.clear()  # as another process
    devices.usable_device()
    assert len(asked) == 1
    (file,) = folder.iterdir()
    file.write_text('{"failure"')  # damaged
    self_test._verdicts.clear()
    devices.usable_device()
    assert len(asked) == 2


def test_what_a_verdict_is_kept_for(monkeypatch, only):
    key = self_test._key(only)
    assert key == self_test._key(only)
    identity = self_test.identity(only)
    monkeypatch.setattr(self_test, "identity", lambda device: [*identity[:-1], "other driver"])
    assert self_test._key(only) != key
    monkeypatch.setattr(self_test, "identity", lambda device: identity)
    monkeypatch.setattr(self_test, "_clra_version", lambda: "99")
    assert self_test._key(only) != key


@pytest.mark.parametrize(("program", "trials"), [(WRONG, 1), (ABORTS, 1), (HANGS, 2)])
def test_a_failure_is_kept_unless_it_was_only_slow(monkeypatch, only, program, trials):
    asked = replace_trials(monkeypatch, [program])
    for _ in range(2):
        self_test._verdicts.clear()
        with pytest.raises(DeviceError):
            devices.usable_device()
    assert len(asked) == trials


def test_a_narrower_cpu_is_tried_and_taken_from_then_on(monkeypatch, only):
    monkeypatch.setattr(pocl, "covered", COVERED)
    monkeypatch.setattr(pocl, "needs_pairing", lambda device: True)
    monkeypatch.setattr(pocl, "cpu_flags", lambda: frozenset(VARIANT_OF_HASWELL | {"avx512f"}))
    asked = replace_trials(monkeypatch, [ABORTS, WRONG, RIGHT])
    assert devices.usable_device() is only
    assert [one["cpu"] for one in asked] == [None, "haswell", "x86-64"]
    assert pocl._preferred == "x86-64"
    pocl.prefer_cpu(None)
    self_test._verdicts.clear()
    devices.usable_device()
    assert pocl._preferred == "x86-64" and len(asked) == 3


COVERED = pocl.covered
VARIANT_OF_HASWELL = {"sse2"} | next(flags for _, cpu, flags in pocl.VARIANTS if cpu == "haswell")


def test_another_device_stands_in_unless_one_was_asked_for(monkeypatch, two):
    replace_trials(monkeypatch, [ABORTS, RIGHT])
    with pytest.warns(ClraWarning, match=r"fails clra's self-test.*: other .* is used instead"):
        assert devices.usable_device() is two[1][1]
    with pytest.raises(DeviceError, match=r"fails clra's self-test.*choose another with --device"):
        devices.usable_device("0:0")
    monkeypatch.setenv("CLRA_DEVICE", "0:0")
    with pytest.raises(DeviceError, match="fails clra's self-test"):
        devices.usable_device()


def test_only_devices_that_pass_share_work(monkeypatch, only):
    replace_trials(monkeypatch, [RIGHT])
    assert devices.usable_devices("all") == [only]
    assert devices.usable_devices() == [only]


def test_it_can_be_turned_off(monkeypatch, only):
    asked = replace_trials(monkeypatch, [ABORTS])
    monkeypatch.setenv(self_test.VARIABLE, "0")
    assert devices.usable_device() is only
    assert asked == []
    assert not self_test.verdict(only, "0:0").tested


@pytest.mark.parametrize("executable", ["", "/opt/app/viewer", "/nowhere/python3"])
def test_where_no_python_can_be_started_devices_are_taken_untested(monkeypatch, only, executable):
    monkeypatch.setattr(self_test.sys, "executable", executable)
    assert devices.usable_device() is only
    assert not self_test.verdict(only, "0:0").tested


def test_a_trial_that_finds_no_modules_says_nothing_of_the_device(monkeypatch, only):
    replace_trials(monkeypatch, ["import no_such_module"])
    assert not self_test.verdict(only, "0:0").tested
    assert devices.usable_device() is only


def test_sub_devices_are_as_good_as_the_device(monkeypatch, only):
    if only.partition_max_sub_devices < 2:
        pytest.skip("the device has no sub-devices")
    asked = replace_trials(monkeypatch, [RIGHT])
    parts = only.create_sub_devices([cl.device_partition_property.EQUALLY, 1])
    assert devices.usable_device(parts[0]) is parts[0]
    assert len(asked) == 1


def test_the_real_trial_passes_in_its_process(monkeypatch):
    info = devices.devices()[0]
    found = self_test.verdict(devices.device_at(info.index), info.index, rate=True)
    assert found.tested and found.passed, found
    assert found.rate and found.rate > 0
    assert re.fullmatch(r"[0-9a-f]{24}", self_test._key(devices.device_at(info.index)))
