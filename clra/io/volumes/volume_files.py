"""Volumes out and in: HDF5 and TIFF, with the grid they live on."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import DTypeLike, NDArray

import clra
from clra.errors import InputError, OutputError
from clra.io.atomic import atomic_path
from clra.io.damage import reads
from clra.io.hdf5 import open_hdf5, require, text
from clra.io.provenance import Provenance
from clra.io.units import TO_MM, factor
from clra.io.volumes.slab_files import SlabWriter, reserve
from clra.io.volumes.tiff import tiff_layout, tiff_volume
from clra.model.grid import VolumeGrid
from clra.progress import ProgressCallback, tell

HDF5 = (".h5", ".hdf5", ".nxs")
TIFF = (".tif", ".tiff")

# Voxels are copied in pieces of about this many bytes, as frames are.
_PIECE = 8 << 20


@contextmanager
def open_volume(
    path: str | os.PathLike[str],
    grid: VolumeGrid,
    *,
    units: str = "1/mm",
    provenance: Provenance | None = None,
) -> Iterator[SlabWriter]:
    """Open a volume for writing slab by slab; the file appears whole or not at all.

    Parameters
    ----------
    path : path-like
        Ends in .h5 or .hdf5, or in .tif or .tiff; a TIFF above 4 GB becomes a BigTIFF.
    grid : VolumeGrid
        Of the whole volume.
    units : str
        Of the voxels.
    provenance : mapping of str to str, optional
        Where the volume comes from, see :func:`clra.io.provenance.provenance`: attributes of the
        root in HDF5, a line of the description in TIFF. The version of clra is kept in any case.

    Yields
    ------
    SlabWriter
        Its ``write(start, slab)`` takes the planes from `start` on, in any order. Planes that were
        never written are 0.

    Raises
    ------
    OutputError
        If the suffix is unknown or the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in HDF5 + TIFF:
        raise OutputError(
            f"cannot write {os.fspath(path)}: found suffix {suffix!r}, expected one of "
            f"{', '.join(HDF5 + TIFF)}"
        )
    size = 4 * int(np.prod(grid.shape, dtype=np.int64))
    with atomic_path(path, size + (1 << 20)) as temporary:
        lay_out = _hdf5_layout if suffix in HDF5 else tiff_layout
        made = {"clra_version": clra.__version__, **(provenance or {})}
        offset, dtype = lay_out(temporary, grid, units, made)
        with SlabWriter(temporary, offset, grid.shape, dtype) as writer:
            yield writer


def write_volume(
    path: str | os.PathLike[str],
    volume: NDArray[Any],
    grid: VolumeGrid,
    *,
    units: str = "1/mm",
    provenance: Provenance | None = None,
    progress: ProgressCallback | None = None,
) -> None:
    """Write a volume; the file appears whole or not at all.

    Parameters
    ----------
    path : path-like
        As for :func:`open_volume`.
    volume : ndarray or array-like object, (z, y, x)
        Sliced along z.
    grid : VolumeGrid
        Of the volume.
    units : str
        Of the voxels.
    provenance : mapping of str to str, optional
        As for :func:`open_volume`.
    progress : callable, optional
        Called with a ``Progress`` as planes are written.

    Raises
    ------
    InputError
        If volume and grid disagree.
    OutputError
        If the file cannot be written.
    """
    if tuple(volume.shape) != grid.shape:
        raise InputError(f"volume: found shape {volume.shape}, expected {grid.shape} as in grid")
    planes, rows, columns = grid.shape
    step = max(1, _PIECE // (4 * rows * columns))
    with open_volume(path, grid, units=units, provenance=provenance) as writer:
        for start in range(0, planes, step):
            stop = min(start + step, planes)
            writer.write(start, np.asarray(volume[start:stop]))
            tell(progress, "writing", stop, planes)


@reads
def read_volume(
    path: str | os.PathLike[str], start: int = 0, stop: int | None = None
) -> tuple[NDArray[np.float32], VolumeGrid]:
    """Read the planes `start` to `stop - 1` of a volume.

    Parameters
    ----------
    path : path-like
        HDF5 as clra writes it, or a TIFF whose resolution tells the size of its voxels.
    start, stop : int
        Range of planes; all of them if not given.

    Returns
    -------
    volume : ndarray of float32, (z, y, x)
        The planes.
    grid : VolumeGrid
        Where they lie.

    Raises
    ------
    InputError
        If it is no volume, or does not tell the size of a voxel.
    """
    if Path(path).suffix.lower() in TIFF:
        voxels, size, centre = tiff_volume(path)
        grid = _grid(path, voxels.shape, size, centre)
        first, last, _ = slice(start, stop).indices(grid.shape[0])
        return np.asarray(voxels[first:last], np.float32), grid.slab(first, last)
    return _read_hdf5(path, slice(start, stop))


def _hdf5_layout(
    path: Path, grid: VolumeGrid, units: str, provenance: Provenance
) -> tuple[int, DTypeLike]:
    """Write everything but the voxels; return where they go and as what."""
    with h5py.File(path, "w") as file:
        file.attrs.update(provenance)
        dataset, offset = reserve(file, "volume", grid.shape, np.float32)
        dataset.attrs.update(
            units=units,
            axes="z, y, x",
            voxel_size=grid.voxel_size,
            voxel_size_units="mm",
            centre=grid.centre,
            centre_units="mm",
            centre_axes="x, y, z",
        )
    return offset, np.float32


def _read_hdf5(
    path: str | os.PathLike[str], planes: slice
) -> tuple[NDArray[np.float32], VolumeGrid]:
    with open_hdf5(path) as file:
        dataset = require(file, "volume", "a volume as clra writes it")
        if dataset.ndim != 3:
            raise InputError.at(path, "/volume", f"{dataset.ndim} axes", "z, y, x")
        size = _numbers(dataset, "voxel_size", ())
        scale = factor(text(dataset.attrs.get("voxel_size_units", "mm")), TO_MM)
        if scale is None:
            raise InputError.at(path, "/volume@voxel_size_units", "an unknown unit", "mm")
        centre = _numbers(dataset, "centre", (0.0, 0.0, 0.0))
        grid = _grid(path, dataset.shape, size[0] * scale, tuple(value * scale for value in centre))
        first, last, _ = planes.indices(grid.shape[0])
        return np.asarray(dataset[first:last], np.float32), grid.slab(first, last)


def _numbers(dataset: h5py.Dataset, name: str, default: tuple[float, ...]) -> list[float]:
    """Read an attribute of one or more numbers."""
    value = dataset.attrs.get(name, default)
    try:
        numbers = [float(v) for v in np.asarray(value, np.float64).ravel()]
    except (TypeError, ValueError):
        numbers = []
    if not numbers:
        where = f"{dataset.name}@{name}"
        found = "nothing" if value is default else repr(value)
        raise InputError.at(dataset.file.filename, where, found, "numbers")
    return numbers


def _grid(
    path: str | os.PathLike[str], shape: tuple[int, ...], size: float, centre: tuple[float, ...]
) -> VolumeGrid:
    """Build the grid that a file tells."""
    try:
        planes, rows, columns = (int(n) for n in shape)
        x, y, z = (float(c) for c in centre)
        return VolumeGrid(shape=(planes, rows, columns), voxel_size=size, centre=(x, y, z))
    except ValueError as error:
        raise InputError(f"{os.fspath(path)}: grid: {error}") from error
