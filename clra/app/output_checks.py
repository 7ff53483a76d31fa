"""Checks before long work: that the result can be written, and that its inputs fit each other."""

import errno
import math
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

from clra.errors import InputError, OutputError
from clra.findings import Finding
from clra.io.alignment_file import read_alignment
from clra.io.atomic import ensure_writable
from clra.methods.alignment.autofocus import Focus
from clra.methods.alignment.result import AlignmentResult
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


def alignment_for(
    scan: Scan, path: str | os.PathLike[str], geometry: str
) -> tuple[Scan, AlignmentResult]:
    """Read the alignment of a scan, and take the detector as the alignment took it.

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
    alignment : AlignmentResult
        Relative to that.

    Raises
    ------
    InputError
        If it is of another number of views, or all of them were rejected. That it was estimated
        from other radiographs is only worth a warning: two channels of a scan share a motion.
    """
    alignment = read_alignment(path)
    scan = matched(scan, alignment, path, geometry)
    if not alignment.valid_views.any():
        found = f"all {scan.views} views"
        raise InputError.at(path, "/motion/flagged", found, "at least one that is not flagged")
    return scan, alignment


def matched(
    scan: Scan, alignment: AlignmentResult, path: str | os.PathLike[str], geometry: str
) -> Scan:
    """Check that an alignment and a scan belong together, and return the scan as aligned.

    As :func:`alignment_for` does.
    """
    if alignment.motion.views != scan.views:
        found = f"{alignment.motion.views} views"
        raise InputError.at(path, "/motion", found, f"{scan.views} as in {scan.name}")
    if alignment.checksum and alignment.checksum != scan.checksum():
        message = f"{os.fspath(path)} was estimated from other radiographs than those of"
        Finding("scan", f"{message} {scan.name}").warn()
    told = alignment.about.get("geometry") or geometry
    if told != geometry:
        Finding(
            "geometry",
            f"{os.fspath(path)} was estimated with {told}, and now {scan.name} is read with "
            f"{geometry}: the motion fits one of them only",
        ).warn()
    return focused(scan, alignment.about, path)


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
