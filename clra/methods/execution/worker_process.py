"""What runs in a worker of a cluster: one task after the other, on the worker's own device.

Nothing here imports OpenCL before the environment is set.
"""

import logging
import os
import pickle
import platform
import sys
import threading
import traceback
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_LOG = logging.getLogger(__name__)
# Tasks that stay open: those of two stages.
_OPEN = 2
_lock = threading.Lock()
_tasks: OrderedDict[str, Any] = OrderedDict()
_streams: dict[tuple[int, int], Any] = {}


@dataclass(frozen=True)
class WorkerFacts:
    """What a worker has to work with.

    Attributes
    ----------
    host : str
        Name of its machine.
    device : str
        Name of its device; empty if it has none.
    failure : str
        Why it has none.
    device_memory, largest_buffer, host_memory : int
        Bytes that the device has and gives at once, and that the machine has free.
    shared : bool
        Whether the device works in the machine's memory.
    gpu : bool
        Whether the worker was started with Dask's resource "GPU".
    """

    host: str
    device: str = ""
    failure: str = ""
    device_memory: int = 0
    largest_buffer: int = 0
    host_memory: int = 0
    shared: bool = False
    gpu: bool = False


@dataclass(frozen=True)
class Settings:
    """How a worker shall work.

    Attributes
    ----------
    neighbours : int
        Workers on a machine, which share its cores.
    device_memory, host_memory : int
        Bytes that one may use.
    """

    neighbours: int = 1
    device_memory: int = 0
    host_memory: int = 0


@dataclass(frozen=True)
class Outcome:
    """What became of a task.

    Attributes
    ----------
    worker, address : str
        Name of the worker for people, and its address.
    result : object
        What the task returned.
    findings : tuple
        That were issued meanwhile.
    error : Exception or None
        What the task raised.
    trace : str
        Where.
    """

    worker: str
    address: str
    result: Any = None
    findings: tuple[Any, ...] = ()
    error: Exception | None = None
    trace: str = ""


def facts(neighbours: int, shared_file: str) -> WorkerFacts:
    """Look at the worker that this runs in.

    Parameters
    ----------
    neighbours : int
        Workers on a machine.
    shared_file : str
        A file that every worker has to see.
    """
    with _lock:
        _prepare(neighbours)
        from clra.errors import DeviceError
        from clra.ops.runtime.profile import profile_of
        from clra.ops.streaming.memory import host_memory

        host = platform.node()
        if not Path(shared_file).is_file():
            return WorkerFacts(host, failure=f"it does not see {shared_file}")
        try:
            device = _device()
        except DeviceError as error:
            return WorkerFacts(host, failure=str(error))
        return WorkerFacts(
            host,
            device.name.strip(),
            device_memory=device.global_mem_size,
            largest_buffer=device.max_mem_alloc_size,
            host_memory=host_memory(),
            shared=profile_of(device).shared_memory,
            gpu=_resources().get("GPU", 0) >= 1,
        )


def run(path: str, item: Any, settings: Settings) -> Outcome:
    """Do a task with an item.

    Parameters
    ----------
    path : str
        File of the task, see :mod:`clra.methods.execution.travelling`.
    item : object
        What to do it with.
    settings : Settings
        The same for all tasks of a call.
    """
    with _lock:  # one device: tasks take turns, however many threads a worker has
        _prepare(settings.neighbours)
        from clra.findings import collected

        me = _name()
        with collected(silent=True) as findings:  # told by the caller's process
            try:
                task = _task(path)
                result = task(_stream(settings), item)
            except Exception as error:
                trace = traceback.format_exc()
                _LOG.warning("%s: %s", path, trace)
                return Outcome(*me, error=_portable(error), trace=trace)
        return Outcome(*me, result, tuple(findings))


def _prepare(neighbours: int) -> None:
    """Leave each worker of a machine its share of the cores, if PoCL is not loaded yet."""
    if "pyopencl" in sys.modules:
        return
    allowed = getattr(os, "sched_getaffinity", None)  # Linux
    cores = (len(allowed(0)) if allowed else os.cpu_count() or 1) // neighbours
    # Up to PoCL 3, and from PoCL 5 on.
    for name in ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT"):
        os.environ.setdefault(name, str(max(1, cores)))


def _device() -> Any:
    """Return the device of this worker: of several alike, the one of its number."""
    from clra.ops.runtime.devices import usable_device, usable_devices

    number = _number()
    if number is None or os.environ.get("CLRA_DEVICE"):
        return usable_device()
    devices = usable_devices("all")
    return devices[number % len(devices)]


def _number() -> int | None:
    """Return the number of this worker, if its name is one."""
    from distributed import get_worker

    name = get_worker().name
    return name if isinstance(name, int) else None


def _resources() -> dict[str, float]:
    """Return what the worker was started with, such as {"GPU": 1}."""
    from distributed import get_worker

    return dict(get_worker().state.total_resources)


def _name() -> tuple[str, str]:
    """Return by what users find this worker, and its address."""
    from distributed import get_worker

    worker = get_worker()
    named = f"{worker.name} at {worker.address}"
    return worker.address if worker.name == worker.address else named, worker.address


def _stream(settings: Settings) -> Any:
    from clra.ops.streaming.stream import Stream

    limits = (settings.device_memory, settings.host_memory)
    if limits not in _streams:
        _streams.clear()
        _streams[limits] = Stream(
            _device(),
            max_device_memory=settings.device_memory,
            max_host_memory=settings.host_memory,
        )
    return _streams[limits]


def _task(path: str) -> Any:
    from clra.methods.execution.travelling import read_task

    if path not in _tasks:
        _tasks[path] = read_task(Path(path))
        while len(_tasks) > _OPEN:
            _tasks.popitem(last=False)
    return _tasks[path]


def _portable(error: Exception) -> Exception:
    """Return an error that another process can have."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
