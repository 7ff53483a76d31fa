"""What a path is: which scanner's files, or none that is read."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from clra.errors import InputError
from clra.io.key_value_text import KeyValueText
from clra.io.scanners.ctsimu import is_ctsimu, read_ctsimu
from clra.io.scanners.dxchange import is_dxchange, read_dxchange
from clra.io.scanners.heliscan import read_heliscan
from clra.io.scanners.nikon import read_nikon
from clra.io.scanners.phoenix import optimiser_motion, read_phoenix
from clra.io.scanners.scanner_options import ScannerOptions
from clra.io.scanners.scanner_scan import ScannerScan
from clra.io.scanners.skyscan import read_skyscan, thermal_shifts
from clra.io.scanners.tescan import SETTINGS, read_geom, read_tescan
from clra.io.scanners.zeiss import read_zeiss
from clra.model.motion import Motion


@dataclass(frozen=True)
class Format:
    """A format of scanners.

    Attributes
    ----------
    name : str
        For people.
    pattern : str
        Regular expression of its metadata files' whole names, in lower case.
    read : callable
        From the path and options to a scan.
    check : callable, optional
        Whether a file of such a name is one; never raises.
    """

    name: str
    pattern: str
    read: Callable[[Path, ScannerOptions], ScannerScan]
    check: Callable[[Path], bool] = os.path.isfile


def _is_skyscan(path: Path) -> bool:
    try:
        return "acquisition" in KeyValueText.read(path).sections
    except InputError:
        return False


# In the order in which they are looked for in a folder.
FORMATS = (
    Format("Nikon XTek (.xtekct)", r".*\.xtekct", read_nikon),
    Format("Zeiss (.txrm)", r".*\.txrm", read_zeiss),
    Format("SkyScan / Bruker (.log)", r".*\.log", read_skyscan, _is_skyscan),
    Format("GE phoenix (.pca)", r".*\.pca", read_phoenix),
    Format("ASTRA vectors (.geom)", r".*\.geom", read_geom),
    Format(f"FleX-ray / TESCAN ({SETTINGS})", re.escape(SETTINGS), read_tescan),
    Format("HeliScan (expt*.in)", r"expt.*\.in", read_heliscan),
    Format("CTSimU (.json)", r".*\.json", read_ctsimu, is_ctsimu),
    Format("Data Exchange (.h5)", r".*\.(h5|hdf5?|dxf)", read_dxchange, is_dxchange),
)
# Names of files that belong to a format's metadata, and what these are called.
_COMPANIONS: tuple[tuple[re.Pattern[str], Callable[[Path], Path]], ...] = (
    (re.compile(r".*\.(pcr|pcp)", re.I), lambda path: path.with_suffix(".pca")),
    (
        re.compile(r".*_ts\.csv", re.I),
        lambda path: path.with_name(f"{path.name[: -len('_TS.csv')]}.log"),
    ),
)
_HDF5 = (".nxs", ".nx", ".h5", ".hdf5", ".hdf", ".nexus")
_FRAMES = (".tif", ".tiff", ".raw", ".bin")
NXTOMO = "NXtomo (.nxs, .h5)"


def formats_read() -> str:
    """List the formats that are read, for messages."""
    return ", ".join([NXTOMO, *(each.name for each in FORMATS)])


def recognise(path: str | os.PathLike[str]) -> tuple[Format, Path] | None:
    """Tell which scanner's files a path is, and which of them is read.

    Parameters
    ----------
    path : path-like
        A metadata file, a file that holds everything, or a folder with one of them.

    Returns
    -------
    (Format, Path) or None
        None where it may be an NXtomo file, or is no file.

    Raises
    ------
    InputError
        If it is a folder with none or several, frames without metadata, or a file of a format that
        is not read; the formats that are read are listed.
    """
    place = Path(path)
    if place.is_dir():
        return _in_folder(place)
    if not place.is_file():
        return None
    for pattern, companion in _COMPANIONS:
        if pattern.fullmatch(place.name) and companion(place).is_file():
            place = companion(place)
    for each in FORMATS:
        if _matches(each, place):
            return each, place
    suffix = place.suffix.lower()
    if suffix in _FRAMES:
        raise InputError(
            f"{place}: found frames, expected the metadata of a scanner or an NXtomo file; "
            "clra import makes one of frames and a table of angles"
        )
    if suffix in _HDF5 or _is_hdf5(place):
        return None
    raise InputError.at(place, "format", f"suffix {suffix!r}", f"one of {formats_read()}")


def read_scanner(
    path: str | os.PathLike[str], options: ScannerOptions | None = None
) -> ScannerScan | None:
    """Read the files of a scanner; pixels are read only when asked for.

    Parameters
    ----------
    path : path-like
        A metadata file, a file that holds everything, or a folder with one of them.
    options : ScannerOptions, optional
        What the user says against, or in place of, the metadata.

    Returns
    -------
    ScannerScan or None
        None where it may be an NXtomo file, or is no file.

    Raises
    ------
    InputError
        If the path is of no format that is read, or the files do not hang together.
    """
    found = recognise(path)
    if found is None:
        return None
    each, place = found
    try:
        return each.read(place, options or ScannerOptions())
    except InputError as error:
        # What a geometry refuses does not know whence it came.
        if str(place.parent) in str(error) or str(error).startswith("--"):
            raise
        raise InputError(f"{place}: {error}") from error


def read_start_motion(
    path: str | os.PathLike[str], views: int | None = None, options: ScannerOptions | None = None
) -> Motion:
    """Read the motion that a vendor's software measured, or a simulation put in.

    It is of radiographs whose row 0 is the top and whose columns count to the right as seen from
    the source, as `read_scan` and ``clra import`` have them, however the vendor stores them.

    Parameters
    ----------
    path : path-like
        Zeiss ``.txrm`` (Alignment), GE ``.pcr`` ([SCO_Values]) or ``.pca``, SkyScan ``_TS.csv`` or
        ``.log``, CTSimU ``.json``, or a folder with one of them.
    views : int, optional
        How many views there must be.
    options : ScannerOptions, optional
        As the scan was read with: a flip turns shifts too.

    Raises
    ------
    InputError
        If there is none, or it is of another number of views.
    """
    place = Path(path)
    motion = None
    if place.suffix.lower() == ".pcr" and not place.with_suffix(".pca").is_file():
        motion = optimiser_motion(place, views)
    elif place.name.lower().endswith("_ts.csv") and recognise_or_none(place) is None:
        motion = thermal_shifts(place)
    else:
        scan = read_scanner(place, options)
        motion = None if scan is None else scan.start_motion
    if motion is None:
        raise InputError.at(
            place, "start motion", "none",
            "Zeiss .txrm, GE .pcr, SkyScan _TS.csv, CTSimU .json or a clra alignment",
        )  # fmt: skip
    if views is not None and motion.views != views:
        raise InputError.at(place, "start motion", f"{motion.views} views", f"{views}")
    return motion


def _is_hdf5(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            return stream.read(8) == b"\x89HDF\r\n\x1a\n"
    except OSError:
        return True  # whoever opens it tells why it cannot be read


def holds_start_motion(path: str | os.PathLike[str]) -> bool:
    """Tell whether a path is a scanner's, so that `read_start_motion` may find something there."""
    place = Path(path)
    alone = place.suffix.lower() == ".pcr" or place.name.lower().endswith("_ts.csv")
    return (alone and place.is_file()) or recognise_or_none(place) is not None


