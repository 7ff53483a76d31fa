"""Checks before long work: that the result can be written, and that its inputs fit each other."""

import errno
import math
import os
import shutil
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clra.app.records import Record
from clra.errors import InputError, OutputError
from clra.io.atomic import ensure_writable
from clra.io.motion_file import read_motion_file
from clra.io.scan_files import scan_checksum
from clra.methods.alignment.autofocus import Focus
from clra.methods.alignment.rejected_views import all_but
from clra.model.motion import Motion
from clra.model.scan import Scan


def room_for(
    path: str | os.PathLike[str], size: int, keep: Iterable[str | os.PathLike[str] | None] = ()
) -> None:
    """Check that a file of that many bytes can be written.

    Parameters
    ----------
    path : path-like
        Where to.
    size : int
        Bytes.
    keep : iterable of path-like or None
        Files that it must not replace.

    Raises
    ------
    InputError
        If it would replace one of `keep`.
    OutputError
        If the folder is no place to write or its disk is too full.
    """
    ensure_writable(path, keep)
    free = shutil.disk_usage(Path(path).absolute().parent).free
    if free < size:
        found = f"{free / 1e9:.3g} GB free of {size / 1e9:.3g} GB wanted"
        raise OutputError.writing(path, errno.ENOSPC, found)


def motion_for(
    scan: Scan, path: str | os.PathLike[str], geometry: str
) -> tuple[Scan, Motion, NDArray[np.bool_]]:
    """Read the motion of a scan, and take the detector as the alignment took it.

    Parameters
    ----------
    scan : Scan
        That it has to fit.
    path : path-like
        MOTION.h5.
    geometry : str
        By which options the scan's geometry was told.

    Returns
    -------
    scan : Scan
        With the detector moved and turned as an auto-focus found it, if there was one.
    motion : Motion
        Relative to that.
    valid_views : ndarray of bool, (views,)
        Views that the alignment did not flag.

    Raises
    ------
    InputError
        If it is of another number of views, or all of them were flagged. That it was estimated from
        other radiographs is only worth a warning: two channels of a scan share a motion.
    """
    file = read_motion_file(path)
    _check(scan, file.motion, file.attributes, path, geometry)
    valid_views = all_but(file.flagged, scan.views)
    if not valid_views.any():
        found = f"all {scan.views} views"
        raise InputError.at(path, "/motion/flagged", found, "at least one that is not flagged")
    return focused(scan, file.attributes, path), file.motion, valid_views


def matched(scan: Scan, record: Record, path: str | os.PathLike[str], geometry: str) -> Scan:
    """Check that an alignment and a scan belong together, and return the scan as aligned.

    As :func:`motion_for` does.
    """
    _check(scan, record.motion, record.about, path, geometry)
    return focused(scan, record.about, path)


def focus_attributes(focus: Focus) -> dict[str, str]:
    """Write down what an auto-focus found, for :func:`focused`."""
    return {
        "detector_offset_u": f"{focus.offset_u:.6g} pixel",
        "detector_tilt": f"{math.degrees(focus.tilt):.6g} degree",
        "detector_sharpening": f"{focus.sharpening:.4g}",
    }


def focused(scan: Scan, attributes: Mapping[str, str], path: str | os.PathLike[str]) -> Scan:
    """Take the detector of a scan as the attributes of a motion file say."""
    if "detector_offset_u" not in attributes:
        return scan
    names = ("detector_offset_u", "detector_tilt", "detector_sharpening")
    try:
        offset, tilt, sharpening = (float(attributes[name].split()[0]) for name in names)
    except (KeyError, ValueError, IndexError):
        found = ", ".join(repr(attributes.get(name)) for name in names)
        raise InputError.at(path, "/@detector", found, "a number in each of them") from None
    return Focus(offset, math.radians(tilt), sharpening).applied(scan)


def _check(
    scan: Scan,
    motion: Motion,
    attributes: Mapping[str, str],
    path: str | os.PathLike[str],
    geometry: str,
) -> None:
    if motion.views != scan.views:
        raise InputError.at(
            path, "/motion", f"{motion.views} views", f"{scan.views} as in {scan.name}"
        )
    if attributes.get("checksum") and attributes["checksum"] != scan_checksum(scan):
        warnings.warn(
            f"{os.fspath(path)} was estimated from other radiographs than those of {scan.name}",
            stacklevel=3,
        )
    told = attributes.get("geometry") or geometry
    if told != geometry:
        warnings.warn(
            f"{os.fspath(path)} was estimated with {told}, and now {scan.name} is read with "
            f"{geometry}: the motion fits one of them only",
            stacklevel=3,
        )
