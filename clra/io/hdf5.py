"""HDF5 in: opening, finding and unit conversion, each failure told in one line."""

from __future__ import annotations

import os
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.units import TO_MM, TO_RADIANS, factor

Floats = NDArray[np.float64]


def open_hdf5(path: str | os.PathLike[str]) -> h5py.File:
    """Open an HDF5 file for reading.

    Parameters
    ----------
    path : path-like
        The file.

    Raises
    ------
    InputError
        If there is no such file, or it is no whole HDF5 file.
    """
    if not Path(path).exists():
        raise InputError(f"{os.fspath(path)}: no such file")
    if not Path(path).is_file():
        raise InputError(f"{os.fspath(path)}: found a folder, expected a file")
    try:
        if not h5py.is_hdf5(path):
            # h5py says the same of a file that it may not read.
            with open(path, "rb") as stream:
                start = stream.read(8)
            raise InputError.at(path, "signature", f"{start!r}", "an HDF5 file")
        return _open_reading(path)
    except OSError as error:
        raise InputError(
            f"{os.fspath(path)}: cannot be opened as HDF5: {_reason(error)}"
        ) from error


def _open_reading(path: str | os.PathLike[str]) -> h5py.File:
    """Open for reading, on file systems that know no locks too."""
    try:
        return h5py.File(path, "r")
    except OSError as error:
        if "lock" not in str(error):
            raise
        return h5py.File(path, "r", locking=False)


class StoredArray:
    """A data set that travels to another process as the path of its file and its name.

    Parameters
    ----------
    dataset : h5py.Dataset
        Open for reading.

    Attributes
    ----------
    shape, dtype, name
        Of the data set.
    """

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset = dataset
        self.shape: tuple[int, ...] = dataset.shape
        self.dtype = dataset.dtype
        self.name: str = dataset.name

    def __len__(self) -> int:
        """Return the length of the first axis."""
        return self.shape[0]

    def __getitem__(self, index: Any) -> Any:
        """Read a part."""
        return self._dataset[index]

    def __reduce__(self) -> tuple[Any, ...]:
        return _stored, (os.path.abspath(self._dataset.file.filename), self.name)


def _stored(path: str, name: str) -> StoredArray:
    return StoredArray(require(open_hdf5(path), name, "what was read from it elsewhere"))


