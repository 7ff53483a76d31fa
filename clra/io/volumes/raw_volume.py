"""Volumes as bare voxels, and beside them a JSON file that tells what they are."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.atomic import atomic_path
from clra.io.volumes.slab_files import SlabWriter
from clra.io.volumes.volume_description import PlaneSink, VolumeDescription


def sidecar(path: str | os.PathLike[str]) -> Path:
    """Return the file that tells what a raw file is."""
    return Path(path).with_suffix(".json")


@contextmanager
def raw_writer(path: Path, final: Path, description: VolumeDescription) -> Iterator[PlaneSink]:
    """Write voxels alone, in this machine's byte order.

    Parameters
    ----------
    path : Path
        The file.
    final : Path
        What it will be called: the JSON file has that name with the suffix .json.
    description : VolumeDescription
        Goes into the JSON file.

    Yields
    ------
    PlaneSink
    """
    told = {
        "file": final.name,
        "shape": description.grid.shape,
        "dtype": description.dtype,
        "byte_order": sys.byteorder,
        **description.attributes(),
        "provenance": dict(description.provenance),
    }
    with SlabWriter(path, 0, description.grid.shape, description.stored) as writer:
        yield writer
    with atomic_path(sidecar(final)) as beside:
        beside.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")


def raw_volume(
    path: str | os.PathLike[str],
) -> tuple[NDArray[Any], float, tuple[float, ...], tuple[float, float]]:
    """Open a raw volume by what its JSON file tells.

    Parameters
    ----------
    path : path-like
        The voxels.

    Returns
    -------
    voxels, voxel_size, centre, scaling
        As :func:`clra.io.volumes.nrrd_volume.nrrd_volume` returns them.

    Raises
    ------
    InputError
        If the JSON file is missing or does not fit.
    """
    beside = sidecar(path)
    try:
        told = json.loads(beside.read_text(encoding="utf-8"))
        order = {"little": "<", "big": ">"}[told["byte_order"]]
        dtype = np.dtype(told["dtype"]).newbyteorder(order)
        nz, ny, nx = told["shape"]
        voxels = np.memmap(path, dtype, "r", 0, (int(nz), int(ny), int(nx)))
        scaling = (float(told.get("scale_factor", 1)), float(told.get("add_offset", 0)))
        return voxels, float(told["voxel_size"]), tuple(told["centre"]), scaling
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{os.fspath(path)}: cannot be read by {beside.name}: {error}") from error
