"""The trial of a device in a child process, and what becomes of its verdict."""

import json
import re
import sys

import pytest

import clra
from clra.app import cli
from clra.errors import DeviceError
from clra.ops.runtime import devices, pocl, self_test, trial

ABORTS = "import os, sys; print('LLVM ERROR: Cannot select: FILD', file=sys.stderr); os.abort()"
HANGS = "import time; time.sleep(600)"
WRONG = 'print(\'{"failure": "vectors: wrong numbers, off by 0.5 of the largest", "rate": null}\')'
RIGHT = 'print(\'{"failure": "", "rate": null}\')'
CRASHES = "import ctypes; ctypes.string_at(0)"
BROKEN = {
    "aborts": (ABORTS, r"ended by SIGABRT \(LLVM ERROR: Cannot select: FILD\)"),
    "crashes": (CRASHES, "ended by SIGSEGV"),
    "hangs": (HANGS, "does not come to an end within 1 s"),
    "wrong": (WRONG, "vectors: wrong numbers, off by 0.5"),
}


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path):
    """Nothing is known of any device, and what is found out stays here."""
    monkeypatch.setattr(self_test, "_verdicts", {})
    monkeypatch.setattr(self_test, "cache_folder", lambda: tmp_path)
    monkeypatch.delenv(self_test.VARIABLE, raising=False)
    yield tmp_path
    pocl.prefer_cpu(None)


def children(monkeypatch, *codes):
    """Let the trials be these programs, one after the other, the last one over and over."""
    left, asked = list(codes), []

    def command(request):
        asked.append(json.loads(request))
        return [sys.executable, "-c", left.pop(0) if len(left) > 1 else left[0]]

    monkeypatch.setattr(self_test, "_command", command)
    monkeypatch.setattr(self_test, "SECONDS", 1.0)
    return asked


def test_the_device_of_these_tests_passes(device_failure):
    assert device_failure == ""


def test_every_case_of_the_trial_is_right_here(queue):
    for name, (case, tolerance) in trial.CASES.items():
        found, expected = case(queue)
        assert found.size, name
        error = abs(found - expected).max() / abs(expected).max()
        assert error < tolerance, name


def test_trial_refuses_another_device_than_was_meant():
    with pytest.raises(LookupError, match="is another one here"):
        index = devices.devices()[0].index
        trial.main(json.dumps({"index": index, "identity": ["x"], "cpu": None, "rate": False}))


@pytest.mark.parametrize(
    ("name", "kernel", "defect"),
    [
        ("forward projection", "forwardproject_columns.cl", ("fma(", "mad24_(")),
    ],
)
def test_what_does_not_build_is_a_failure(queue, monkeypatch, name, kernel, defect):
    source = clra.kernels.source
    monkeypatch.setattr(
        clra.kernels,
        "source",
        lambda file: (
            source(file) + "\nthis is no C;" if file.startswith("forward") else source(file)
        ),
    )
    assert re.match(r"forward projection: kernel forward.* does not build", trial.failure(queue))


def test_wrong_numbers_are_a_failure(queue, monkeypatch):
    def half(queue):
        found, expected = trial.vectors(queue)
        return found * 1.001, expected

    monkeypatch.setitem(trial.CASES, "vectors", (half, trial.TOLERANCE))
    assert trial.failure(queue) == "vectors: wrong numbers, off by 0.001 of the largest"
    monkeypatch.setitem(
        trial.CASES, "vectors", (lambda queue: (half(queue)[0] * float("nan"), half(queue)[1]), 1.0)
    )
    assert "wrong numbers, off by nan" in trial.failure(queue)


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_device_gives_a_device_error(how, monkeypatch):
    code, words = BROKEN[how]
    children(monkeypatch, code)
    with pytest.raises(DeviceError, match=words) as raised:
        devices.usable_device()
    assert "\n" not in str(raised.value)
    assert "fails clra's self-test" in str(raised.value)
    assert "pip install 'clra[pocl]'" in str(raised.value)


@pytest.mark.parametrize("how", BROKEN)
def test_align_on_a_broken_device(how, monkeypatch, tmp_path, capsys, small_scan):
    code, words = BROKEN[how]
    children(monkeypatch, code)
    with pytest.raises(DeviceError, match=words):
        clra.align(small_scan)
    path = tmp_path / "scan.nxs"
    write_small(path, small_scan)
    with pytest.raises(SystemExit) as ended:
        cli.main(["align", str(path), "-o", str(tmp_path / "motion.h5"), "--quiet"])
    assert ended.value.code == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert re.match(rf"error: .*fails clra's self-test: .*{words}", line)


def test_a_verdict_is_kept_and_read_by_another_process(monkeypatch, own_cache):
    asked = children(monkeypatch, RIGHT)
    told = []
    for _ in range(2):
        devices.usable_device(progress=told.append)
    assert len(asked) == len(told) == 1
    assert told[0].stage == self_test.STAGE
    self_test._verdicts.clear()  # as another process
    devices.usable_device()
    assert len(asked) == 1
    (file,) = own_cache.iterdir()
    file.write_text("{")  # damaged
    self_test._verdicts.clear()
    devices.usable_device()
    assert len(asked) == 2


def test_a_failure_is_kept_but_not_that_it_took_too_long(monkeypatch):
    for code, trials in ((WRONG, 1), (HANGS, 2)):
        asked = children(monkeypatch, code)
        monkeypatch.setattr(pocl, "needs_pairing", lambda device: False)
        for _ in range(2):
            self_test._verdicts.clear()
            with pytest.raises(DeviceError):
                devices.usable_device()
        assert len({json.dumps(one) for one in asked}) == len(devices.devices())
        assert len(asked) == trials * len(devices.devices())
        [file.unlink() for file in self_test.cache_folder().iterdir()]
