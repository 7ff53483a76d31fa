"""Volumes out and in, with the grid they live on: picks the format by the suffix."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import clra
from clra.errors import InputError, OutputError
from clra.io.atomic import atomic_folder, atomic_path
from clra.io.damage import reads
from clra.io.provenance import Provenance
from clra.io.volumes.hdf5_volume import hdf5_writer, read_hdf5_volume
from clra.io.volumes.integer_limits import Limits, integer_writer
from clra.io.volumes.nrrd_volume import nrrd_volume, nrrd_writer
from clra.io.volumes.ome_zarr import zarr_library, zarr_volume, zarr_writer
from clra.io.volumes.raw_volume import raw_volume, raw_writer
from clra.io.volumes.tiff import tiff_volume, tiff_writer
from clra.io.volumes.volume_description import PlaneSink, VolumeDescription, decoded
from clra.model.grid import VolumeGrid
from clra.progress import ProgressCallback, tell

HDF5 = (".h5", ".hdf5", ".nxs")
TIFF = (".tif", ".tiff")
SUFFIXES = (*HDF5, *TIFF, ".zarr", ".nrrd", ".raw")

# Voxels are copied in pieces of about this many bytes, as frames are.
_PIECE = 8 << 20


def volume_suffix(path: str | os.PathLike[str]) -> str:
    """Return the suffix by which a volume's format is chosen.

    Raises
    ------
    OutputError
        If there is no such format.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        expected = ", ".join(SUFFIXES)
        raise OutputError(
            f"cannot write {os.fspath(path)}: found suffix {suffix!r}, expected one of {expected}"
        )
    return suffix


@contextmanager
def open_volume(
    path: str | os.PathLike[str],
    grid: VolumeGrid,
    *,
    units: str = "1/mm",
    provenance: Provenance | None = None,
    dtype: str = "float32",
    limits: Limits | None = None,
    compression: str | None = None,
) -> Iterator[PlaneSink]:
    """Open a volume for writing slab by slab; the file appears whole or not at all.

    Parameters
    ----------
    path : path-like
        The suffix chooses the format: .h5 or .hdf5; .tif or .tiff, above 4 GB a BigTIFF; .zarr, an
        OME-Zarr 0.5 with its pyramid; .nrrd; .raw, with a .json beside it.
    grid : VolumeGrid
        Of the whole volume.
    units : str
        Of the values.
    provenance : mapping of str to str, optional
        Where the volume comes from, see :func:`clra.io.provenance.provenance`. The version of clra
        is kept in any case.
    dtype : {"float32", "uint16", "uint8"}
        As which the voxels are stored; of integers the file tells scale and offset.
    limits : Limits, optional
        Of the integers; by default the percentiles 0.01 and 99.99 of all voxels that are not 0.
        Percentiles take a temporary file of 4 bytes a voxel.
    compression : {"gzip"}, optional
        Of HDF5; OME-Zarr is compressed without loss in any case.

    Yields
    ------
    PlaneSink
        Its ``write(start, slab)`` takes the planes from `start` on, in any order. Planes that were
        never written are 0.

    Raises
    ------
    InputError
        If an option does not fit the format.
    OutputError
        If the suffix is unknown or the file cannot be written.
    """
    suffix = volume_suffix(path)
    if compression is not None and (suffix not in HDF5 or compression != "gzip"):
        raise InputError(f"compression: found {compression!r} for {suffix}, expected gzip of .h5")
    told = {"clra_version": clra.__version__, **(provenance or {})}
    description = VolumeDescription(grid, units, dtype, provenance=told)

    def opened(whole: VolumeDescription) -> AbstractContextManager[PlaneSink]:
        return _open_file(Path(path), suffix, whole, compression)

    if dtype == "float32":
        with opened(description) as writer:
            yield writer
        return
    folder = Path(os.path.realpath(path)).parent
    with integer_writer(folder, description, limits or Limits(), opened) as writer:
        yield writer


@contextmanager
def _open_file(
    path: Path, suffix: str, description: VolumeDescription, compression: str | None
) -> Iterator[PlaneSink]:
    size = description.bytes + (1 << 20)
    if suffix == ".zarr":
        zarr_library()  # rather than at the end of the long work
        # All coarser levels together take a seventh.
        with atomic_folder(path, size + size // 7) as folder, zarr_writer(folder, description) as w:
            yield w
        return
    with atomic_path(path, size) as temporary:
        if suffix in HDF5:
            writer = hdf5_writer(temporary, description, compression)
        elif suffix in TIFF:
            writer = tiff_writer(temporary, description)
        elif suffix == ".nrrd":
            writer = nrrd_writer(temporary, description)
        else:
            writer = raw_writer(temporary, path, description)
        with writer as sink:
            yield sink


def write_volume(
    path: str | os.PathLike[str],
    volume: NDArray[Any],
    grid: VolumeGrid,
    *,
    units: str = "1/mm",
    provenance: Provenance | None = None,
    dtype: str = "float32",
    limits: Limits | None = None,
    compression: str | None = None,
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
    provenance, dtype, limits, compression
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
    with open_volume(
        path,
        grid,
        units=units,
        provenance=provenance,
        dtype=dtype,
        limits=limits,
        compression=compression,
    ) as writer:
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
        As clra writes it, or a TIFF or NRRD that tells the size of its voxels. Integers become
        values by the scale that the file tells.
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
    suffix = Path(path).suffix.lower()
    openers = {".zarr": zarr_volume, ".nrrd": nrrd_volume, ".raw": raw_volume}
    openers |= dict.fromkeys(TIFF, tiff_volume)
    if suffix not in openers:
        part, shape, size, centre = read_hdf5_volume(path, slice(start, stop))
        first, last, _ = slice(start, stop).indices(shape[0])
        return part, _grid(path, shape, size, centre).slab(first, last)
    voxels, size, centre, scaling = openers[suffix](path)
    grid = _grid(path, voxels.shape, size, centre)
    first, last, _ = slice(start, stop).indices(grid.shape[0])
    return decoded(voxels[first:last], *scaling), grid.slab(first, last)


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
