"""NXtomo out: radiographs, flats, darks and geometry, as other programs read them too."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

import clra
from clra.errors import InputError
from clra.io.atomic import atomic_path
from clra.io.nxtomo.clra_group import KIND_ATTRIBUTE, KINDS, write_additions
from clra.io.nxtomo.geometry_fields import Fields, fields_of, top_down
from clra.io.nxtomo.reader import DARK, FLAT, INVALID, PROJECTION
from clra.io.provenance import Provenance
from clra.io.volumes.slab_files import SlabWriter, reserve
from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion
from clra.model.scan import DeliveredProjections, Projections
from clra.model.validation import checked_valid_views
from clra.progress import ProgressCallback, tell

Views = NDArray[np.intp]

# Frames are copied in pieces of about this many bytes: small enough for any machine's memory, large
# enough that the disk is the limit.
_PIECE = 8 << 20

# The layout that the files follow. From 2.0 on nxtomo speaks of axes named otherwise.
_NXTOMO_VERSION = 1.5


def write_nxtomo(
    path: str | os.PathLike[str],
    radiographs: Projections,
    geometry: ConeBeamGeometry,
    *,
    flats: Projections | None = None,
    flats_after: Projections | None = None,
    darks: Projections | None = None,
    kind: str = "counts",
    dtype: Any = None,
    name: str = "scan",
    truth: Motion | None = None,
    mask: NDArray[np.bool_] | None = None,
    valid_views: NDArray[np.bool_] | None = None,
    fields: Fields | None = None,
    propagation_distance: float | None = None,
    provenance: Provenance | None = None,
    progress: ProgressCallback | None = None,
) -> None:
    """Write a scan as NXtomo; the file appears whole or not at all.

    Row 0 of NXtomo is the top of the radiograph. Where the rows of `geometry` count upwards
    (v along +z) they are reversed in the file, and with them v and the sign of `truth.shift_v`.

    Parameters
    ----------
    path : path-like
        The file.
    radiographs : array or array-like object, (views, rows, columns)
        Sliced along the first axis, some at a time; or :class:`DeliveredProjections`.
    geometry : ConeBeamGeometry
        Of the radiographs.
    flats, flats_after, darks : array or array-like object, (n, rows, columns), optional
        Darks and flats are written before the radiographs, `flats_after` behind them.
    kind : {"counts", "transmission", "line-integrals"}
        What the radiographs hold.
    dtype : dtype-like, optional
        Of the pixels in the file; by default that of the radiographs.
    name : str
        Title of the scan.
    truth : Motion, optional
        The motion that a simulation put in.
    mask : ndarray of bool, (rows, columns), optional
        True where the pixels may be used.
    valid_views : ndarray of bool, (views,), optional
        Radiographs to be used, at least one; the frames of others keep their places, and are marked
        as invalid ones. All by default.
    fields : Fields, optional
        The geometry in NXtomo's terms, where it came from them; else they are worked out.
    propagation_distance : float, optional
        From sample to detector [mm], where a parallel beam leaves it out of the geometry.
    provenance : mapping of str to str, optional
        Attributes of the root: where the scan comes from. The version of clra is kept in any case.
    progress : callable, optional
        Called with a ``Progress`` as frames are written.

    Raises
    ------
    InputError
        If the arrays do not fit the geometry, or no radiograph is to be used.
    OutputError
        If the file cannot be written.
    """
    if kind not in KINDS:
        raise InputError(f"kind: found {kind!r}, expected one of {KINDS}")
    expected = (geometry.views, *geometry.shape)
    if tuple(radiographs.shape) != expected:
        raise InputError(f"radiographs: found shape {radiographs.shape}, expected {expected}")
    ordered = ((DARK, darks), (FLAT, flats), (PROJECTION, radiographs), (FLAT, flats_after))
    parts = [(role, part) for role, part in ordered if part is not None]
    for _, part in parts:
        if tuple(part.shape[1:]) != geometry.shape:
            raise InputError(f"frames: found shape {part.shape}, expected (n, *{geometry.shape})")
    if valid_views is None:
        valid_views = np.ones(geometry.views, np.bool_)
    valid_views = checked_valid_views(valid_views, geometry.views)
    pixels = np.dtype(dtype if dtype is not None else radiographs[0:1].dtype).newbyteorder("=")
    roles = np.concatenate([np.full(part.shape[0], role, np.int32) for role, part in parts])
    views = np.flatnonzero(roles == PROJECTION)
    roles[views[~valid_views]] = INVALID
    shape = (len(roles), *geometry.shape)
    geometry, reverse = top_down(geometry)
    if reverse and truth is not None:
        truth = Motion(
            shift_u=truth.shift_u,
            shift_v=-truth.shift_v,
            magnification=truth.magnification,
            cause=truth.cause,
        )
    exact = True
    if fields is None:
        fields, exact = fields_of(geometry)
    # A frame's angle, translations, vectors and so on take some 200 bytes.
    size = int(np.prod(shape, dtype=np.int64)) * pixels.itemsize + 256 * len(roles) + (1 << 20)
    with atomic_path(path, size) as temporary:
        with h5py.File(temporary, "w") as file:
            entry = _group(file, "entry", "NXentry")
            file.attrs.update({"clra_version": clra.__version__, **(provenance or {})})
            file.attrs["default"] = "entry"
            data, offset = _detector(entry, fields, roles, views, shape, pixels)
            data.attrs[KIND_ATTRIBUTE] = kind
            _sample(entry, fields, len(roles), views, name, propagation_distance)
            _links(entry, name)
            write_additions(
                entry,
                geometry=geometry,
                exact=exact,
                truth=truth,
                mask=mask[::-1] if reverse and mask is not None else mask,
                views=views,
                count=len(roles),
            )
        with SlabWriter(temporary, offset, shape, pixels) as writer:
            _copy(
                writer, [part for _, part in parts], reverse, Path(path).absolute().parent, progress
            )


def _copy(
    writer: SlabWriter,
    parts: list[Projections],
    reverse: bool,
    folder: Path,
    progress: ProgressCallback | None,
) -> None:
    """Write the frames of every part, one part after the other."""
    rows, columns = writer.shape[1:]
    step = max(1, _PIECE // (rows * columns * writer.dtype.itemsize))
    first = 0

    def take(start: int, frames: NDArray[Any]) -> None:
        writer.write(first + start, frames[:, ::-1] if reverse else frames)

    for part in parts:
        count = part.shape[0]
        if isinstance(part, DeliveredProjections):
            part.deliver(take, folder, progress)
        else:
            for start in range(0, count, step):
                stop = min(start + step, count)
                take(start, np.asarray(part[start:stop]))
                tell(progress, "writing", first + stop, writer.shape[0])
        first += count


def _detector(
    entry: h5py.Group,
    fields: Fields,
    roles: NDArray[np.int32],
    views: Views,
    shape: tuple[int, ...],
    pixels: np.dtype[Any],
) -> tuple[h5py.Dataset, int]:
    """Write the instrument; return the frames' data set, still empty, and its place."""
    instrument = _group(entry, "instrument", "NXinstrument")
    source = _group(instrument, "source", "NXsource")
    source["probe"] = "x-ray"
    _put(source, "distance", -_one_or_each(fields.source_distance, views, len(roles)), "mm")
    detector = _group(instrument, "detector", "NXdetector")
    detector["image_key"] = roles
    detector["image_key_control"] = roles
    _put(detector, "x_pixel_size", fields.pixel[0], "mm")
    _put(detector, "y_pixel_size", fields.pixel[1], "mm")
    _put(detector, "distance", _one_or_each(fields.detector_distance, views, len(roles)), "mm")
    data, offset = reserve(detector, "data", shape, pixels)
    data.attrs["interpretation"] = "image"
    return data, offset