def recognise_or_none(path: Path) -> tuple[Format, Path] | None:
    """Return what `recognise` does, and None where it raises."""
    try:
        return recognise(path)
    except InputError:
        return None


def _matches(each: Format, path: Path) -> bool:
    return bool(re.fullmatch(each.pattern, path.name.lower())) and each.check(path)


def _in_folder(folder: Path) -> tuple[Format, Path]:
    """Return the one metadata file of a folder, or of its ``proju16_raw``."""
    files = sorted(path for path in folder.iterdir() if path.is_file())
    raw = folder / "proju16_raw"
    files += sorted(path for path in raw.iterdir() if path.is_file()) if raw.is_dir() else []
    for each in FORMATS:
        found = [path for path in files if _matches(each, path)]
        # Of the walnuts' two files of vectors the corrected ones; of CTSimU's a scenario.
        preferred = [path for path in found if "corrected" in path.name.lower()]
        if each.read is read_ctsimu:
            preferred = [path for path in found if _with_radiographs(path)]
        found = preferred or found
        if len(found) > 1:
            listed = ", ".join(path.name for path in found[:5])
            raise InputError.at(folder, "scans", f"{len(found)}: {listed}", "one: give its file")
        if found:
            return each, found[0]
    raise InputError.at(folder, "files", "none of a scanner's metadata", f"one of {formats_read()}")


def _with_radiographs(path: Path) -> bool:
    """Whether a CTSimU file is metadata whose radiographs are there."""
    try:
        return not read_ctsimu(path, ScannerOptions()).missing and "etadata" in path.name
    except InputError:
        return False
