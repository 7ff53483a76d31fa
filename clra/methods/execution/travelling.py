"""Tasks and scans written to files that workers read: pixels stay where they are stored."""

import os
import pickle
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np

from clra.errors import InputError
from clra.model.scan import Scan
from clra.ops.streaming.part_files import whole_file

# Images of a stack that may travel: mean flat and dark fields, not radiographs.
_FEW = 8


def write_task(path: Path, value: Any) -> None:
    """Write a task, with the scan that it reads, for other processes.

    Memory maps travel as the path and the place of what they map.

    Raises
    ------
    InputError
        As :func:`check_travels` does.
    """
    with whole_file(path) as file:
        _Pickler(file).dump(value)


def read_task(path: Path) -> Any:
    """Read what :func:`write_task` wrote; scans are open afterwards."""
    with open(path, "rb") as file:
        return _Unpickler(file).load()


@dataclass(frozen=True)
class Shared:
    """A value in a file, read once by each process that asks for it.

    Parameters
    ----------
    path : Path
        As :func:`write_task` wrote it.
    """

    path: Path

    def get(self) -> Any:
        """Return the value."""
        return _read_once(self.path)


@lru_cache(maxsize=2)
def _read_once(path: Path) -> Any:
    return read_task(path)


def check_travels(scan: Scan) -> None:
    """Refuse a scan whose radiographs other processes cannot read.

    Raises
    ------
    InputError
        If they are in memory only, or what reads them cannot be sent.
    """
    try:
        _Pickler(BytesIO()).dump(scan)
    except InputError:
        raise InputError(
            f"{scan.name}: found radiographs in this process's memory, which workers of a cluster "
            "cannot read, expected a scan in a file: clra.write_scan(path, scan), then "
            "clra.read_scan(path)"
        ) from None
    except (TypeError, AttributeError, pickle.PicklingError) as error:
        raise InputError(
            f"{scan.name}: found radiographs that cannot be opened by another process ({error}), "
            "expected a scan in a file: clra.write_scan(path, scan), then clra.read_scan(path)"
        ) from error


def _pickler() -> Any:
    # Readers of scanners' files have functions inside, which plain pickle refuses.
    import cloudpickle

    return cloudpickle.Pickler


class _Unpickler(pickle.Unpickler):
    def persistent_load(self, pid: Any) -> Any:
        path, offset, shape, dtype = pid
        return np.memmap(path, dtype, "r", offset, shape)


def _Pickler(file: IO[bytes]) -> Any:  # noqa: N802  (a class that is made when it is needed)
    """Return a pickler that sends places in files for memory maps, and refuses radiographs."""

    class Pickler(_pickler()):  # type: ignore[misc]
        def persistent_id(self, value: Any) -> Any:
            if isinstance(value, np.memmap):
                return _place(value)
            if isinstance(value, np.ndarray) and value.ndim == 3 and len(value) > _FEW:
                raise InputError("radiographs in memory")
            return None

    return Pickler(file)


def _place(array: "np.memmap[Any, Any]") -> tuple[str, int, tuple[int, ...], str]:
    """File, first byte, shape and type of a memory map or a run of its views."""
    root: Any = array
    while isinstance(root.base, np.memmap):
        root = root.base
    if not array.flags.c_contiguous or root.filename is None:
        raise InputError("a memory map that is no run of its file")
    first = root.offset + array.ctypes.data - root.ctypes.data
    return os.path.abspath(root.filename), int(first), array.shape, array.dtype.str
