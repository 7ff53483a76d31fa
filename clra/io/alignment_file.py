"""MOTION.h5: a finished alignment, in HDF5."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.findings import Finding
from clra.io.atomic import atomic_path
from clra.io.damage import reads
from clra.io.hdf5 import find, open_hdf5, require, text
from clra.methods.alignment.result import AlignmentResult, Iteration
from clra.methods.assessment.quality import Quality
from clra.model.motion import Motion
from clra.model.rigid.rigid_motion import RigidMotion

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
_SIGMA = (
    "Standard errors of shift_u, shift_v [pixel] and magnification, a row a view; of a rigid "
    "motion those of the rotations [rad] follow."
)
_RIGID = (
    "The sample moved by `translation` [mm] along, and turned by `rotation` [rad] about, the "
    "view's u, v and beam axes, about the point at the depth of the rotation axis on the "
    "perpendicular from the source to the detector. shift_u, shift_v and magnification are those "
    "of a point there."
)
# What files of version 0.1.0 tell of the standard errors: their medians.
_MEDIANS = ("sigma_u", "sigma_v", "sigma_magnification")
# Fields of the result that are texts, and those that are kept as JSON.
_TEXTS = ("method", "schedule", "estimate", "device", "command", "scan", "checksum")
_JSON = ("gauge", "versions", "warnings", "quality")


def write_alignment(path: str | os.PathLike[str], result: AlignmentResult) -> None:
    """Write an alignment, all of it; the file appears whole or not at all.

    Parameters
    ----------
    path : path-like
        The file, by custom ``MOTION.h5``.
    result : AlignmentResult
        Its volume, if there is one, is kept too: ``dataclasses.replace(result, volume=None)``
        leaves it out. The file is built in memory.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    # Built in memory: on a full disk HDF5 itself would crash.
    with h5py.File("motion", "w", driver="core", backing_store=False) as file:
        file.attrs.update(result.about)
        file.attrs.update({name: getattr(result, name) for name in _TEXTS})
        file.attrs["version"] = result.versions.get("clra", "")
        file.attrs["gauge"] = json.dumps(dict(result.gauge))
        plain = {
            "versions": dict(result.versions),
            "warnings": [finding.as_dict() for finding in result.warnings],
            "quality": None if result.quality is None else result.quality.as_dict(),
        }
        for name, value in plain.items():
            # Attributes hold 64 KiB at most, and findings may be many.
            file[name] = json.dumps(value)
        group = file.create_group("motion")
        group.attrs.update(meaning=_MEANING, cause=result.motion.cause)
        for name, unit in _UNITS.items():
            group[name] = getattr(result.motion, name)
            group[name].attrs["units"] = unit
        if isinstance(result.motion, RigidMotion):
            for name in ("translation", "rotation", "optics"):
                group[name] = getattr(result.motion, name)
            group.attrs["rigid"] = _RIGID
        group["confidence"] = result.confidence
        group["confidence"].attrs["units"] = "1"
        group["sigma"] = result.sigma
        group["sigma"].attrs["meaning"] = _SIGMA
        group["flagged"] = np.array(result.flagged, np.int64)
        group["flagged"].attrs["meaning"] = _FLAGGED
        _write_history(file.create_group("history"), result.history)
        if result.volume is not None:
            file["volume"] = result.volume
            file["volume"].attrs.update(units="1/mm", order="z, y, x")
        file.flush()
        image = file.id.get_file_image()
    with atomic_path(path, len(image)) as temporary:
        temporary.write_bytes(image)


@reads
def read_alignment(path: str | os.PathLike[str]) -> AlignmentResult:
    """Read an alignment; only the shifts must be there.

    Parameters
    ----------
    path : path-like
        As :func:`write_alignment`, ``clra align`` or version 0.1.0 wrote it.

    Returns
    -------
    AlignmentResult
        What the file does not tell is as if all were well: every view valid, but for those without
        any confidence where the file lists none; confidence 1; sigma NaN.

    Raises
    ------
    InputError
        If it is no such file or its columns do not fit each other.
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
            motion = _motion(file, columns)
        except ValueError as error:
            raise InputError(f"{os.fspath(path)}: /motion: {error}") from error
        attributes = {name: text(value) for name, value in file.attrs.items()}
        plain = {name: _plain(file, name, attributes.pop(name, "null")) for name in _JSON}
        medians = [attributes.pop(name, "nan") for name in _MEDIANS]
        version = attributes.pop("version", "")
        history = _read_history(file)
        return AlignmentResult(
            motion=motion,
            valid_views=_valid_views(file, views, confidence),
            confidence=np.ones(views) if confidence is None else confidence,
            sigma=_sigma(file, views, medians),
            history=history,
            gauge=_numbers(plain["gauge"]),
            quality=_quality(plain["quality"]),
            warnings=_warnings(file, plain["warnings"], history),
            volume=_volume(file),
            **{name: attributes.pop(name, "") for name in _TEXTS},
            versions=_texts(plain["versions"]) or ({"clra": version} if version else {}),
            about=attributes,
        )


def _motion(file: h5py.File, columns: dict[str, Floats]) -> Motion:
    """Read a rigid motion where there is one, else shifts."""
    group = file["motion"]
    names = ("translation", "rotation", "optics")
    if not all(isinstance(find(file, f"motion/{name}"), h5py.Dataset) for name in names):
        return Motion(**columns, cause=_cause(group))
    tables = {name: np.asarray(group[name][()], np.float64) for name in names}
    return RigidMotion(**tables)


def _column(dataset: h5py.Dataset) -> Floats:
    """Read one number a view; whether they are finite is the motion's own affair."""
    where = (dataset.file.filename, dataset.name)
    if dataset.ndim != 1 or dataset.dtype.kind not in "iuf":
        found = f"shape {dataset.shape} of {dataset.dtype}"
        raise InputError.at(*where, found, "a number for each view")
    return np.asarray(dataset[()], np.float64)


