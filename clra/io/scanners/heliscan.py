"""HeliScan (ANU / Thermo Fisher): a folder ``proju16_raw`` with ``expt*.in`` and headerless frames.

Sources: what is public of it, which is little: names of files and keys in scripts of its users. As
far as known: ``expt*.in`` has a key and its value a line, in sections from ``BeginSection`` to
``EndSection``; ``rawfiles_KF0000/expt_KF000000.raw`` and so on are radiographs, ``expt_CF*`` frames
of the open beam, ``expt_DF*`` without beam, uint16, little-endian, row by row. camera_length is the
distance from the source to the detector, specimen_distance to the axis, pixel_size_x of the
detector, all taken as mm. How rows and columns are told is not known: they are ``--shape``, or two
whole numbers of the file whose keys speak of rows (row, y, height) and columns and whose product is
a frame's size, or frames are square.

Angles and heights of the views are not public: they come from tables (``--angles``,
``--z-translation``). Row 0 is taken as the top, columns as counted to the right seen from the
source, angles as counter-clockwise of the sample seen from above, heights as raising it.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from clra.errors import InputError
from clra.findings import Finding
from clra.io.frames.frame_views import MissingFrames
from clra.io.frames.numbered_files import frames_or_missing, numbered_files, stack_or_none
from clra.io.frames.stacks import RawLayout
from clra.io.key_value_text import KeyValueText
from clra.io.scanners.scanner_options import ScannerOptions
from clra.io.scanners.scanner_scan import (
    ScannerScan,
    assembled,
    assumed,
    unverified,
)
from clra.io.scanners.stage import stage_geometry

_DETAILS = (
    "camera_length", "specimen_distance", "pixel_size_x", "pixel_size_y", "voxel_size",
    "rotation_x", "iterative_trajectory",
)  # fmt: skip
# Voxels that differ from pixel and distances by more than this part are told of.
_UNLIKE = 0.02
_OF_ROWS = re.compile(r"row|height|vert|(^|_)[yv](_|$)")


def read_heliscan(path: Path, options: ScannerOptions) -> ScannerScan:
    """Read an ``expt*.in`` file and the frames beside it.

    Parameters
    ----------
    path : Path
        The file.
    options : ScannerOptions
        What the user says: ``angles`` always, ``z_translation`` for a helix, ``shape``. Without
        angles the scan can be described, but pixels are refused.

    Raises
    ------
    InputError
        If a key is missing or makes no sense, or frames do not fit.
    """
    text = KeyValueText.read(path, " ")
    near, far = options.distances(
        text.number("specimen_distance", positive=True), text.number("camera_length", positive=True)
    )
    across = text.number("pixel_size_x", positive=True)
    width, height = options.pixel((across, text.number("pixel_size_y", default=across)))
    files = {role: _frames(path.parent, role) for role in ("KF", "CF", "DF")}
    shape = options.shape or _shape(text, files["KF"])
    layout = RawLayout(shape=shape)
    known = options.angles is not None
    views = max(len(files["KF"]), 1)
    degrees = options.degrees(None if known else 360.0 / views * np.arange(views), path)
    if known:
        expected = "rawfiles_KF0000/expt_KF000000.raw"
        frames = frames_or_missing(files["KF"], (len(degrees), *shape), path, expected, layout)
    else:
        # Described they may be, but not reconstructed.
        reason = "found none in this format, expected --angles FILE"
        frames = MissingFrames((views, *shape), f"{path}: angles: {reason}")
    heights = options.heights(len(degrees))
    findings = [
        unverified("angles turn counter-clockwise seen from above", "--rotation cw"),
        unverified("row 0 the top, columns to the right seen from the source", "--flip"),
        assumed("lengths in mm", "--source-distance, --detector-distance, --pixel-size"),
        *_voxel(text, width * near / far),
    ]
    if not known:
        findings.append(
            Finding("angles", "angles are not in this format: a turn is drawn", "--angles FILE")
        )
    if heights is None:
        findings.append(
            Finding(
                "assumed", "assumed: a circle, as heights are not in this format",
                "--z-translation FILE for a helix",
            )
        )  # fmt: skip
    geometry = stage_geometry(
        degrees,
        source_to_axis=near,
        source_to_detector=far,
        pixel=(width, height),
        shape=shape,
        heights=heights,
        parallel=options.parallel,
    )
    scan = ScannerScan(
        format="HeliScan",
        path=path,
        geometry=geometry,
        frames=frames,
        kind="counts",
        flats=stack_or_none(files["CF"], layout),
        darks=stack_or_none(files["DF"], layout),
        details={key: value for key in _DETAILS if (value := text.find(key))},
        findings=tuple(findings),
    )
    return assembled(scan, options, rotation="ccw")


def _frames(folder: Path, role: str) -> list[Path]:
    """Frames of a role: in the folder itself, and in ``rawfiles_ROLE0000`` and so on."""
    places = [folder, *(place for _, place in numbered_files(folder, rf"rawfiles_{role}(\d+)"))]
    return [f for place in places for _, f in numbered_files(place, rf"expt_{role}(\d+)\.raw")]


def _shape(text: KeyValueText, files: list[Path]) -> tuple[int, int]:
    """Rows and columns, by numbers of the file that make up a frame, or of square frames."""
    pixels = files[0].stat().st_size // 2 if files else 0
    numbers: dict[bool, set[int]] = {False: set(), True: set()}
    for key, value in text.sections[""].items():
        if value.isdigit() and 0 < int(value) <= pixels:
            numbers[bool(_OF_ROWS.search(key))].add(int(value))
    pairs = {(r, c) for r in numbers[True] for c in numbers[False] if r * c == pixels}
    edge = math.isqrt(pixels)
    if pixels and edge * edge == pixels:
        pairs = pairs or {(edge, edge)}
    if len(pairs) != 1:
        found = f"{pixels} pixels a frame" if files else "no frames"
        raise InputError.at(text.path, "rows and columns", found, "--shape ROWSxCOLUMNS")
    return pairs.pop()


def _voxel(text: KeyValueText, voxel: float) -> list[Finding]:
    """Compare the file's voxel with the one that distances and pixel give."""
    told = text.number("voxel_size", default=voxel)
    if abs(told / voxel - 1) < _UNLIKE:
        return []
    message = f"voxel_size is {told:g}, pixel and distances in mm give {voxel:.4g}"
    return [Finding("units", message, "check the distances and the pixel")]
