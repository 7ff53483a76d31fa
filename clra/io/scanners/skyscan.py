"""SkyScan / Bruker: ``PREFIX.log`` with ``PREFIX0000.tif`` beside it.

Sources: a real log of a SkyScan 1173 after NRecon, public logs of a 1275 and a 3001, and TIGRE's
reader (BSD-3), read for the meaning of the keys.

Distances are those of the keys. The pixel of the detector follows from "Image Pixel Size", which is
at the object, times the magnification: "Camera Pixel Size" is nominal (50 um where the log's own
cone-beam angle says 49.42). "Optical Axis (line)" is the row at which the perpendicular from the
source meets the detector, taken as counted from the top. "Rotation Direction" CC is taken as
counter-clockwise of the sample seen from above, CW as clockwise. Frames of "Flat Field
Correction=ON" are divided already: open beam is "Reference Intensity", else the largest number of
their type. Not applied, as no source tells their signs: "Image Rotation", "Postalignment",
"CameraXYRatio"; they are listed.

``PREFIX_TS.csv`` holds thermal shifts that the vendor measured against a reference scan. No public
source describes it: columns are taken by their headings (x or horizontal, y or vertical), or as
number, x, y; in pixels, positive toward higher columns and rows, of the image that moved.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

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
from clra.model.motion import Motion

_DETAILS = (
    "Scanner", "Source Voltage (kV)", "Source Current (uA)", "Filter", "Exposure (ms)",
    "Camera binning", "Camera Pixel Size (um)", "CameraXYRatio", "Image Pixel Size (um)",
    "Optical Axis (line)", "Rotation Step (deg)", "Rotation Direction", "Scanning Trajectory",
    "Type Of Motion", "Frame Averaging", "Random Movement", "Flat Field Correction",
    "Image Rotation", "Postalignment", "Vertical Object Position (mm)",
    "Reconstruction Angular Range (deg)", "Study Date and Time",
)  # fmt: skip


def read_skyscan(path: Path, options: ScannerOptions) -> ScannerScan:
    """Read a ``.log`` file and what lies beside it.

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
    shape = (text.whole("Number of Rows"), text.whole("Number of Columns"))
    near, far = options.distances(
        text.number("Object to Source (mm)", "Object to Source", positive=True),
        text.number("Camera to Source (mm)", "Camera to Source", positive=True),
    )
    at_object = text.number("Image Pixel Size (um)", "Scaled Image Pixel Size (um)", positive=True)
    edge = 1e-3 * at_object * far / near
    width, height = options.pixel((edge, edge))
    views = text.whole("Number of Files")
    step = text.number("Rotation Step (deg)", positive=True)
    start = text.number("Scanning Start Angle", default=0.0)
    prefix = text.find("Filename Prefix") or path.stem
    files = numbered_files(path.parent, rf"{re.escape(prefix)}(\d+)\.tiff?")
    index, lost = present_views([number for number, _ in files], 0, views)
    degrees = options.degrees(start + step * index, path)
    direction = (text.find("Rotation Direction") or "CC").upper()
    rotation = "cw" if direction.startswith("CW") else "ccw"
    line = text.number("Optical Axis (line)", default=(shape[0] - 1) / 2)
    row = line - (shape[0] - 1) / 2
    geometry = stage_geometry(
        degrees,
        source_to_axis=near,
        source_to_detector=far,
        pixel=(width, height),
        shape=shape,
        rotation=rotation,
        principal=(0.0, row),
        heights=options.heights(len(degrees)),
        parallel=options.parallel,
    )
    expected = f"{prefix}0000.tif and so on beside it"
    corrected = (text.find("Flat Field Correction") or "").upper().startswith("ON")
    bits = text.whole("Depth (bits)", default=16)
    white = options.white or text.number("Reference Intensity", default=float(2**bits - 1))
    shifts = path.with_name(f"{path.stem}_TS.csv")
    motion = thermal_shifts(shifts) if shifts.is_file() else None
    if motion is not None:
        if motion.views != views:
            raise InputError.at(shifts, "rows", motion.views, f"{views}, one a view")
        motion = motion.subset(index)
    scan = ScannerScan(
        format="SkyScan",
        path=path,
        geometry=geometry,
        frames=frames_or_missing([f for _, f in files], (len(degrees), *shape), path, expected),
        kind="transmission" if corrected or options.white else "counts",
        white=white if corrected or options.white else None,
        start_motion=motion,
        details={key.lower(): value for key in _DETAILS if (value := text.find(key))},
        findings=(
            *lost,
            *_findings(text, line, direction, rotation, row, white if corrected else None),
        ),
    )
    return assembled(scan, options, rotation=rotation)


def _findings(
    text: KeyValueText, line: float, direction: str, rotation: str, row: float, white: float | None
) -> tuple[Finding, ...]:
    """Return what was assumed, and which signs no real radiographs confirmed."""
    other = {"cw": "ccw", "ccw": "cw"}[rotation]
    found = [
        unverified(f"Rotation Direction {direction} taken as {rotation}", f"--rotation {other}"),
        unverified(
            f"Optical Axis (line) {line:g} counted from the top",
            f"--flip rows, or --centre-offset 0,{-row:g}",
        ),
    ]
    if white is not None:
        found.append(assumed(f"the open beam at {white:g} of the corrected frames", "--white"))
    ratio = text.number("CameraXYRatio", "Camera X/Y Ratio", default=1.0)
    if abs(ratio - 1) > 1e-3:
        found.append(
            assumed(f"square pixels: CameraXYRatio {ratio:g} is not applied", "--pixel-size")
        )
    for key, usual, advice in (
        ("Camera Offset", "OFF", "both halves are taken as one radiograph"),
        ("Scanning Trajectory", "ROUND", "a helix needs --z-translation FILE"),
    ):
        told = (text.find(key) or usual).upper()
        if told != usual:
            found.append(Finding("unread", f"{key} {told} is not read", advice))
    moved = text.number("Postalignment", default=0.0)
    if moved:
        found.append(
            assumed(
                f"the axis in the middle: Postalignment {moved:g} pixel is not applied",
                f"--centre-offset {moved:g} or {-moved:g}",
            )
        )
    return tuple(found)


def thermal_shifts(path: Path) -> Motion:
    """Read the thermal shifts of a ``_TS.csv`` file, a row a view.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    InputError
        If it holds no table of two or three columns.
    """
    rows = read_table(path)
    widths = {len(row) for row in rows}
    if len(widths) != 1 or not widths & {2, 3, 4, 5}:
        found = f"{len(rows)} rows of {sorted(widths)} numbers"
        raise InputError.at(path, "table", found, "rows of number, x, y [pixel]")
    table = np.array(rows)
    u, v = _columns(path, table.shape[1])
    return Motion(shift_u=table[:, u], shift_v=table[:, v])


def _columns(path: Path, width: int) -> tuple[int, int]:
    """Which columns hold the shifts along columns and rows of the image."""
    header = next((s for s in read_text(path).splitlines() if re.search("[a-zA-Z]", s)), "")
    names = [name.strip().lower() for name in re.split(r"[,;\t]", header)]
    across = [k for k, n in enumerate(names) if re.search(r"\bx|horiz|\bdx", n)]
    along = [k for k, n in enumerate(names) if re.search(r"\by|vert|\bdy", n)]
    if len(names) == width and len(across) == 1 and len(along) == 1:
        return across[0], along[0]
    return (0, 1) if width == 2 else (1, 2)
