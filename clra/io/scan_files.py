"""Scan files: whatever the format, one function reads it and one writes it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.atomic import ensure_writable
from clra.io.damage import reads
from clra.io.nxtomo.fields import Overrides
from clra.io.nxtomo.reader import read_nxtomo
from clra.io.nxtomo.writer import write_nxtomo
from clra.io.provenance import Provenance
from clra.io.scanners.recognise import read_scanner
from clra.io.scanners.scanner_options import ScannerOptions
from clra.io.scanners.scanner_scan import ScannerScan
from clra.model.detector_pose import flipped, with_axis_at
from clra.model.scan import DeliveredProjections, Scan
from clra.model.validation import all_but
from clra.progress import ProgressCallback


@reads
def read_scan(
    path: str | os.PathLike[str],
    *,
    entry: str | None = None,
    rotation: str | None = None,
    source_distance: float | None = None,
    parallel: bool = False,
    white: float | None = None,
    flip: str | None = None,
    centre_offset: float | tuple[float, ...] | None = None,
    options: ScannerOptions | None = None,
) -> Scan:
    """Read a scan; the radiographs stay in the file until they are asked for.

    NXtomo files (HDF5) are read, and what scanners write: Nikon, Zeiss, SkyScan, GE phoenix,
    FleX-ray and TESCAN, HeliScan, CTSimU, Data Exchange, by their metadata file or folder. Counts
    become transmission by flat and dark frames; row 0 is the top of a radiograph;
    ``x_translation`` moves the sample along increasing columns, ``y_translation`` along the beam,
    ``z_translation`` up.

    Parameters
    ----------
    path : path-like
        The file, or a scanner's folder.
    entry : str, optional
        Which of several scans in the file.
    rotation : {"ccw", "cw"}, optional
        How the sample turns as ``rotation_angle`` grows, seen from above (+z); "ccw" for NXtomo and
        the vendor's own sense for scanners if not given.
    source_distance : float, optional
        From the source to the rotation axis [mm], in place of the file's.
    parallel : bool
        The beam is parallel: a source so far away that rays end within 1/8000 of the detector's
        width of where parallel ones would, and the detector at the axis.
    white : float, optional
        Counts of the open beam, in place of flat frames; 1 for radiographs that hold transmission.
    flip : {"columns", "rows", "both"}, optional
        The radiographs are stored mirrored against what the file says.
    centre_offset : float or (float, float), optional
        Column at which the axis is seen and, if two, row at which the perpendicular from the source
        meets the detector, from its middle, toward higher columns and rows [pixel].
    options : ScannerOptions, optional
        What else a scanner's files leave open: tables of angles and heights, detector distance,
        pixel size. The arguments above come before its own.

    Returns
    -------
    Scan
        Its ``projections.notes`` say what was noticed.

    Raises
    ------
    InputError
        A ValueError whose one line names the file, the field, what was found and what was expected.
    """
    given: dict[str, Any] = {
        "rotation": rotation,
        "source_distance": source_distance,
        "parallel": parallel or None,
        "white": white,
        "flip": flip,
        "centre_offset": centre_offset,
    }
    said = {name: value for name, value in given.items() if value is not None}
    scanner = read_scanner(path, replace(options or ScannerOptions(), **said))
    if scanner is not None:
        return scanner.scan(white)
    overrides = Overrides(rotation or "ccw", source_distance, parallel)
    scan = read_nxtomo(path, entry=entry, overrides=overrides, white=white)
    geometry = scan.geometry if flip is None else flipped(scan.geometry, flip)
    if centre_offset is not None:
        column, *row = np.atleast_1d(centre_offset).tolist()
        geometry = with_axis_at(geometry, column, row[0] if row else None)
    return scan if geometry is scan.geometry else replace(scan, geometry=geometry)


def import_scanner(
    out: str | os.PathLike[str],
    scan: ScannerScan,
    *,
    name: str | None = None,
    exclude: Sequence[int] = (),
    progress: ProgressCallback | None = None,
) -> None:
    """Write what a scanner's files hold as NXtomo; the file appears whole or not at all.

    Parameters
    ----------
    out : path-like
        The file.
    scan : ScannerScan
        Read some frames at a time.
    name : str, optional
        Title of the scan; the name of `out` if not given.
    exclude : sequence of int
        Radiographs that are marked as invalid, from 0: readers leave them out.
    progress : callable, optional
        Called with a ``Progress`` as frames are written.

    Raises
    ------
    InputError
        If there are no radiographs beside the metadata.
    OutputError
        If the file cannot be written.
    """
    ensure_writable(out, keep=(scan.path,))
    if scan.missing:
        raise InputError(scan.frames.reason)
    radiographs = scan.radiographs()
    others = {"flats": scan.flats, "flats_after": scan.flats_after, "darks": scan.darks}
    parts = [radiographs, *(part for part in others.values() if part is not None)]
    write_nxtomo(
        out,
        radiographs,
        scan.geometry,
        kind=scan.kind,
        dtype=np.result_type(*(part.dtype for part in parts)),
        name=name or os.path.basename(os.fspath(out)),
        truth=scan.known_motion,
        valid_views=all_but(exclude, scan.geometry.views),
        progress=progress,
        **others,
    )


def write_scan(
    path: str | os.PathLike[str],
    scan: Scan,
    *,
    valid_views: NDArray[np.bool_] | None = None,
    provenance: Provenance | None = None,
    progress: ProgressCallback | None = None,
) -> None:
    """Write a scan's line integrals as NXtomo; the file appears whole or not at all.

    Parameters
    ----------
    path : path-like
        The file.
    scan : Scan
        Read some views at a time; or corrected by others, see :func:`clra.correct`.
    valid_views : ndarray of bool, (views,), optional
        Views to be used, at least one, all by default. The others are written as well, marked
        invalid: readers of NXtomo, :func:`read_scan` too, leave them out.
    provenance : mapping of str to str, optional
        Where it comes from, see :func:`clra.io.provenance.provenance`: attributes of the root.
    progress : callable, optional
        Called with a ``Progress`` as frames are written.

    Raises
    ------
    InputError
        If `valid_views` is not of these views, or none.
    OutputError
        If the file cannot be written.
    """
    made = scan.projections
    write_nxtomo(
        path,
        made if isinstance(made, DeliveredProjections) else _LineIntegrals(scan),
        scan.geometry,
        kind="line-integrals",
        dtype=np.float32,
        name=scan.name,
        truth=scan.truth,
        mask=scan.mask,
        valid_views=valid_views,
        provenance=provenance,
        progress=progress,
    )


class _LineIntegrals:
    """The line integrals of a scan, sliced like an array."""

    def __init__(self, scan: Scan) -> None:
        self._scan = scan
        self.shape = scan.shape

    def __getitem__(self, views: slice) -> NDArray[np.float32]:
        start, stop, _ = views.indices(self.shape[0])
        return self._scan.read(start, stop)
