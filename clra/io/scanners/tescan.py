"""FleX-ray (CWI) and TESCAN UniTOM: ``scan settings.txt``; and vectors of ASTRA in ``.geom`` files.

Sources: a real ``scan settings.txt`` of a UniTOM XL (Acquila 2727); flexdata (CWI) and the scripts
that belong to the walnuts (Der Sarkissian et al., Scientific Data 6, 2019), read for the meaning
of the keys and the order of the frames.

``scan settings.txt``: SOD and SDD in mm, Voxel size in um, Binned pixel size in mm. COR, HC and VC
are taken as the column of the axis and the column and row at which the perpendicular from the
source meets the radiograph, in pixels from its edge: the real file has 479.96, 480.00 and 474.01 of
960 x 948 pixels. Older files have none of them but positions of motors (tra_det, ver_tube and so
on) that need a calibration of the machine: the middle is taken then. Frames: ``scan_000000.tif``
and so on, ``di*`` dark, ``io*`` of the open beam, those before the scan first. Frame i is at the
start angle plus i (last - start) / projections, counter-clockwise of the sample seen from above;
row 0 is the top, columns count to the right seen from the source.

``.geom``: a row of 12 numbers a view, those of ASTRA's ``cone_vec`` in mm. As the walnuts have it,
the detector stands upright (columns of the vectors are rows of the TIFF, from the last to the
first), and the first row of numbers belongs to the last frame.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.findings import Finding
from clra.io.frames.frame_views import ConvertedFrames, MissingFrames
from clra.io.frames.numbered_files import (
    frames_or_missing,
    numbered_files,
    present_views,
    stack_or_none,
)
from clra.io.key_value_text import KeyValueText, read_table
from clra.io.scanners.scanner_options import ScannerOptions
from clra.io.scanners.scanner_scan import (
    Frames,
    ScannerScan,
    assembled,
    unverified,
)
from clra.io.scanners.stage import stage_geometry
from clra.model.geometry import ConeBeamGeometry

SETTINGS = "scan settings.txt"
_DETAILS = (
    "Scanner name", "Scanner type", "Sample name", "Tube voltage", "Tube power", "Filter",
    "Exposure time (ms)", "Number of averages", "Voxel size", "Magnification",
    "Original pixel size", "Binning value", "Binned pixel size", "ROI (LTRB)", "COR", "HC", "VC",
    "# projections", "Start angle", "Last angle", "# pre flat fields", "# post flat fields",
    "# offset images", "ver_tube", "ver_det", "tra_det", "tra_obj", "ver_obj",
)  # fmt: skip
_SCAN, _FLAT, _DARK = (rf"{role}[_ ]?(\d+)\.tiff?" for role in ("scan", "io", "di"))


def read_tescan(path: Path, options: ScannerOptions) -> ScannerScan:
    """Read ``scan settings.txt`` and what lies beside it.

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
    text = KeyValueText.read(path, ":")
    near, far = options.distances(
        text.number("SOD", positive=True), text.number("SDD", positive=True)
    )
    numbered = numbered_files(path.parent, _SCAN)
    files = [file for _, file in numbered]
    steps = text.whole("# projections")
    start, last = text.number("Start angle", default=0.0), text.number("Last angle", default=360.0)
    # There may be one more, at the end of the turn.
    views = max(steps, len(files))
    index, lost = present_views([number for number, _ in numbered], 0, views)
    degrees = options.degrees(start + (last - start) / steps * index, path)
    edge = text.number("Binned pixel size", default=_pixel(text, far / near))
    width, height = options.pixel((edge, edge))
    frames = frames_or_missing(
        files, (len(degrees), *_shape(text)), path, "scan_000000.tif and so on beside it"
    )
    shape = (int(frames.shape[1]), int(frames.shape[2]))
    findings = [
        *lost,
        unverified("angles turn counter-clockwise seen from above", "--rotation cw"),
        unverified("row 0 the top, columns to the right seen from the source", "--flip"),
    ]
    told = [text.find(name) is not None for name in ("HC", "VC", "COR")]
    column = text.number("HC", default=shape[1] / 2) - shape[1] / 2
    row = text.number("VC", default=shape[0] / 2) - shape[0] / 2
    axis = text.number("COR", default=shape[1] / 2 + column) - shape[1] / 2
    if all(told):
        findings.append(
            unverified(
                f"axis {axis:.4g} pixel beside the middle (COR), perpendicular {column:.4g}, "
                f"{row:.4g} (HC, VC)",
                "--centre-offset COLUMN,ROW",
            )
        )
    else:
        findings.append(
            Finding(
                "assumed", "assumed: the axis in the middle: COR, HC or VC are not in the file",
                "--centre-offset",
            )
        )  # fmt: skip
    geometry = stage_geometry(
        degrees,
        source_to_axis=near,
        source_to_detector=far,
        pixel=(width, height),
        shape=shape,
        principal=(column, row),
        axis=axis,
        heights=options.heights(len(degrees)),
        parallel=options.parallel,
    )
    flats, after = _flats(path.parent, text.number("# post flat fields", default=0.0))
    scan = ScannerScan(
        format="FleX-ray / TESCAN",
        path=path,
        geometry=geometry,
        frames=frames,
        kind="counts",
        flats=flats,
        flats_after=after,
        darks=stack_or_none(file for _, file in numbered_files(path.parent, _DARK)),
        details={
            key: value.partition(";")[0].strip() for key in _DETAILS if (value := text.find(key))
        },
        findings=tuple(findings),
    )
    return assembled(scan, options, rotation="ccw")


