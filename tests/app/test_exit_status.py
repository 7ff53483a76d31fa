import errno
import warnings

import pyopencl as cl
import pytest

from clra.app.exit_status import InterruptedCommandError, _plain_warnings, verdict
from clra.errors import DeviceError, InputError, KernelBuildError, OutputError
from clra.ops.streaming.memory import DeviceMemoryError


@pytest.mark.parametrize(
    ("error", "status", "part"),
    [
        (InputError.at("a.nxs", "angle", 3, 4), 2, "a.nxs: angle: found 3, expected 4"),
        (ValueError("operands could not be broadcast"), 1, "a bug in clra, please report it"),
        (NotImplementedError(), 1, "a bug in clra"),
        (TypeError("an integer is required"), 1, "a bug in clra"),
        (FileNotFoundError(errno.ENOENT, "No such file", "a.txt"), 2, "a.txt: No such file"),
        (OutputError.writing("v.h5", errno.ENOSPC, ""), 1, "free some space"),
        (OSError(errno.ENOSPC, "No space left on device", "v.h5"), 1, "free some space"),
        (PermissionError(errno.EACCES, "Permission denied", "v.h5"), 1, "v.h5"),
        (DeviceError("no OpenCL device"), 1, "no OpenCL device"),
        (DeviceMemoryError("too large"), 1, "too large"),
        (KernelBuildError("kernel a.cl does not build\nlog\nlog"), 1, "--device"),
        (MemoryError(), 1, "clra info"),
        (cl.MemoryError("clEnqueue"), 1, "clra info"),
        (cl.RuntimeError("clFinish"), 1, "--device"),
        (ZeroDivisionError("oops"), 1, "ZeroDivisionError: oops"),
        (InterruptedCommandError(), 130, "nothing was written"),
    ],
)
def test_every_error_has_a_status_and_one_line(error, status, part):
    found, line = verdict(error)
    assert found == status
    assert part in line
    assert "\n" not in line and line == line.strip()


def test_the_log_of_a_compiler_stays_out_of_the_line():
    _, line = verdict(KernelBuildError("kernel a.cl does not build: error\nline 3: bad"))
    assert "line 3" not in line


def test_warnings_are_one_line_and_compiler_logs_none(capsys):
    with _plain_warnings():
        warnings.simplefilter("always")
        warnings.warn("two\nlines", stacklevel=1)
        warnings.warn("log", cl.CompilerWarning, stacklevel=1)
    assert capsys.readouterr().err == "warning: two lines\n"


def test_a_bug_shows_its_traceback_and_bad_input_does_not(clra, monkeypatch, scan_file):
    def fails(*_: object, **__: object) -> None:
        raise ValueError("operands could not be broadcast")

    monkeypatch.setattr("clra.io.scan_files.read_scan", fails)
    code, out, err = clra("info", scan_file)
    assert (code, out) == (1, "")
    assert err.startswith("Traceback") and "in fails" in err
    last = err.splitlines()[-1]
    assert last.startswith("error: ")
    assert last.endswith("ValueError: operands could not be broadcast")
    monkeypatch.undo()
    code, out, err = clra("info", "none.nxs")
    assert (code, out, err) == (2, "", "error: none.nxs: no such file\n")
