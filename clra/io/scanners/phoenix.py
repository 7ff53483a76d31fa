"""GE / Waygate phoenix datos|x: ``NAME.pca`` with ``NAME0001.tif``, ``NAME.pcp``, ``NAME.pcr``.

Sources: the three files of a real scan on a v|tome|x m (datos|x 2 acq 2.4), and public ``.pca``
files of two others. No reader of them is public.

FDD and FOD are the distances from the focus to detector and axis. ``cx`` and ``cy`` are the pixel,
counted from 0, at which the central ray meets the radiograph as saved: where it is cropped (DimX
2014 of 2024) cx is its middle, 1006.5. CalibValue, the correction of the axis that datos|x
calculates, is taken as pixels toward higher columns. ``.pcp`` has the angle RotPos of each view,
and MeanGV, the mean of its free-ray window: DevGV is its deviation from [CT] Level in percent.
Radiographs are divided by MeanGV, or by FreeRay without a ``.pcp``. Sense of rotation: RotPos is
taken as counter-clockwise of the sample seen from above; row 0 as the top, columns as counted to
the right seen from the source.

``.pcr`` [SCO_Values]: scan optimiser, a sparse table of index (of the radiograph, from 1), scale,
x and y: drift against a reference before the scan. It is clra's own model: magnification = scale,
shift_u = x, shift_v = y [pixel], linear between the points and from none at the first radiograph.
Whether x and y are the image's motion or its correction is not known.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from clra.errors import InputError
from clra.findings import Finding
from clra.io.frames.numbered_files import frames_or_missing, numbered_files, present_views
from clra.io.key_value_text import KeyValueText, read_table
from clra.io.scanners.scanner_options import ScannerOptions
from clra.io.scanners.scanner_scan import (
    ScannerScan,
    assembled,
    assumed,
    unverified,
)
from clra.io.scanners.stage import Floats, stage_geometry
from clra.model.motion import Motion

_DETAILS = (
    ("General", "SystemName"), ("Xray", "Voltage"), ("Xray", "Current"), ("Detector", "Name"),
    ("Detector", "TimingVal"), ("Geometry", "Magnification"), ("Geometry", "VoxelSizeX"),
    ("Geometry", "cx"), ("Geometry", "cy"), ("Geometry", "CalibValue"),
    ("Geometry", "DetectorRot"), ("CT", "NumberImages"), ("CT", "RotationSector"),
    ("Image", "FreeRay"), ("AutoScO", "Active"), ("DetectorShift", "Enable"),
)  # fmt: skip


def read_phoenix(path: Path, options: ScannerOptions) -> ScannerScan:
    """Read a ``.pca`` file and what lies beside it.

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
    near, far = options.distances(
        text.number("FOD", section="Geometry", positive=True),
        text.number("FDD", section="Geometry", positive=True),
    )
    width, height = options.pixel(
        (
            text.number("PixelsizeX", section="Detector", positive=True),
            text.number("PixelsizeY", section="Detector", positive=True),
        )
    )
    rows = text.whole("NrPixelsY", section="Detector")
    columns = text.whole("NrPixelsX", section="Detector")
    shape = (
        text.whole("DimY", section="Image", default=rows),
        text.whole("DimX", section="Image", default=columns),
    )
    files = numbered_files(path.parent, rf"{re.escape(path.stem)}[ _]?(\d+)\.tiff?")
    planned = text.whole("NumberImages", section="CT")
    # There may be one more, at the end of the turn.
    views = max(planned, len(files))
    numbers = [number for number, _ in files]
    index, findings = present_views(numbers, min([1, *numbers]), views)
    sector = text.number("RotationSector", section="CT", default=360.0)
    table = _positions(path.with_suffix(".pcp"))
    if table is None:
        told = sector / planned * index
        white: float | Floats = text.number("FreeRay", section="Image", positive=True)
        findings.append(assumed(f"even steps over {sector:g} degrees: no .pcp", "--angles"))
    else:
        if len(table) < views:
            raise InputError.at(
                path.with_suffix(".pcp"), "rows", len(table), f"{views}, one a radiograph"
            )
        told, white = table[index, 0], table[index, 1]
    degrees = options.degrees(told, path)
    middle = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    principal = (
        text.number("cx", section="Geometry", default=middle[0]) - middle[0],
        text.number("cy", section="Geometry", default=middle[1]) - middle[1],
    )
    shifted = text.number("CalibValue", section="Geometry", default=0.0)
    geometry = stage_geometry(
        degrees,
        source_to_axis=near,
        source_to_detector=far,
        pixel=(width, height),
        shape=shape,
        principal=principal,
        axis=principal[0] + shifted,
        heights=options.heights(len(degrees)),
        parallel=options.parallel,
    )
    optimised = path.with_suffix(".pcr")
    motion = optimiser_motion(optimised, views).subset(index) if optimised.is_file() else None
    scan = ScannerScan(
        format="phoenix datos|x",
        path=path,
        geometry=geometry,
        frames=frames_or_missing(
            [f for _, f in files], (len(degrees), *shape), path, f"{path.stem}0001.tif and so on"
        ),
        kind="transmission",
        white=options.white or white,
        start_motion=motion,
        details={
            f"{section} {key}": value
            for section, key in _DETAILS
            if (value := text.find(key, section=section))
        },
        findings=(*findings, *_findings(text, principal[0], shifted, motion)),
    )
    return assembled(scan, options, rotation="ccw")


