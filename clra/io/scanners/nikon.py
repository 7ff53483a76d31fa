"""Nikon XTek: ``NAME.xtekct`` with ``NAME_0001.tif`` beside it.

Sources: a real file of an XT H 225 (CT Pro 5.4) and its ``_ctdata.txt``; the readers of CIL
(Apache-2.0) and TIGRE (BSD-3), read for the meaning of the keys.

Signs, as CIL has them, whose users reconstruct real scans sharply with them: the sample turns
clockwise seen from above, row 0 is the top, columns count to the left as seen from the source
(all mirrored, the same data would be a counter-clockwise turn of columns to the right: only the
handedness of the volume tells). ObjectOffsetX is the axis' place along the columns, in mm at the
axis; older files have CentreOfRotationTop and -Bottom instead, in mm on the detector, at its upper
and lower edge. ObjectTilt and ObjectRoll [degree] are taken as CIL takes them. DetectorOffsetX is
taken along the columns, DetectorOffsetY up; both are 0 in every file seen.

Angles: ``_ctdata.txt`` (three lines of header; number, angle, time) or ``.ang`` hold what the stage
did and are preferred to AngularStep; InitialAngle is added to them. The scanner divides its frames
by the flat field itself and scales them to WhiteLevel.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.findings import Finding
from clra.io.frames.numbered_files import frames_or_missing, numbered_files, present_views
from clra.io.key_value_text import KeyValueText, read_table, read_text
from clra.io.scanners.scanner_options import ScannerOptions
from clra.io.scanners.scanner_scan import (
    ScannerScan,
    assembled,
    assumed,
    unverified,
)
from clra.io.scanners.stage import stage_geometry

# Angles that differ by more than this from those of AngularStep are told of [degree].
_JITTER = 0.01


def read_nikon(path: Path, options: ScannerOptions) -> ScannerScan:
    """Read a ``.xtekct`` file and what lies beside it.

    Parameters
    ----------
    path : Path
        The file.
    options : ScannerOptions
        What the user says.

    Raises
    ------
    InputError
        If a key is missing or makes no sense, or frames do not fit.
    """
    text = KeyValueText.read(path)
    if "xtekct" not in text.sections:
        raise InputError.at(path, "[XTekCT]", "no such section", "a Nikon .xtekct file")
    shape = (text.whole("DetectorPixelsY"), text.whole("DetectorPixelsX"))
    told_pixel = (
        text.number("DetectorPixelSizeX", positive=True),
        text.number("DetectorPixelSizeY", positive=True),
    )
    width, height = options.pixel(told_pixel)
    near, far = options.distances(
        text.number("SrcToObject", positive=True), text.number("SrcToDetector", positive=True)
    )
    told, findings = _angles(text)
    name = text.find("InputName", "Name") or path.stem
    folder = path.parent / (text.find("InputFolderName") or "")
    # The separator may or may not be part of the name.
    files = numbered_files(folder, rf"{re.escape(name)}[ _-]?(\d+)\.tiff?")
    index, lost = present_views([number for number, _ in files], 1, len(told))
    degrees = options.degrees(told[index], path)
    offset, roll = _axis(text, near / far, shape[0] * height)
    principal = (
        -text.number("DetectorOffsetX", default=0.0) / width,
        text.number("DetectorOffsetY", default=0.0) / height,
    )
    geometry = stage_geometry(
        degrees,
        source_to_axis=near,
        source_to_detector=far,
        pixel=(width, height),
        shape=shape,
        rotation="cw",
        columns="left",
        principal=principal,
        axis=principal[0] + offset / width * far / near,
        heights=options.heights(len(degrees)),
        tilt=-text.number("ObjectTilt", default=0.0),
        roll=roll,
        parallel=options.parallel,
    )
    expected = f"{name}_0001.tif and so on in {folder}"
    frames = frames_or_missing([f for _, f in files], (len(degrees), *shape), path, expected)
    findings += [
        *lost,
        unverified("clockwise from above, columns to the left", "--rotation ccw or --flip columns"),
        unverified(
            f"axis {offset:g} mm along the columns (ObjectOffsetX)",
            f"--centre-offset {offset / width * far / near:.4g}",
        ),
    ]
    if roll or text.number("ObjectTilt", default=0.0):
        findings.append(
            unverified("ObjectRoll and ObjectTilt", "clra align --autofocus", "measures the roll")
        )
    scan = ScannerScan(
        format="Nikon XTek",
        path=path,
        geometry=geometry,
        frames=frames,
        kind="transmission",
        white=options.white or text.number("WhiteLevel", positive=True),
        details=_details(text, offset, roll),
        findings=tuple(findings),
    )
    return assembled(scan, options, rotation="cw")


def _axis(text: KeyValueText, demagnified: float, detector_height: float) -> tuple[float, float]:
    """Place of the axis along the columns [mm at the axis], and its roll [degree]."""
    top = text.number("CentreOfRotationTop", default=0.0)
    bottom = text.number("CentreOfRotationBottom", default=0.0)
    offset = text.number("ObjectOffsetX", default=0.5 * (top + bottom) * demagnified)
    leaning = -float(np.degrees(np.arctan2(top - bottom, detector_height)))
    return offset, text.number("ObjectRoll", default=leaning)


def _angles(text: KeyValueText) -> tuple[NDArray[np.float64], list[Finding]]:
    """Angles of the views [degree], and what there is to say of them."""
    views = text.whole("Projections")
    start = text.number("InitialAngle", default=0.0)
    step = text.number("AngularStep")
    nominal = start + step * np.arange(views, dtype=np.float64)
    beside = text.path.parent
    listed = [*sorted(beside.glob("*_ctdata.txt")), *sorted(beside.glob("*.ang"))]
    if not listed:
        return nominal, [
            assumed(f"angles in steps of {step:g} degrees: no _ctdata.txt", "--angles")
        ]
    table = listed[0]
    rows = _ctdata(table) if table.suffix.lower() == ".txt" else _ang(table)
    if len(rows) < views:
        raise InputError.at(table, "angles", f"{len(rows)} rows", f"{views} as Projections has it")
    angles = start + np.array([angle for _, angle in sorted(rows)[:views]], np.float64)
    apart = float(np.abs((angles - angles[0]) - (nominal - start)).max())
    if apart < _JITTER:
        return angles, []
    message = (
        f"angles of {table.name} differ from steps of {step:g} degrees by up to {apart:.3g} "
        "degrees: those of the file are taken"
    )
    return angles, [Finding("angles", message, "", "info", {"degrees": apart})]


def _ctdata(path: Path) -> list[tuple[int, float]]:
    """Read number and angle of each projection; the three lines of header hold numbers too."""
    rows = [line.replace(",", ".").split() for line in read_text(path).splitlines()[3:]]
    try:
        return [(int(row[0]), float(row[1])) for row in rows if row]
    except (ValueError, IndexError):
        raise InputError.at(
            path, "rows after the third", "a row of another form", "number, angle [degree], time"
        ) from None


def _ang(path: Path) -> list[tuple[int, float]]:
    return [(int(row[0]), row[1]) for row in read_table(path, whole=False) if len(row) > 1]


def _details(text: KeyValueText, offset: float, roll: float) -> dict[str, str]:
    """Return what a person reads in the file."""
    found = {
        "tube": f"{text.find('XraykV') or '?'} kV, {text.find('XrayuA') or '?'} uA",
        "white level": text.find("WhiteLevel"),
        "axis": f"{offset:g} mm beside the middle, roll {roll:.4g} degrees",
        "steps": f"{text.find('Projections')} of {text.find('AngularStep')} degrees from "
        f"{text.find('InitialAngle') or 0}",
        "vendor's voxel": f"{text.find('VoxelSizeX')} mm",
        "software": text.find("Version"),
    }
    return {key: value for key, value in found.items() if value}