def find(group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset | None:
    """Return what `name` leads to below `group`, or None where there is nothing.

    Raises
    ------
    InputError
        If a link on the way leads nowhere, saying which and whither.
    """
    here: Any = group
    for part in name.strip("/").split("/"):
        if not isinstance(here, h5py.Group) or part not in here:
            return None
        try:
            here = here[part]
        except (KeyError, OSError, RuntimeError) as error:
            link = here.get(part, getlink=True)
            where = f"{here.name.rstrip('/')}/{part}"
            raise InputError.at(
                group.file.filename, where, f"a link to {_whither(link)} that leads nowhere",
                "the data themselves: put that file back, or copy the scan whole",
            ) from error  # fmt: skip
    return here


def peek(group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset | None:
    """Return what `name` leads to below `group`, or None where it leads nowhere."""
    try:
        return group.get(name)
    except (KeyError, OSError, RuntimeError):
        return None


def require(group: h5py.Group, name: str, what: str) -> h5py.Dataset:
    """Return the data set `name` below `group`.

    Raises
    ------
    InputError
        If it is missing (`what` tells what it would hold), no data set, or leads nowhere.
    """
    found = find(group, name)
    if not isinstance(found, h5py.Dataset):
        kind = "nothing" if found is None else "a group"
        where = f"{group.name.rstrip('/')}/{name}"
        raise InputError.at(group.file.filename, where, kind, what)
    check_sources(found)
    check_filters(found)
    return found


def check_filters(dataset: h5py.Dataset) -> None:
    """Raise where a data set is compressed in a way that this HDF5 cannot undo.

    The package hdf5plugin, where it is installed, brings the ways that HDF5 itself lacks.
    """
    plan = dataset.id.get_create_plist()
    codes = [plan.get_filter(k)[0] for k in range(plan.get_nfilters())]
    if all(h5py.h5z.filter_avail(code) for code in codes):
        return
    with suppress(ImportError):
        import_module("hdf5plugin")
    missing = [code for code in codes if not h5py.h5z.filter_avail(code)]
    if missing:
        raise InputError.at(
            dataset.file.filename, dataset.name, f"frames compressed by HDF5 filter {missing[0]}",
            "one that is installed: pip install hdf5plugin",
        )  # fmt: skip


def check_sources(dataset: h5py.Dataset) -> None:
    """Raise where a data set's bytes lie in other files that are not there.

    HDF5 itself would fill the holes with zeros and say nothing.
    """
    if not dataset.is_virtual:
        return
    folder = Path(dataset.file.filename).parent
    for name, inside in {(s.file_name, s.dset_name) for s in dataset.virtual_sources()}:
        if "%" in name:  # a pattern for files that may not exist yet
            continue
        if name == ".":
            there = inside in dataset.file
        else:
            there = any(_holds(file, inside) for file in (folder / name, Path(name)))
        if not there:
            raise InputError.at(
                dataset.file.filename, dataset.name, f"a part in {name}:{inside} that is not there",
                "the data themselves: put that file back, or copy the scan whole",
            )  # fmt: skip


def _holds(path: Path, name: str) -> bool:
    """Whether a file is HDF5 and `name` leads to something in it."""
    if not path.is_file() or not h5py.is_hdf5(path):
        return False
    with h5py.File(path, "r") as file:
        return file.get(name) is not None


def numbers(dataset: h5py.Dataset, what: str, *, finite: bool = True) -> Floats:
    """Read a data set of a few numbers as float64, 1-D, all of them finite unless told otherwise.

    Raises
    ------
    InputError
        If it holds anything else.
    """
    values = dataset[()]
    try:
        array = np.atleast_1d(np.asarray(values, dtype=np.float64))
    except (TypeError, ValueError):
        text = values.ravel()[:1] if isinstance(values, np.ndarray) else values
        raise InputError.at(dataset.file.filename, dataset.name, f"{text!r}", what) from None
    bad = array[~np.isfinite(array)] if finite else array[:0]
    if not array.size or bad.size:
        found = bad[0] if bad.size else "no number"
        raise InputError.at(dataset.file.filename, dataset.name, found, what)
    return array.ravel()


def lengths(dataset: h5py.Dataset, what: str, *, finite: bool = True) -> Floats:
    """Read lengths, 1-D [mm]; without a `units` attribute they are in metres, as in nxtomo."""
    return numbers(dataset, what, finite=finite) * _scale(dataset, TO_MM, "m")


def angles(dataset: h5py.Dataset, what: str, *, finite: bool = True) -> Floats:
    """Read angles, 1-D [rad]; without a `units` attribute they are in degrees, as in nxtomo."""
    return numbers(dataset, what, finite=finite) * _scale(dataset, TO_RADIANS, "degree")


def text(value: object) -> str:
    """Return an attribute or a scalar data set as text, whatever string type it was stored as."""
    if isinstance(value, h5py.Dataset):
        value = value[()]
    if isinstance(value, np.ndarray):
        value = value.ravel()[0] if value.size else ""
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _scale(dataset: h5py.Dataset, table: dict[str, float], default: str) -> float:
    """Factor from the data set's units to ours."""
    unit = text(dataset.attrs.get("units", dataset.attrs.get("unit", default))).strip()
    scale = factor(unit, table)
    if scale is None:
        where = f"{dataset.name}@units"
        raise InputError.at(dataset.file.filename, where, repr(unit), f"one of {', '.join(table)}")
    return scale


def _whither(link: object) -> str:
    """Where a link points, as text."""
    if isinstance(link, h5py.ExternalLink):
        return f"{link.filename}:{link.path}"
    return link.path if isinstance(link, h5py.SoftLink) else "a damaged object"


def _reason(error: OSError) -> str:
    """Return the part of an HDF5 message that a user can do something with."""
    message = str(error)
    if "truncated file" in message:
        return "the file is truncated; copy it again"
    return error.strerror or message