def _findings(
    text: KeyValueText, column: float, shifted: float, motion: Motion | None
) -> list[Finding]:
    found = [unverified("RotPos turns counter-clockwise seen from above", "--rotation cw")]
    if shifted:
        found.append(
            unverified(
                f"axis {shifted:g} pixel toward higher columns (CalibValue)",
                f"--centre-offset {column - shifted:g}",
            )
        )
    if motion is not None:
        found.append(
            Finding(
                "unverified-sign",
                "sign not verified on a real scan: SCO_Values x and y as motions of the image",
                "an alignment started from it that ends farther off than one without tells",
                "info",
            )
        )
    leaning = text.number("DetectorRot", section="Geometry", default=0.0)
    if leaning:
        found.append(assumed(f"no turn of the detector: DetectorRot {leaning:g} is not applied"))
    return found


def _positions(path: Path) -> Floats | None:
    """Angle and free-ray mean of each view, or None where there is no such file."""
    if not path.is_file():
        return None
    rows = [row for row in read_table(path, whole=False) if len(row) > 4]
    if not rows:
        raise InputError.at(path, "rows", "none of numbers", "ImgNr, RotPos, U, I, MeanGV ...")
    return np.array([(row[1], row[4]) for row in rows])


def optimiser_motion(path: Path, views: int | None = None) -> Motion:
    """Read the motion that the scan optimiser left in a ``.pcr`` file.

    Parameters
    ----------
    path : Path
        The file.
    views : int, optional
        Radiographs; by default up to LastImage.

    Raises
    ------
    InputError
        If it has none, or keys are missing.
    """
    text = KeyValueText.read(path)
    section = "SCO_Values"
    count = text.whole("SCO_NumPoints", section=section)
    points = np.array(
        [
            [
                text.number(f"SCO_{k}_{name}", section=section)
                for name in ("Index", "X", "Y", "Scale")
            ]
            for k in range(count)
        ]
    )
    views = views or text.whole("LastImage", section="Reconstruction Settings")
    if np.any(np.diff(points[:, 0]) <= 0):
        raise InputError.at(path, "SCO_k_Index", points[:, 0].tolist(), "numbers in order")
    if points[0, 0] > 1:
        points = np.vstack([[1.0, 0.0, 0.0, 1.0], points])
    images = np.arange(1, views + 1)
    u, v, scale = (np.interp(images, points[:, 0], column) for column in points.T[1:])
    return Motion(shift_u=u, shift_v=v, magnification=scale)