def _valid_views(file: h5py.File, views: int, confidence: Floats | None) -> NDArray[np.bool_]:
    """Read which views are rejected; the others are valid."""
    valid = np.ones(views, np.bool_)
    dataset = find(file, "motion/flagged")
    if not isinstance(dataset, h5py.Dataset):
        return valid if confidence is None else confidence != 0
    values = _column(dataset)
    if not np.isin(values, np.arange(views)).all():
        where = (file.filename, dataset.name)
        raise InputError.at(*where, f"{values.tolist()}", f"numbers of views, 0 to {views - 1}")
    valid[values.astype(int)] = False
    return valid


def _sigma(file: h5py.File, views: int, medians: Sequence[str]) -> Floats:
    """Read standard errors; of version 0.1.0 there are medians only."""
    dataset = find(file, "motion/sigma")
    if isinstance(dataset, h5py.Dataset):
        if dataset.ndim != 2 or len(dataset) != views or dataset.dtype.kind not in "iuf":
            found = f"shape {dataset.shape} of {dataset.dtype}"
            raise InputError.at(file.filename, dataset.name, found, f"{views} rows of numbers")
        return np.asarray(dataset[()], np.float64)
    try:
        return np.tile([float(median) for median in medians], (views, 1))
    except ValueError:
        return np.full((views, len(_MEDIANS)), np.nan)


def _volume(file: h5py.File) -> NDArray[np.float32] | None:
    dataset = find(file, "volume")
    if not isinstance(dataset, h5py.Dataset):
        return None
    if dataset.ndim != 3 or dataset.dtype.kind != "f":
        found = f"shape {dataset.shape} of {dataset.dtype}"
        raise InputError.at(file.filename, dataset.name, found, "float32 in order z, y, x")
    return np.asarray(dataset[()], np.float32)


def _write_history(group: h5py.Group, history: Sequence[Iteration]) -> None:
    """Write a column for each field of the iterations."""
    rows = [dataclasses.asdict(iteration) for iteration in history]
    group.attrs["rows"] = "one for each iteration"
    for name in rows[0] if rows else ():
        values = [row[name] for row in rows]
        if any(isinstance(value, str) for value in values):
            group[name] = np.array([str(v) for v in values], dtype=h5py.string_dtype())
        else:
            group[name] = np.array([np.nan if v is None else v for v in values])


def _read_history(file: h5py.File) -> tuple[Iteration, ...]:
    """Read the iterations; none if another version wrote too few columns, or the file none."""
    group = find(file, "history")
    if not isinstance(group, h5py.Group):
        return ()
    known = dataclasses.fields(Iteration)
    columns: dict[str, list[Any]] = {}
    for name in (f.name for f in known if f.name in group):
        column = find(group, name)
        if not isinstance(column, h5py.Dataset) or column.ndim != 1:
            raise InputError.at(file.filename, f"/history/{name}", "none", "a value an iteration")
        texts = h5py.check_string_dtype(column.dtype)
        columns[name] = (column.asstr()[()] if texts else column[()]).tolist()
    needed = {f.name for f in known if f.default is dataclasses.MISSING}
    if not needed <= set(columns):
        return ()
    if len({len(column) for column in columns.values()}) != 1:
        raise InputError.at(file.filename, "/history", "columns of several lengths", "one length")
    rows = zip(*columns.values(), strict=True)
    return tuple(Iteration(**dict(zip(columns, map(_known, row), strict=True))) for row in rows)


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


def _plain(file: h5py.File, name: str, attribute: str) -> Any:
    """Read plain values from JSON, in a data set or an attribute."""
    dataset = find(file, name)
    told = text(dataset) if isinstance(dataset, h5py.Dataset) else attribute
    try:
        return json.loads(told)
    except ValueError:
        raise InputError.at(file.filename, f"/{name}", repr(told[:40]), "JSON") from None


def _numbers(values: Any) -> dict[str, float]:
    if not isinstance(values, Mapping):
        return {}
    return {key: float(v) for key, v in values.items() if isinstance(v, (int, float))}


def _texts(values: Any) -> dict[str, str]:
    return {key: str(v) for key, v in values.items()} if isinstance(values, Mapping) else {}


def _warnings(file: h5py.File, values: Any, history: Sequence[Iteration]) -> tuple[Finding, ...]:
    """Restore findings; files of version 0.1.0 have notes of the iterations instead."""
    if values is None:
        notes = [note for step in history for note in step.note.splitlines()]
        return tuple(Finding("note", note) for note in dict.fromkeys(notes))
    try:
        return tuple(Finding.from_dict(value) for value in values)
    except TypeError as error:
        raise InputError(f"{file.filename}: /warnings: {error}") from error


def _quality(values: Any) -> Quality | None:
    return Quality.from_dict(values) if isinstance(values, Mapping) else None


def _cause(group: h5py.Group) -> str:
    """Cause of a motion; files of version 0.1.0 call the detector a panel."""
    return text(group.attrs.get("cause", "detector")).replace("panel", "detector")  # 0.1.0
