"""HeliScan (ANU / Thermo Fisher): a folder ``proju16_raw`` with ``expt*.in`` and headerless frames.

Sources: what is public of it, which is little: names of files and keys in scripts of its users. As
far as known: ``expt*.in`` has a key and its value a line, in sections from ``BeginSection`` to
``EndSection``; ``rawfiles_KF0000/expt_KF000000.raw`` and so on are radiographs, ``expt_CF*`` frames
of the open beam, ``expt_DF*`` without beam, uint16, little-endian, row by row. camera_length is the
distance from the source to the detector, specimen_distance to the axis, pixel_size_x of the
detector, all taken as mm. How rows and columns are told is not known: ``--shape`` does, or frames
are square.

Angles and heights of the views are not public: they come from tables (``--angles``,
``--z-translation``). Row 0 is taken as the top, columns as counted to the right seen from the
source, angles as counter-clockwise of the sample seen from above, heights as raising it.
"""

from __future__ import annotations

import math
from pathlib import Path

from clra.errors import InputError
from clra.findings import Finding
from clra.io.frames.stacks import RawLayout
from clra.io.key_value_text import KeyValueText
from clra.io.scanners.scanner_options import ScannerOptions
from clra.io.scanners.scanner_scan import (
    ScannerScan,
    assembled,
    assumed,
    frames_or_missing,
    numbered_files,
    stack_or_none,
    unverified,
)
from clra.io.scanners.stage import stage_geometry

_DETAILS = (
    "camera_length", "specimen_distance", "pixel_size_x", "pixel_size_y", "voxel_size",
    "rotation_x", "iterative_trajectory",
)  # fmt: skip
# Voxels that differ from pixel and distances by more than this part are told of.
_UNLIKE = 0.02


def read_heliscan(path: Path, options: ScannerOptions) -> ScannerScan:
    """Read an ``expt*.in`` file and the frames beside it.

    Parameters
    ----------
    path : Path
        The file.
    options : ScannerOptions
        What the user says: ``angles`` always, ``z_translation`` for a helix, ``shape``.

    Raises
    ------
    InputError
        If a key is missing or makes no sense, angles are not given, or frames do not fit.
    """
    text = KeyValueText.read(path, " ")
    near, far = options.distances(
        text.number("specimen_distance", positive=True), text.number("camera_length", positive=True)
    )
    across = text.number("pixel_size_x", positive=True)
    width, height = options.pixel((across, text.number("pixel_size_y", default=across)))
    files = {role: _frames(path.parent, role) for role in ("KF", "CF", "DF")}
    degrees = options.degrees(None, path)
    shape = options.shape or _square(files["KF"], path)
    layout = RawLayout(shape=shape)
    heights = options.heights(len(degrees))
    findings = [
        unverified("angles turn counter-clockwise seen from above", "--rotation cw"),
        unverified("row 0 the top, columns to the right seen from the source", "--flip"),
        assumed("lengths in mm", "--source-distance, --detector-distance, --pixel-size"),
        *_voxel(text, width * near / far),
    ]
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
        frames=frames_or_missing(
            files["KF"], (len(degrees), *shape), path, "rawfiles_KF0000/expt_KF000000.raw", layout
        ),
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


def _square(files: list[Path], path: Path) -> tuple[int, int]:
    """Rows and columns of frames that are square."""
    pixels = files[0].stat().st_size // 2 if files else 0
    edge = math.isqrt(pixels)
    if not pixels or edge * edge != pixels:
        found = f"{pixels} pixels a frame" if files else "no frames"
        raise InputError.at(path, "rows and columns", found, "--shape ROWSxCOLUMNS")
    return edge, edge


def _voxel(text: KeyValueText, voxel: float) -> list[Finding]:
    """Compare the file's voxel with the one that distances and pixel give."""
    told = text.number("voxel_size", default=voxel)
    if abs(told / voxel - 1) < _UNLIKE:
        return []
    message = f"voxel_size is {told:g}, pixel and distances in mm give {voxel:.4g}"
    return [Finding("units", message, "check the distances and the pixel")]
