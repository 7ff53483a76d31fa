"""Data Exchange: HDF5 with ``/exchange/data``, as synchrotron beamlines write it.

Sources: the Data Exchange definition (De Carlo et al., J. Synchrotron Rad. 21, 2014) and a real
file of tomopy's (BSD-3). ``data``, ``data_white`` and ``data_dark`` are counts (frames, rows,
columns), ``theta`` is in degrees unless its units say otherwise.

The format knows no cone: distances come from options, or the beam is told to be parallel. Row 0 is
taken as the top, columns as counted to the right seen from the source, ``theta`` as
counter-clockwise of the sample seen from above. Frames of white and dark are taken as taken before
the radiographs. Where the axis is seen is not in the file either.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from clra.errors import InputError
from clra.findings import Finding
from clra.io.hdf5 import StoredArray, find, lengths, open_hdf5, require, text
from clra.io.hdf5 import angles as read_angles
from clra.io.scanners.scanner_options import ScannerOptions
from clra.io.scanners.scanner_scan import (
    ScannerScan,
    assembled,
    assumed,
    unverified,
)
from clra.io.scanners.stage import stage_geometry

_PIXEL = (
    "measurement/instrument/detector/pixel_size",
    "measurement/instrument/detector/x_pixel_size",
)
_DETAILS = (
    "exchange/title", "measurement/sample/name", "measurement/instrument/name",
    "measurement/instrument/monochromator/energy", "measurement/instrument/detector/exposure_time",
)  # fmt: skip


def is_dxchange(path: Path) -> bool:
    """Tell whether a file is HDF5 with ``/exchange/data``; never raises for other files."""
    try:
        if not path.is_file() or not h5py.is_hdf5(path):
            return False
        with h5py.File(path, "r") as file:
            return "exchange/data" in file
    except (OSError, RuntimeError, KeyError):
        return False


def read_dxchange(path: Path, options: ScannerOptions) -> ScannerScan:
    """Read a Data Exchange file; the frames stay in it until they are asked for.

    Parameters
    ----------
    path : Path
        The file.
    options : ScannerOptions
        What the user says: distances or ``parallel``, ``pixel_size``, ``centre_offset``.

    Raises
    ------
    InputError
        If data sets are missing or do not fit, or there are no distances.
    """
    file = open_hdf5(path)
    frames = require(file, "exchange/data", "the radiographs")
    if frames.ndim != 3 or frames.dtype.kind not in "iuf" or not frames.size:
        found = f"shape {frames.shape} of {frames.dtype}"
        raise InputError.at(path, frames.name, found, "numbers (frames, rows, columns)")
    views, shape = int(frames.shape[0]), (int(frames.shape[1]), int(frames.shape[2]))
    theta = find(file, "exchange/theta")
    told = None
    if isinstance(theta, h5py.Dataset):
        told = np.rad2deg(read_angles(theta, "the angle of each frame"))
        if len(told) != views and options.angles is None:
            raise InputError.at(path, theta.name, f"{len(told)} angles", f"{views}, one a frame")
    findings = [
        unverified("theta turns counter-clockwise seen from above", "--rotation cw"),
        unverified("row 0 the top, columns to the right seen from the source", "--flip"),
    ]
    if options.centre_offset is None:
        findings.append(assumed("the axis in the middle of the columns", "--centre-offset PIXEL"))
    parallel = options.parallel or options.source_distance == float("inf")
    near, behind = options.source_distance or 0.0, options.detector_distance or 0.0
    if not parallel and not (near and behind):
        raise InputError.at(
            path, "distances", "none in a Data Exchange file",
            "--parallel, or in clra import --source-distance, --detector-distance and --pixel-size",
        )  # fmt: skip
    pixel = options.pixel(_pixel(file, path, options, parallel, findings))
    degrees = options.degrees(told, path)
    geometry = stage_geometry(
        degrees,
        source_to_axis=near,
        source_to_detector=near + behind,
        pixel=pixel,
        shape=shape,
        heights=options.heights(len(degrees)),
        parallel=parallel,
    )
    scan = ScannerScan(
        format="Data Exchange",
        path=path,
        geometry=geometry,
        frames=StoredArray(frames),
        kind="counts",
        flats=_others(file, "exchange/data_white", shape),
        darks=_others(file, "exchange/data_dark", shape),
        details=_details(file),
        findings=tuple(findings),
    )
    return assembled(scan, options, rotation="ccw")


def _pixel(
    file: h5py.File, path: Path, options: ScannerOptions, parallel: bool, findings: list[Finding]
) -> tuple[float, float]:
    """Size of a pixel [mm]; a parallel beam without one is in pixels of a micrometre."""
    if options.pixel_size is not None:
        return 1.0, 1.0  # replaced by the caller
    for name in _PIXEL:
        dataset = find(file, name)
        if isinstance(dataset, h5py.Dataset):
            size = float(lengths(dataset, "the size of a pixel")[0])
            return size, size
    if not parallel:
        raise InputError.at(path, "pixel size", "none", "--pixel-size MM of clra import")
    findings.append(assumed("pixels of 1 um: lengths are in pixels", "--pixel-size MM"))
    return 1e-3, 1e-3


def _others(file: h5py.File, name: str, shape: tuple[int, int]) -> StoredArray | None:
    """Frames without the sample, or None where there are none."""
    dataset = find(file, name)
    if not isinstance(dataset, h5py.Dataset) or not dataset.size:
        return None
    if dataset.ndim != 3 or dataset.shape[1:] != shape:
        expected = f"(n, {shape[0]}, {shape[1]})"
        raise InputError.at(file.filename, dataset.name, f"shape {dataset.shape}", expected)
    return StoredArray(dataset)


def _details(file: h5py.File) -> dict[str, str]:
    found = {}
    for name in _DETAILS:
        dataset = find(file, name)
        if isinstance(dataset, h5py.Dataset) and dataset.size == 1:
            value = np.ravel(dataset[()])[0]
            told = text(dataset) if h5py.check_string_dtype(dataset.dtype) else f"{value:g}"
            found[name.rpartition("/")[2]] = told
    return {key: value for key, value in found.items() if value}
