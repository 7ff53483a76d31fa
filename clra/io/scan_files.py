"""Scan files: whatever the format, one function reads it and one writes it."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.nxtomo.fields import Overrides
from clra.io.nxtomo.reader import read_nxtomo
from clra.io.nxtomo.writer import write_nxtomo
from clra.model.scan import Scan
from clra.progress import ProgressCallback

_FRAMES = (".tif", ".tiff", ".raw", ".bin")
_VENDORS = (".txrm", ".xrm", ".vgi", ".xtekct", ".log")


def read_scan(
    path: str | os.PathLike[str],
    *,
    entry: str | None = None,
    rotation: str = "ccw",
    source_distance: float | None = None,
    parallel: bool = False,
    white: float | None = None,
) -> Scan:
    """Read a scan; the radiographs stay in the file until they are asked for.

    NXtomo files (HDF5) are read. Counts become transmission by the file's flat and dark frames;
    row 0 is the top of a radiograph; ``x_translation`` moves the sample along increasing columns,
    ``y_translation`` along the beam, ``z_translation`` up.

    Parameters
    ----------
    path : path-like
        The file.
    entry : str, optional
        Which of several scans in the file.
    rotation : {"ccw", "cw"}
        How the sample turns as ``rotation_angle`` grows, seen from above (+z).
    source_distance : float, optional
        From the source to the rotation axis [mm], in place of the file's.
    parallel : bool
        The beam is parallel: a source so far away that rays end within 1/8000 of the detector's
        width of where parallel ones would, and the detector at the axis.
    white : float, optional
        Counts of the open beam, in place of flat frames; 1 for radiographs that hold transmission.

    Returns
    -------
    Scan
        Its ``projections.notes`` say what was noticed.

    Raises
    ------
    InputError
        A ValueError whose one line names the file, the field, what was found and what was expected.
    """
    place = Path(path)
    if place.is_dir():
        raise InputError(f"{place}: found a folder, expected an NXtomo file; clra import makes one")
    suffix = place.suffix.lower()
    if place.exists() and suffix in _FRAMES:
        raise InputError(f"{place}: found frames, expected an NXtomo file; clra import makes one")
    if place.exists() and suffix in _VENDORS:
        raise InputError(
            f"{place}: found a vendor's format, expected an NXtomo file; export the radiographs as "
            "TIFF and make one with clra import"
        )
    overrides = Overrides(rotation, source_distance, parallel)
    return read_nxtomo(path, entry=entry, overrides=overrides, white=white)


def write_scan(
    path: str | os.PathLike[str],
    scan: Scan,
    *,
    valid_views: NDArray[np.bool_] | None = None,
    progress: ProgressCallback | None = None,
) -> None:
    """Write a scan's line integrals as NXtomo; the file appears whole or not at all.

    Parameters
    ----------
    path : path-like
        The file.
    scan : Scan
        Read some views at a time.
    valid_views : ndarray of bool, (views,), optional
        Views to be used, at least one, all by default. The others are written as well, marked
        invalid: readers of NXtomo, :func:`read_scan` too, leave them out.
    progress : callable, optional
        Called with a ``Progress`` as frames are written.

    Raises
    ------
    InputError
        If `valid_views` is not of these views, or none.
    OutputError
        If the file cannot be written.
    """
    write_nxtomo(
        path,
        _LineIntegrals(scan),
        scan.geometry,
        kind="line-integrals",
        dtype=np.float32,
        name=scan.name,
        truth=scan.truth,
        mask=scan.mask,
        valid_views=valid_views,
        progress=progress,
    )


class _LineIntegrals:
    """The line integrals of a scan, sliced like an array."""

    def __init__(self, scan: Scan) -> None:
        self._scan = scan
        self.shape = scan.shape

    def __getitem__(self, views: slice) -> NDArray[np.float32]:
        start, stop, _ = views.indices(self.shape[0])
        return self._scan.read(start, stop)