def _sample(
    entry: h5py.Group,
    fields: Fields,
    count: int,
    views: Views,
    name: str,
    propagation_distance: float | None,
) -> None:
    """Write the sample: its name, angles and translations."""
    sample = _group(entry, "sample", "NXsample")
    sample["name"] = name
    _put(sample, "rotation_angle", _spread(np.rad2deg(fields.angle), views, count), "degree")
    for axis, values in zip("xyz", fields.translation.T, strict=True):
        _put(sample, f"{axis}_translation", _spread(values, views, count), "mm")
    if propagation_distance is not None:
        _put(sample, "propagation_distance", propagation_distance, "mm")


def _links(entry: h5py.Group, name: str) -> None:
    """Write title and definition, and the group that viewers plot."""
    entry["definition"] = "NXtomo"
    entry["title"] = name
    entry.attrs["definition"] = "NXtomo"
    entry.attrs["version"] = _NXTOMO_VERSION
    entry.attrs["default"] = "data"
    data = _group(entry, "data", "NXdata")
    data.attrs["signal"] = "data"
    for label, target in (
        ("data", "instrument/detector/data"),
        ("image_key", "instrument/detector/image_key"),
        ("rotation_angle", "sample/rotation_angle"),
    ):
        data[label] = h5py.SoftLink(f"{entry.name}/{target}")
        entry[target].attrs["target"] = f"{entry.name}/{target}"


def _group(parent: h5py.Group, name: str, nexus_class: str) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs["NX_class"] = nexus_class
    return group


def _put(group: h5py.Group, name: str, value: Any, unit: str) -> None:
    group[name] = value
    group[name].attrs["units"] = unit


def _spread(values: NDArray[np.float64], views: Views, count: int) -> NDArray[np.float64]:
    """Values of the radiographs, at their frames; flats and darks get those of the nearest."""
    nearest = np.clip(np.arange(count) - views[0], 0, len(values) - 1)
    return np.asarray(values[nearest], np.float64)


def _one_or_each(values: NDArray[np.float64], views: Views, count: int) -> Any:
    """Return the one value where all are equal, as NXtomo has it."""
    return values[0] if np.all(values == values[0]) else _spread(values, views, count)
