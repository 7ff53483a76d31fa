"""Volumes as OME-Zarr 0.5 [1]_: a folder of chunks in several resolutions, for napari and the web.

References
----------
.. [1] https://ngff.openmicroscopy.org/0.5/
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.volumes.volume_description import PlaneSink, VolumeDescription
from clra.model.grid import VolumeGrid

# Voxels of a chunk. Few planes, so that slabs that arrive one after another rewrite few chunks.
_CHUNK = (16, 256, 256)
# The coarsest level has no axis longer than this.
_COARSEST = 128


def zarr_library() -> Any:
    """Import zarr.

    Raises
    ------
    InputError
        If it is not installed.
    """
    try:
        import zarr
    except ImportError as error:
        raise InputError(
            "zarr: found no such package, expected it for OME-Zarr: pip install 'clra[zarr]'"
        ) from error
    return zarr


@contextmanager
def zarr_writer(path: Path, description: VolumeDescription) -> Iterator[PlaneSink]:
    """Write a volume slab by slab, and its coarser levels at the end.

    Parameters
    ----------
    path : Path
        A folder that is there and empty.
    description : VolumeDescription
        Goes into the attribute "clra" of the group.

    Yields
    ------
    PlaneSink
    """
    root = zarr_library().open_group(store=str(path), mode="w", zarr_format=3)
    grids = _levels(description.grid)
    root.attrs["ome"] = {
        "version": "0.5",
        "multiscales": [
            {
                "name": "volume",
                "axes": [{"name": n, "type": "space", "unit": "millimeter"} for n in "zyx"],
                "datasets": [
                    {"path": str(level), "coordinateTransformations": _transformations(grid)}
                    for level, grid in enumerate(grids)
                ],
                "type": "mean of 2 x 2 x 2",
            }
        ],
    }
    root.attrs["clra"] = {**description.attributes(), "provenance": dict(description.provenance)}
    arrays = [
        root.create_array(
            str(level),
            shape=grid.shape,
            dtype=description.stored,
            chunks=tuple(min(n, c) for n, c in zip(grid.shape, _CHUNK, strict=True)),
            dimension_names=["z", "y", "x"],
        )
        for level, grid in enumerate(grids)
    ]
    yield _Planes(arrays[0])
    for fine, coarse in pairwise(arrays):
        _bin(fine, coarse)


class _Planes:
    """Planes of an array."""

    def __init__(self, array: Any) -> None:
        self._array = array

    def write(self, start: int, part: NDArray[Any], /) -> None:
        self._array[start : start + len(part)] = part


def _levels(grid: VolumeGrid) -> list[VolumeGrid]:
    levels = [grid]
    while max(levels[-1].shape) > _COARSEST and min(levels[-1].shape) > 1:
        levels.append(levels[-1].binned())
    return levels


def _transformations(grid: VolumeGrid) -> list[dict[str, Any]]:
    """Scale, and where the middle of the first voxel lies [mm]."""
    first = [float(axis[0]) for axis in grid.coordinates()[::-1]]
    return [
        {"type": "scale", "scale": [grid.voxel_size] * 3},
        {"type": "translation", "translation": first},
    ]


def _bin(fine: Any, coarse: Any) -> None:
    """Average 2 x 2 x 2 voxels, some planes at a time."""
    nz, ny, nx = coarse.shape
    for start in range(0, nz, _CHUNK[0]):
        stop = min(nz, start + _CHUNK[0])
        part = np.asarray(fine[2 * start : 2 * stop, : 2 * ny, : 2 * nx], np.float32)
        mean = part.reshape(stop - start, 2, ny, 2, nx, 2).mean(axis=(1, 3, 5))
        whole = np.issubdtype(coarse.dtype, np.integer)
        coarse[start:stop] = (np.rint(mean) if whole else mean).astype(coarse.dtype)


def zarr_volume(
    path: str | os.PathLike[str],
) -> tuple[Any, float, tuple[float, ...], tuple[float, float]]:
    """Open the finest level of an OME-Zarr that clra wrote.

    Parameters
    ----------
    path : path-like
        The folder.

    Returns
    -------
    voxels, voxel_size, centre, scaling
        As :func:`clra.io.volumes.nrrd_volume.nrrd_volume` returns them; the voxels are read as they
        are sliced.

    Raises
    ------
    InputError
        If it is no such folder.
    """
    try:
        root = zarr_library().open_group(store=os.fspath(path), mode="r")
        told = dict(root.attrs["clra"])
        scaling = (float(told.get("scale_factor", 1)), float(told.get("add_offset", 0)))
        return root["0"], float(told["voxel_size"]), tuple(told["centre"]), scaling
    except InputError:
        raise
    except Exception as error:  # zarr fails in many ways on what is none
        found = f"{type(error).__name__}: {error}"
        raise InputError(f"{os.fspath(path)}: cannot be read as OME-Zarr: {found}") from error
