"""Volumes as HDF5: one run of voxels, or compressed chunks."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.hdf5 import open_hdf5, require, text
from clra.io.units import TO_MM, factor
from clra.io.volumes.slab_files import SlabWriter, reserve
from clra.io.volumes.volume_description import PlaneSink, VolumeDescription, decoded

# Planes and pixels of a compressed chunk: a slice along any axis then touches a part of the file.
_CHUNK = (16, 128, 128)


@contextmanager
def hdf5_writer(
    path: Path, description: VolumeDescription, compression: str | None
) -> Iterator[PlaneSink]:
    """Write a volume into the data set /volume of a new file.

    Parameters
    ----------
    path : Path
        The file.
    description : VolumeDescription
        Goes into the attributes of the data set, the provenance into those of the root.
    compression : {"gzip"}, optional
        Store chunks of 16 x 128 x 128 voxels, shuffled and compressed.

    Yields
    ------
    PlaneSink
    """
    with h5py.File(path, "w") as file:
        file.attrs.update(description.provenance)
        shape, dtype = description.grid.shape, description.stored
        if compression is not None:
            chunks = tuple(min(n, c) for n, c in zip(shape, _CHUNK, strict=True))
            dataset = file.create_dataset(
                "volume", shape, dtype, chunks=chunks, compression=compression, shuffle=True
            )
            dataset.attrs.update(description.attributes())
            yield _Chunked(dataset)
            return
        dataset, offset = reserve(file, "volume", shape, dtype)
        dataset.attrs.update(description.attributes())
    with SlabWriter(path, offset, shape, dtype) as writer:
        yield writer


class _Chunked:
    """Planes of a data set."""

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset = dataset

    def write(self, start: int, part: NDArray[Any], /) -> None:
        self._dataset[start : start + len(part)] = part


def read_hdf5_volume(
    path: str | os.PathLike[str], planes: slice
) -> tuple[NDArray[np.float32], tuple[int, ...], float, tuple[float, ...]]:
    """Read planes of a volume as :func:`hdf5_writer` writes it.

    Parameters
    ----------
    path : path-like
        The file.
    planes : slice
        Which.

    Returns
    -------
    volume : ndarray of float32, (z, y, x)
        The planes.
    shape, voxel_size, centre
        Of the whole volume [mm].

    Raises
    ------
    InputError
        If it is no volume, or does not tell the size of a voxel.
    """
    with open_hdf5(path) as file:
        dataset = require(file, "volume", "a volume as clra writes it")
        if dataset.ndim != 3:
            raise InputError.at(path, "/volume", f"{dataset.ndim} axes", "z, y, x")
        size = _numbers(dataset, "voxel_size", ())
        unit = factor(text(dataset.attrs.get("voxel_size_units", "mm")), TO_MM)
        if unit is None:
            raise InputError.at(path, "/volume@voxel_size_units", "an unknown unit", "mm")
        centre = tuple(value * unit for value in _numbers(dataset, "centre", (0.0, 0.0, 0.0)))
        scale = _numbers(dataset, "scale_factor", (1.0,))[0]
        offset = _numbers(dataset, "add_offset", (0.0,))[0]
        voxels = decoded(dataset[planes], scale, offset)
        return voxels, dataset.shape, size[0] * unit, centre


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
