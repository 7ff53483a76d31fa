"""NXtomo in: frames, angles, distances and translations become a scan."""

from __future__ import annotations

import os

import h5py
import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.frames.counts import CountedRadiographs
from clra.io.hdf5 import StoredArray, find, numbers, open_hdf5, require, text
from clra.io.nxtomo.clra_group import KIND_ATTRIBUTE, KINDS, read_mask, read_truth, read_vectors
from clra.io.nxtomo.entry import scan_detector, scan_entry
from clra.io.nxtomo.fields import Overrides, read_fields
from clra.model.scan import Scan

# Values of image_key; image_key_control has -1 for a control frame.
PROJECTION, FLAT, DARK, INVALID = 0, 1, 2, 3


def read_nxtomo(
    path: str | os.PathLike[str],
    *,
    entry: str | None = None,
    overrides: Overrides | None = None,
    white: float | None = None,
) -> Scan:
    """Read an NXtomo file; the radiographs stay in the file until they are asked for.

    Parameters
    ----------
    path : path-like
        The file.
    entry : str, optional
        Which of several scans in the file.
    overrides : Overrides, optional
        Of the geometry. Any of them puts the plain fields of NXtomo in place of the exact vectors
        that clra writes.
    white : float, optional
        Counts of the open beam, in place of flat frames.

    Raises
    ------
    InputError
        If the file is no such scan or does not hang together.
    """
    overrides = overrides or Overrides()
    file = open_hdf5(path)
    group = scan_entry(file, entry)
    detector = scan_detector(group)
    frames = require(detector, "data", "the frames of the detector")
    if frames.ndim != 3 or frames.dtype.kind not in "iuf" or not frames.size:
        found = f"shape {frames.shape} of {frames.dtype}"
        raise InputError.at(file.filename, frames.name, found, "numbers (frames, rows, columns)")
    views, flats, darks, dropped = _frame_roles(detector, len(frames))
    shape = (int(frames.shape[1]), int(frames.shape[2]))
    geometry = None if overrides.any else read_vectors(group, views, len(frames), shape)
    if geometry is None:
        fields = read_fields(group, detector, len(frames), views, shape, overrides)
        geometry = fields.geometry(shape)
    kind = text(frames.attrs.get(KIND_ATTRIBUTE, "counts"))
    if kind not in KINDS:
        where = f"{frames.name}@{KIND_ATTRIBUTE}"
        raise InputError.at(file.filename, where, repr(kind), f"one of {KINDS}")
    projections = CountedRadiographs(
        StoredArray(frames),
        path=os.fspath(path),
        views=views,
        flats=flats,
        darks=darks,
        white=white,
        normalised=kind != "counts",
        saturation=_saturation(detector),
    )
    if dropped:
        projections.notes = (*projections.notes, f"{dropped} frames marked invalid left out")
    return Scan(
        projections,
        geometry,
        "line-integrals" if kind == "line-integrals" else "transmission",
        name=os.path.basename(os.fspath(path)),
        truth=read_truth(group, views, len(frames)),
        mask=read_mask(group, projections.mask),
    )


def _frame_roles(
    detector: h5py.Group, count: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], int]:
    """Which frames are radiographs, flats and darks, and how many are to be left out."""
    keys = [find(detector, name) for name in ("image_key_control", "image_key")]
    key = next((k for k in keys if isinstance(k, h5py.Dataset)), None)
    if key is None:
        roles = np.zeros(count)
    else:
        roles = np.rint(numbers(key, "0, 1, 2 or 3 for each frame"))
        if len(roles) != count:
            raise InputError.at(
                key.file.filename, key.name, f"{len(roles)} keys", f"{count}, one a frame"
            )
    views, flats, darks = (np.flatnonzero(roles == r) for r in (PROJECTION, FLAT, DARK))
    if not len(views):
        raise InputError.at(
            detector.file.filename, f"{detector.name}/image_key", "no radiograph (image_key 0)",
            "at least one",
        )  # fmt: skip
    return views, flats, darks, count - len(views) - len(flats) - len(darks)


def _saturation(detector: h5py.Group) -> float | None:
    """Read the counts at which the detector saturates, if the file tells."""
    value = find(detector, "saturation_value")
    return float(numbers(value, "counts")[0]) if isinstance(value, h5py.Dataset) else None