def read_geom(path: Path, options: ScannerOptions) -> ScannerScan:
    """Read the vectors of a ``.geom`` file and the frames beside it.

    Parameters
    ----------
    path : Path
        The file.
    options : ScannerOptions
        What the user says; distances and pixels are those of the vectors.

    Raises
    ------
    InputError
        If it does not hold 12 numbers a row, or frames do not fit.
    """
    rows = read_table(path)
    if not rows or {len(row) for row in rows} != {12}:
        widths = sorted({len(row) for row in rows}) or "no"
        raise InputError.at(path, "rows", f"{widths} numbers", "12 numbers, as ASTRA's cone_vec")
    vectors = np.array(rows)[::-1]
    files = [file for _, file in numbered_files(path.parent, _SCAN)]
    shape = options.shape or (1, 1)
    stored = frames_or_missing(
        files, (len(rows), shape[1], shape[0]), path, "scan_000000.tif and so on beside it"
    )
    if isinstance(stored, MissingFrames) and options.shape is None:
        raise InputError(f"{stored.reason}, or --shape ROWSxCOLUMNS")
    frames = _upright(stored)
    parts = {
        name: _upright(stack_or_none(file for _, file in numbered_files(path.parent, pattern)))
        for name, pattern in (("flats", _FLAT), ("darks", _DARK))
    }
    scan = ScannerScan(
        format="ASTRA vectors (.geom)",
        path=path,
        geometry=ConeBeamGeometry.from_astra(vectors, frames.shape[1:]),
        frames=frames,
        kind="counts",
        details={"vectors": f"{len(rows)}, the first of the last frame"},
        findings=(
            unverified("columns and rows as the CWI walnuts have them", "--flip"),
            unverified("the first vectors belong to the last frame", "--rotation cw"),
        ),
        **parts,
    )
    return assembled(scan, options, rotation="ccw")


def _upright(frames: Frames) -> Frames:
    """Frames whose columns are the rows of the TIFF, from the last to the first."""
    if frames is None:
        return None
    count, rows, columns = frames.shape
    if isinstance(frames, MissingFrames):
        return MissingFrames((count, columns, rows), frames.reason)

    def turned(part: NDArray[Any], _: int) -> NDArray[Any]:
        return part[:, ::-1].transpose(0, 2, 1)

    return ConvertedFrames(frames, turned, shape=(count, columns, rows))


def _flats(folder: Path, after: float) -> tuple[Frames, Frames]:
    """Frames of the open beam: before the scan, and the last so many after it."""
    files = [file for _, file in numbered_files(folder, _FLAT)]
    split = len(files) - int(after) if 0 < after < len(files) else len(files)
    return stack_or_none(files[:split]), stack_or_none(files[split:])


def _pixel(text: KeyValueText, magnification: float) -> float | None:
    """Edge of a pixel [mm], where the file does not tell it but by the voxel, in um."""
    if text.find("Binned pixel size"):
        return None
    return 1e-3 * text.number("Voxel size", positive=True) * magnification


def _shape(text: KeyValueText) -> tuple[int, int]:
    """Rows and columns, by the region of interest in pixels that are not binned."""
    region = re.findall(r"-?\d+", text.text("ROI (LTRB)", "ROI"))
    if len(region) != 4:
        raise InputError.at(text.path, "ROI (LTRB)", ",".join(region), "four whole numbers")
    left, top, right, bottom = map(int, region)
    binned = text.number("Binning value", default=1.0, positive=True)
    whole = (int((bottom - top + 1) / binned), int((right - left + 1) / binned))
    if min(whole) < 1:
        raise InputError.at(text.path, "ROI (LTRB)", ",".join(region), "an area with pixels")
    return whole
