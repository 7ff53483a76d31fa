"""What a reconstruction tells of the scan it is made from."""

from contextlib import suppress

import numpy as np

from clra.errors import InputError
from clra.findings import Finding
from clra.methods.assessment.axis_of_arc import axis_offset
from clra.methods.assessment.radiograph_checks import radiograph_findings
from clra.methods.assessment.slice_sharpness import VIEWS, sharpening_by_opposite_rotation
from clra.methods.diagnostics import doubted_rotation
from clra.methods.truncation import truncated
from clra.model.detector_pose import steep_rows
from clra.model.motion import Motion
from clra.model.sampling.angular_coverage import covered, is_circle, part_of_a_turn
from clra.model.sampling.field_of_view import is_offset
from clra.model.scan import Scan
from clra.ops.streaming.radiographs import Radiographs, Reading
from clra.ops.streaming.stream import Stream

# Most columns that the axis is looked for in.
_COLUMNS = 200
# Offset of the axis from which on slices show it [pixel], and how much better rays along the same
# line have to agree then: noise and jitter of some pixels end at 1.1.
_OFFSET, _AGREE = 1.5, 1.5
# How much sharper slices have to be the other way round: 1.4 where nothing moved. Noise and small
# samples reach 1.13; so do scans that moved by some pixels, of which an alignment tells more.
_SHARPER = 1.2
# What a reconstruction tells in another way, or does by itself.
_KNOWN = ("truncation", "limited-arc", "half-fan")


def warn_of_method(stream: Stream, scan: Scan, method: str) -> None:
    """Warn of what a method makes less of than a scan's users may think.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        To be reconstructed.
    method : str
        Of reconstruction.
    """
    notes = {}
    if method == "fbp":
        notes["short-scan"] = part_of_a_turn(scan.geometry)
        notes["cone-angle"] = steep_rows(scan.geometry)
    if method != "katsevich":  # that refuses such samples
        notes["truncation"] = truncated(Radiographs(stream, scan, 1), scan.geometry)
    for code, note in notes.items():
        if note:
            Finding(code, note).warn()


def warn_of_scan(stream: Stream, scan: Scan, motion: Motion | None, reading: Reading) -> None:
    """Warn of what an alignment would have told of a scan: defects, rotation sense, axis.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        Some of its radiographs are read.
    motion : Motion, optional
        Of its views, as far as known.
    reading : callable
        Reads those that are looked at binned.
    """
    told = [f for f in radiograph_findings(scan) if f.code not in _KNOWN]
    with suppress(InputError):  # of few rows or a detector that lies flat there is nothing to tell
        told += _geometry_findings(stream, scan, motion or Motion.identity(scan.views), reading)
    for finding in told:
        finding.warn()


def _geometry_findings(
    stream: Stream, scan: Scan, motion: Motion, reading: Reading
) -> list[Finding]:
    """Look for the axis elsewhere, or the sample turning the other way."""
    found = _axis_elsewhere(stream, scan, motion, reading)
    if found is None:  # slices with the axis elsewhere may well be sharper the other way round
        sharper = sharpening_by_opposite_rotation(stream, scan, motion, reading)
        found = doubted_rotation(sharper, _SHARPER) if sharper == sharper else None
    return [] if found is None else [found]


def _axis_elsewhere(stream: Stream, scan: Scan, motion: Motion, reading: Reading) -> Finding | None:
    """Look for another column of the axis, where rays are measured twice."""
    ideal = scan.geometry
    if not is_circle(ideal) or covered(ideal) < np.pi or is_offset(ideal) or steep_rows(ideal):
        return None
    chosen = slice(0, None, max(1, scan.views // VIEWS))
    part = scan.subset(chosen)
    geometry = part.geometry.with_motion(motion.subset(chosen))
    pixel = next((n for n in (1, 2, 4) if scan.geometry.columns // n <= _COLUMNS), 8)
    binned = Scan(reading(part, pixel), geometry.binned(pixel))
    try:
        offset, gain = axis_offset(stream, binned)
    except InputError:
        return None  # hardly a ray is measured twice
    offset *= pixel
    if abs(offset) < _OFFSET or gain < _AGREE:
        return None
    return Finding(
        "axis-offset",
        f"rays that are measured twice agree better by a factor of {gain:.1f} if the axis is seen "
        f"{offset:+.1f} columns from where the geometry has it",
        "give it (--centre-offset), or align the scan",
        measured={"offset": offset, "gain": gain},
    )
