"""What clra adds to an NXtomo entry: the group `clra` and an attribute of the data set.

NXtomo's fields cannot express a general geometry, the motion that a simulation put in, or that the
frames hold line integrals. The arrays have a row for every frame, flats and darks too (NaN), so
that a frame may be marked invalid later.
"""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.hdf5 import find, text
from clra.io.nxtomo.geometry_fields import CONVENTIONS
from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion

Views = NDArray[np.intp]

# What a data set says it holds in its attribute `clra_kind`; counts where it has none.
KINDS = ("counts", "transmission", "line-integrals")
KIND_ATTRIBUTE = "clra_kind"

_MOTION_UNITS = {"shift_u": "pixel", "shift_v": "pixel", "magnification": "1"}


def write_additions(
    entry: h5py.Group,
    *,
    geometry: ConeBeamGeometry,
    exact: bool,
    truth: Motion | None,
    mask: NDArray[np.bool_] | None,
    views: Views,
    count: int,
) -> None:
    """Write the group `clra`.

    Parameters
    ----------
    entry : h5py.Group
        The scan.
    geometry : ConeBeamGeometry
        Of the radiographs, in the order and orientation of the frames.
    exact : bool
        Whether NXtomo's own fields say the same.
    truth : Motion or None
        The motion that a simulation put in.
    mask : ndarray of bool or None
        Pixels to use.
    views : ndarray of int
        Frames that are radiographs.
    count : int
        Frames of every role.
    """
    group = entry.create_group("clra")
    group.attrs["NX_class"] = "NXcollection"
    group["conventions"] = CONVENTIONS
    vectors = _spread(geometry.to_astra(), views, count)
    _put(group, "cone_vectors", vectors, "mm").attrs["columns"] = "source, detector, u, v: x, y, z"
    # A reader that knows only NXtomo must be able to find out that its fields are not all.
    group["cone_vectors"].attrs["fields_are_exact"] = exact
    if truth is not None:
        motion = group.create_group("motion_truth")
        motion.attrs.update(NX_class="NXcollection", cause=truth.cause)
        for name, unit in _MOTION_UNITS.items():
            _put(motion, name, _spread(getattr(truth, name), views, count), unit)
    if mask is not None:
        group["mask"] = np.asarray(mask, np.uint8)


def read_vectors(
    entry: h5py.Group, views: Views, count: int, shape: tuple[int, int]
) -> ConeBeamGeometry | None:
    """Read the exact geometry of the radiographs, or None where the file has none.

    Raises
    ------
    InputError
        If the vectors do not fit the frames or describe no cone beam.
    """
    dataset = find(entry, "clra/cone_vectors")
    if not isinstance(dataset, h5py.Dataset):
        return None
    vectors = _rows(dataset, views, (count, 12))
    try:
        return ConeBeamGeometry.from_astra(vectors, shape)
    except ValueError as error:
        raise InputError(f"{dataset.file.filename}: {dataset.name}: {error}") from error


def read_truth(entry: h5py.Group, views: Views, count: int) -> Motion | None:
    """Read the motion that a simulation put in, or None where the file tells none.

    Raises
    ------
    InputError
        If it does not fit the frames.
    """
    columns, cause = {}, "detector"
    for name in _MOTION_UNITS:
        dataset = find(entry, f"clra/motion_truth/{name}")
        if not isinstance(dataset, h5py.Dataset):
            return None
        columns[name] = _rows(dataset, views, (count,))
        told = text(dataset.parent.attrs.get("cause", cause))
        cause = told.replace("panel", "detector")  # as version 0.1.0 wrote
    try:
        return Motion(**columns, cause=cause)
    except ValueError as error:
        where = f"{entry.file.filename}: {entry.name}/clra/motion_truth"
        raise InputError(f"{where}: {error}") from error


def read_mask(entry: h5py.Group, other: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    """Read the pixels to use and join them with `other`; None where all may be used."""
    dataset = find(entry, "clra/mask")
    if not isinstance(dataset, h5py.Dataset):
        return other
    mask = np.asarray(dataset[()], dtype=np.bool_)
    return mask if other is None or other.shape != mask.shape else mask & other


def _put(group: h5py.Group, name: str, values: NDArray[Any], unit: str) -> h5py.Dataset:
    dataset = group.create_dataset(name, data=values)
    dataset.attrs["units"] = unit
    return dataset


def _spread(values: NDArray[np.float64], views: Views, count: int) -> NDArray[np.float64]:
    """Values of the radiographs at their frames, NaN at the others."""
    spread = np.full((count, *values.shape[1:]), np.nan)
    spread[views] = values
    return spread


def _rows(dataset: h5py.Dataset, views: Views, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Values at the radiographs' frames."""
    where = (dataset.file.filename, dataset.name)
    if dataset.shape != shape:
        raise InputError.at(*where, f"shape {dataset.shape}", f"{shape}, a row for each frame")
    values = np.asarray(dataset[()], np.float64)[views]
    bad = ~np.isfinite(values.reshape(len(views), -1)).all(axis=1)
    if bad.any():
        frame = int(views[np.argmax(bad)])
        raise InputError.at(*where, f"no numbers at frame {frame}", "finite numbers")
    return values
