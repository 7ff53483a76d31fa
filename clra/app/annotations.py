"""What the command line adds to an alignment that it keeps, and asks of one that it reads."""

import math
import os
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from clra.app.scan_description import path_of
from clra.errors import InputError
from clra.findings import Finding
from clra.io.alignment_file import read_alignment
from clra.methods.alignment.autofocus import Focus
from clra.methods.alignment.result import AlignmentResult
from clra.model.motion import Motion
from clra.model.scan import Scan


def annotated(
    result: AlignmentResult,
    scan: Scan,
    earlier: AlignmentResult | None = None,
    /,
    *,
    command: str = "",
    **about: str,
) -> AlignmentResult:
    """Add where an alignment comes from, for those who read its file.

    Parameters
    ----------
    result : AlignmentResult
        Of the scan.
    scan : Scan
        With its geometry.
    earlier : AlignmentResult, optional
        Of the run that it started from: its history comes first, and the detector is still where
        an auto-focus found it then.
    command : str
        The command line.
    **about : str
        What else is to be remembered.
    """
    before = () if earlier is None else earlier.history
    known = {} if earlier is None else earlier.about
    detector = {name: told for name, told in known.items() if name.startswith("detector_")}
    return replace(
        result,
        history=(*before, *result.history),
        command=command,
        about={
            **result.about,
            "path": path_of(scan.geometry).kind,
            **_source_travel(result.motion, scan),
            **detector,
            **about,
        },
    )


def _source_travel(motion: Motion, scan: Scan) -> dict[str, str]:
    """Say how far the source went, if it did."""
    if motion.cause != "source":
        return {}
    geometry, moved = scan.geometry, scan.geometry.source_displacement(motion)
    ranges = [
        1e3 * float(np.ptp(np.sum(moved * axis, axis=1) / np.linalg.norm(axis, axis=1)))
        for axis in (geometry.u, geometry.v, geometry.normal)
    ]
    across, along, toward = (f"{length:.3g}" for length in ranges)
    return {"source_travel": f"{across}, {along}, {toward} um along columns, rows and beam"}


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
        Finding(
            "scan",
            f"{os.fspath(path)} was estimated from other radiographs than those of {scan.name}",
            "go on only if they moved alike, such as two channels of one scan",
        ).warn()
    told = alignment.about.get("geometry") or geometry
    if told != geometry:
        Finding(
            "geometry",
            f"{os.fspath(path)} was estimated with {told}, and now {scan.name} is read with "
            f"{geometry}: the motion fits one of them only",
            "give the options that clra align was given",
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
