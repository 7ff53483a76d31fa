"""MOTION.h5: an estimated motion, how much to trust it, and how it was found."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError
from clra.io.atomic import atomic_path
from clra.io.hdf5 import find, open_hdf5, require, text
from clra.model.motion import Motion

Floats = NDArray[np.float64]

_UNITS = {"shift_u": "pixel", "shift_v": "pixel", "magnification": "1"}
_MEANING = (
    "A feature that the ideal geometry puts at pixel q = (column, row) of the full-resolution "
    "detector appears at c + magnification (q - c) + shift, c the detector's centre, shift = "
    "(shift_u, shift_v): positive toward higher columns and higher rows. If the cause is 'source', "
    "this holds at the depth of the rotation axis: the source moved, and the detector did not."
)

_FLAGGED = (
    "Views, counted from 0, whose registration is rejected: they have the motion that lies "
    "between their neighbours', and are best left out of a reconstruction."
)


@dataclasses.dataclass(frozen=True)
class MotionFile:
    """What a motion file holds.

    Parameters
    ----------
    motion : Motion
        The motion.
    confidence : ndarray of float64, (views,), or None
        0 to 1.
    flagged : tuple of int
        Views whose registration is rejected; where the file does not list them, those without
        any confidence.
    history : dict of str to ndarray
        The run, a column of one value an iteration each; empty where the file tells none.
    attributes : dict of str to str
        Version, schedule, device, scan and checksum, where the file tells them.
    """

    motion: Motion
    confidence: Floats | None = None
    flagged: tuple[int, ...] = ()
    history: dict[str, NDArray[Any]] = dataclasses.field(default_factory=dict)
    attributes: dict[str, str] = dataclasses.field(default_factory=dict)


def write_motion_file(
    path: str | os.PathLike[str],
    motion: Motion,
    *,
    confidence: ArrayLike | None = None,
    flagged: Sequence[int] = (),
    history: Sequence[Any] = (),
    schedule: str = "",
    device: str = "",
    scan: str = "",
    checksum: str = "",
    attributes: Mapping[str, str | float] | None = None,
) -> None:
    """Write a motion file; it appears whole or not at all.

    Parameters
    ----------
    path : path-like
        The file.
    motion : Motion
        The motion.
    confidence : array_like, (views,), optional
        0 to 1.
    flagged : sequence of int
        Views whose registration is rejected, from 0.
    history : sequence of dataclass instances or mappings
        One an iteration, all with the same fields of numbers, text or None.
    schedule, device, scan, checksum : str
        How and from what it was estimated.
    attributes : mapping, optional
        What else is to be known of the run.

    Raises
    ------
    InputError
        If `confidence` does not fit the motion.
    OutputError
        If the file cannot be written.
    """
    # Built in memory: on a full disk HDF5 itself would crash.
    with h5py.File("motion", "w", driver="core", backing_store=False) as file:
        file.attrs.update(
            version=_version(),
            schedule=schedule,
            device=device,
            scan=scan,
            checksum=checksum,
            **(attributes or {}),
        )
        group = file.create_group("motion")
        group.attrs.update(meaning=_MEANING, cause=motion.cause)
        for name, unit in _UNITS.items():
            group[name] = getattr(motion, name)
            group[name].attrs["units"] = unit
        if confidence is not None:
            values = np.asarray(confidence, np.float64)
            if values.shape != (motion.views,):
                raise InputError(
                    f"confidence: found shape {values.shape}, expected ({motion.views},)"
                )
            group["confidence"] = values
            group["confidence"].attrs["units"] = "1"
        group["flagged"] = np.array(flagged, np.int64)
        group["flagged"].attrs["meaning"] = _FLAGGED
        _write_history(file.create_group("history"), history)
        file.flush()
        image = file.id.get_file_image()
    with atomic_path(path) as temporary:
        temporary.write_bytes(image)


def read_motion_file(path: str | os.PathLike[str]) -> MotionFile:
    """Read a motion file; only the shifts must be there.

    Parameters
    ----------
    path : path-like
        The file.

    Raises
    ------
    InputError
        If it is no motion file or its columns do not fit each other.
    """
    with open_hdf5(path) as file:
        columns = {}
        for name in ("shift_u", "shift_v"):
            columns[name] = _column(require(file, f"motion/{name}", "a motion as clra writes it"))
        for name in ("magnification", "confidence"):
            dataset = find(file, f"motion/{name}")
            if isinstance(dataset, h5py.Dataset):
                columns[name] = _column(dataset)
        views = len(columns["shift_u"])
        for name, values in columns.items():
            if len(values) != views:
                raise InputError.at(
                    path, f"/motion/{name}", f"{len(values)} values", f"{views} as in shift_u"
                )
        confidence = columns.pop("confidence", None)
        try:
            motion = Motion(**columns, cause=_cause(file["motion"]))
        except ValueError as error:
            raise InputError(f"{os.fspath(path)}: /motion: {error}") from error
        attributes = {name: text(value) for name, value in file.attrs.items()}
        flagged = _flagged(file, views, confidence)
        return MotionFile(motion, confidence, flagged, _read_history(file), attributes)


def _version() -> str:
    try:
        return metadata.version("clra")
    except metadata.PackageNotFoundError:
        return "unknown"  # run from a checkout that is not installed


def _column(dataset: h5py.Dataset) -> Floats:
    """Read one number a view; whether they are finite is the motion's own affair."""
    where = (dataset.file.filename, dataset.name)
    if dataset.ndim != 1 or dataset.dtype.kind not in "iuf":
        found = f"shape {dataset.shape} of {dataset.dtype}"
        raise InputError.at(*where, found, "a number for each view")
    return np.asarray(dataset[()], np.float64)


def _flagged(file: h5py.File, views: int, confidence: Floats | None) -> tuple[int, ...]:
    """Read which views are rejected."""
    dataset = find(file, "motion/flagged")
    if not isinstance(dataset, h5py.Dataset):
        return () if confidence is None else tuple(np.flatnonzero(confidence == 0).tolist())
    values = _column(dataset)
    if not np.isin(values, np.arange(views)).all():
        where = (file.filename, dataset.name)
        raise InputError.at(*where, f"{values.tolist()}", f"numbers of views, 0 to {views - 1}")
    return tuple(values.astype(int).tolist())


def _write_history(group: h5py.Group, history: Sequence[Any]) -> None:
    """Write a column for each field of the rows."""
    rows = [dict(r) if isinstance(r, Mapping) else dataclasses.asdict(r) for r in history]
    group.attrs["rows"] = "one for each iteration"
    for name in rows[0] if rows else ():
        values = [row[name] for row in rows]
        if any(isinstance(value, str) for value in values):
            group[name] = np.array([str(v) for v in values], dtype=h5py.string_dtype())
        else:
            group[name] = np.array([np.nan if v is None else v for v in values])


def _read_history(file: h5py.File) -> dict[str, NDArray[Any]]:
    group = find(file, "history")
    if not isinstance(group, h5py.Group):
        return {}
    columns = {name: find(group, name) for name in group}
    return {
        name: np.asarray(c.asstr()[()] if h5py.check_string_dtype(c.dtype) else c[()])
        for name, c in columns.items()
        if isinstance(c, h5py.Dataset)
    }


def _cause(group: h5py.Group) -> str:
    """Cause of a motion; files of version 0.1.0 call the detector a panel."""
    return text(group.attrs.get("cause", "detector")).replace("panel", "detector")  # 0.1.0
