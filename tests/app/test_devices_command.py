"""Tests of devices from the command line, and commands on a device that fails."""

import json
import re

import pytest
from broken_devices import BROKEN, RIGHT, forget, replace_trials

import clra as library
from clra.errors import DeviceError
from clra.ops.runtime import devices, pocl, self_test


@pytest.fixture(autouse=True)
def only(monkeypatch, tmp_path):
    """One device, of which nothing is known."""
    forget(monkeypatch, tmp_path)
    device = devices.choose_device()
    monkeypatch.setattr(devices, "_all_devices", lambda: [("0:0", device)])
    monkeypatch.setattr(pocl, "covered", lambda cpus, flags: [])  # no other name to try
    return device


def test_a_device_that_passes(clra, monkeypatch, only):
    asked = replace_trials(monkeypatch, [RIGHT.replace("null", "1.5")])
    status, out, err = clra("devices", "--test", "--quiet")
    assert (status, err) == (0, "")
    head, row = out.splitlines()
    assert head.split() == ["device", "driver", "verdict", "G", "voxel-views/s"]
    assert re.fullmatch(rf"0:0 +{re.escape(only.name.strip())} .* passes +1\.5", row)
    status, out, _ = clra("devices", "--test", "--json", "--quiet")
    (found,) = json.loads(out)["devices"]
    assert found["passed"] and found["rate"] == 1.5 and found["failure"] == ""
    assert len(asked) == 2 and asked[0]["rate"]  # tested anew each time


@pytest.mark.parametrize("how", BROKEN)
def test_a_device_that_fails(clra, monkeypatch, how):
    program, words = BROKEN[how]
    replace_trials(monkeypatch, [program])
    status, out, _ = clra("devices", "--test", "--quiet")
    assert status == 1
    assert re.search(words, out.splitlines()[1])
    status, out, _ = clra("devices", "--test", "--json", "--quiet")
    (found,) = json.loads(out)["devices"]
    assert status == 1
    assert not found["passed"] and re.match(words, found["failure"]) and found["rate"] is None


def test_devices_are_listed_without_a_test(clra, monkeypatch):
    asked = replace_trials(monkeypatch, [RIGHT])
    assert clra("devices")[0] == 0
    assert asked == []


@pytest.mark.parametrize("how", BROKEN)
def test_alignment_on_a_device_that_fails(clra, monkeypatch, how, scan, scan_file, tmp_path):
    program, words = BROKEN[how]
    replace_trials(monkeypatch, [program])
    with pytest.raises(DeviceError, match=words):
        library.align(scan)
    for command in (
        ("align", scan_file, "-o", tmp_path / "motion.h5"),
        ("reconstruct", scan_file, "-o", tmp_path / "volume.h5"),
    ):
        status, out, err = clra(*command, "--quiet")
        (line,) = err.splitlines()
        assert (status, out) == (1, "")
        assert re.match(rf"error: .* fails clra's self-test: {words}", line)
    assert not (tmp_path / "motion.h5").exists()


def test_the_first_use_is_told(monkeypatch, scan):
    replace_trials(monkeypatch, [RIGHT])
    for told in (True, False):
        progress = []
        library.reconstruct(scan, progress=progress.append)
        assert (self_test.STAGE in [step.stage for step in progress]) == told
