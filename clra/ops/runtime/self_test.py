"""Whether a device computes right: a trial in a child process, whose verdict is kept.

A compiler or driver that aborts, hangs or gives wrong numbers so meets the child and not the user's
process. See :mod:`clra.ops.runtime.trial` for what is tried.
"""

import hashlib
import json
import logging
import os
import signal
import subprocess
import sys
import threading
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import pyopencl as cl

from clra.errors import DeviceError
from clra.ops.runtime import pocl
from clra.ops.runtime.cache_folder import cache_folder
from clra.progress import ProgressCallback, tell

VARIABLE = "CLRA_SELF_TEST"  # 0 turns it off
SECONDS = 120.0  # the trial takes 4 to 10 on an idle machine, most of it for building
STAGE = "testing the device, once"

# Where the name that belongs to PoCL's built-ins does not work: fewer features, less speed.
_NARROWER = ("haswell", "x86-64")
_PYTHON_ERROR = "Traceback (most recent call last)"
_log = logging.getLogger(__name__)
_lock = threading.RLock()
_verdicts: dict[str, "Verdict"] = {}


@dataclass(frozen=True)
class Verdict:
    """Outcome of the trial of a device.

    Attributes
    ----------
    failure : str
        What went wrong, in one line; empty if the device passed.
    cpu : str or None
        CPU name that PoCL's compiler has to be given for the device to pass, where it is not the
        one that belongs to its built-ins.
    rate : float or None
        Speed of back-projection, 1e9 voxels times views a second, where it was measured.
    tested : bool
        False if the trial could not run, or was turned off.
    """

    failure: str = ""
    cpu: str | None = None
    rate: float | None = None
    tested: bool = True

    @property
    def passed(self) -> bool:
        """Whether nothing is known against the device."""
        return not self.failure


def identity(device: cl.Device) -> list[str]:
    """Return what a verdict depends on: platform, driver and device."""
    names = (device.platform.name, device.platform.version, device.name, device.driver_version)
    return [" ".join(name.split()) for name in names]


def verdict(
    device: cl.Device,
    index: str,
    progress: ProgressCallback | None = None,
    *,
    anew: bool = False,
    rate: bool = False,
) -> Verdict:
    """Return whether a device passes; from memory, from the cache or by a trial.

    Parameters
    ----------
    device : cl.Device
        A root device.
    index : str
        "platform:device", by which another process finds it.
    progress : callable, optional
        Told before a trial, which takes some seconds.
    anew : bool
        Have a trial in any case.
    rate : bool
        Measure the speed as well.

    Returns
    -------
    Verdict
    """
    if os.environ.get(VARIABLE) == "0" and not anew:
        return Verdict(tested=False)
    key = _key(device)
    with _lock:
        found = None if anew else _verdicts.get(key) or _read(key)
        if found is None:
            _log.info("%s: %s", STAGE, device.name.strip())
            tell(progress, STAGE, 0, 1)
            found = _tried(device, index, rate)
            _keep(key, found)
        _verdicts[key] = found
        if found.cpu:
            pocl.prefer_cpu(found.cpu)
    return found


def _tried(device: cl.Device, index: str, rate: bool) -> Verdict:
    first = _trial(device, index, None, rate)
    if first.passed or not pocl.needs_pairing(device) or first.failure.startswith(_HANGS):
        return first
    usual = pocl.cpu_of_variant(pocl.cpu_flags())
    for cpu in pocl.covered(_NARROWER, pocl.cpu_flags()):
        if cpu != usual and (other := _trial(device, index, cpu, rate)).passed:
            return other
    return first


_HANGS = "does not come to an end"


def _trial(device: cl.Device, index: str, cpu: str | None, rate: bool) -> Verdict:
    """Run the child process and judge how it ended."""
    request = {"index": index, "identity": identity(device), "cpu": cpu, "rate": rate}
    code, out, errors = _run_child(json.dumps(request))
    last = errors.strip().splitlines()[-1:] or [""]
    if code is None:
        return Verdict(f"{_HANGS} within {SECONDS:.0f} s")
    if code == 0 and out.strip():
        answer = json.loads(out.strip().splitlines()[-1])
        return Verdict(answer["failure"], cpu if not answer["failure"] else None, answer["rate"])
    if _PYTHON_ERROR in errors or code == _NOT_STARTED:
        _log.warning("the self-test of %s could not run: %s", device.name.strip(), last[0])
        return Verdict(tested=False)
    how = f"ended by {_signal_name(-code)}" if code < 0 else f"ended with status {code}"
    reason = next((line for line in errors.splitlines() if "LLVM ERROR" in line), last[0])
    return Verdict(f"its compiler or driver {how}{f' ({reason.strip()[:120]})' if reason else ''}")


_NOT_STARTED = 1 << 16


def _run_child(request: str) -> tuple[int | None, str, str]:
    """Status (None: it took too long), output and errors of a trial."""
    name = Path(sys.executable or "").stem.lower()
    if not name.startswith(("python", "pypy")):  # embedded in a program that is not Python
        return _NOT_STARTED, "", f"{sys.executable} is no Python"
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        VARIABLE: "0",
    }
    try:
        child = subprocess.Popen(
            _command(request),
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,  # what it starts itself is ended with it
        )
    except OSError as error:
        return _NOT_STARTED, "", str(error)
    try:
        out, errors = child.communicate(timeout=SECONDS)
    except subprocess.TimeoutExpired:
        return None, "", ""
    finally:
        _end(child)
    return child.returncode, out, errors


def _command(request: str) -> list[str]:
    return [sys.executable, "-P", "-m", "clra.ops.runtime.trial", request]


def _end(child: "subprocess.Popen[str]") -> None:
    if child.poll() is not None:
        return
    if hasattr(os, "killpg"):
        os.killpg(child.pid, signal.SIGKILL)
    else:
        child.kill()
    child.communicate()


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _key(device: cl.Device) -> str:
    """Name of the file that keeps the verdict."""
    about = [*identity(device), _clra_version()]
    if device.type & cl.device_type.CPU:
        # The driver may name but the maker; home folders are shared between machines.
        about += sorted(pocl.cpu_flags())
    return hashlib.sha256(json.dumps(about).encode()).hexdigest()[:24]


def _clra_version() -> str:
    try:
        return metadata.version("clra")
    except metadata.PackageNotFoundError:  # on the path without being installed
        return ""


def _file(key: str) -> Path:
    return cache_folder() / f"self-test-{key}.json"


def _read(key: str) -> Verdict | None:
    try:
        values: dict[str, Any] = json.loads(_file(key).read_text())
        return Verdict(**values)
    except (OSError, ValueError, TypeError, DeviceError):
        return None


def _keep(key: str, found: Verdict) -> None:
    if not found.tested or found.failure.startswith(_HANGS):  # another time it may be quicker
        return
    try:
        file = _file(key)
        part = file.with_name(f"{file.name}.{os.getpid()}")
        part.write_text(json.dumps(asdict(found)))
        part.replace(file)
    except (OSError, DeviceError) as error:
        _log.info("the verdict is not kept: %s", error)
