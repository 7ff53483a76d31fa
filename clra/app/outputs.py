"""Checks before long work: that the result can be written, and that its inputs fit each other."""

import errno
import os
import shutil
import warnings
from pathlib import Path

from clra.app.records import Record
from clra.io.atomic import ensure_writable
from clra.io.errors import InputError, OutputError
from clra.io.motions import read_motion_file
from clra.io.scans import scan_checksum
from clra.model.motion import Motion
from clra.model.scan import Scan


def room_for(path: str | os.PathLike[str], size: int) -> None:
    """Check that a file of that many bytes can be written.

    Parameters
    ----------
    path : path-like
        Where to.
    size : int
        Bytes.

    Raises
    ------
    OutputError
        If the folder is no place to write or its disk is too full.
    """
    ensure_writable(path)
    free = shutil.disk_usage(Path(path).absolute().parent).free
    if free < size:
        found = f"{free / 1e9:.3g} GB free of {size / 1e9:.3g} GB wanted"
        raise OutputError.writing(path, errno.ENOSPC, found)


def motion_for(scan: Scan, path: str | os.PathLike[str]) -> Motion:
    """Read the motion of a scan.

    Parameters
    ----------
    scan : Scan
        That it has to fit.
    path : path-like
        MOTION.h5.

    Raises
    ------
    InputError
        If it is of another number of views. That it was estimated from other radiographs is only
        worth a warning: two channels of a scan share a motion.
    """
    file = read_motion_file(path)
    _check(scan, file.motion, file.attributes.get("checksum", ""), path)
    return file.motion


def check_match(scan: Scan, record: Record, path: str | os.PathLike[str]) -> None:
    """Check that an alignment and a scan belong together, as :func:`motion_for` does."""
    _check(scan, record.motion, record.about.get("checksum", ""), path)


def _check(scan: Scan, motion: Motion, checksum: str, path: str | os.PathLike[str]) -> None:
    if motion.views != scan.views:
        raise InputError.at(
            path, "/motion", f"{motion.views} views", f"{scan.views} as in {scan.name}"
        )
    if checksum and checksum != scan_checksum(scan):
        warnings.warn(
            f"{os.fspath(path)} was estimated from other radiographs than those of {scan.name}",
            stacklevel=3,
        )
