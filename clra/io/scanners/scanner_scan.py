"""What is read from a scanner's files, whoever made it, and how it becomes a scan."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.findings import Finding
from clra.io.frames.counts import CountedRadiographs
from clra.io.frames.frame_views import (
    ConvertedFrames,
    FrameSequence,
    MissingFrames,
    divided,
    mirrored,
)
from clra.io.scanners.scanner_options import ScannerOptions
from clra.model.detector_pose import flipped, mirrored_axes, reversed_axes, with_axis_at
from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion
from clra.model.rotation_sense import opposite_rotation
from clra.model.scan import Scan

Frames = Any


@dataclass(frozen=True, kw_only=True)
class ScannerScan:
    """A scan as a scanner's files tell it; pixels are read only when asked for.

    Row 0 of frames is the top and columns count to the right as seen from the source, whichever
    way the vendor stores them; `geometry` and motions are of these.

    Attributes
    ----------
    format : str
        The vendor's.
    path : Path
        The file that was read.
    geometry : ConeBeamGeometry
        Of the radiographs.
    frames : array-like object, (views, rows, columns)
        As they are on disk, or a `MissingFrames`.
    kind : {"counts", "transmission"}
        What `frames` hold, once divided by `white` where that is given.
    white : float or ndarray, (views,), or None
        Counts of the open beam by which frames that need no flats become transmission.
    flats, flats_after, darks : array-like object, (n, rows, columns), or None
        Frames of the open beam before and after the radiographs, and without beam.
    start_motion : Motion or None
        Motion that the vendor's software measured: a start for an alignment.
    known_motion : Motion or None
        Motion that a simulation put in.
    details : dict of str to str
        What a person reads in the metadata: name and value.
    findings : tuple of Finding
        What was assumed, and what could not be verified.
    """

    format: str
    path: Path
    geometry: ConeBeamGeometry
    frames: Frames
    kind: str
    white: float | NDArray[np.float64] | None = None
    flats: Frames = None
    flats_after: Frames = None
    darks: Frames = None
    start_motion: Motion | None = None
    known_motion: Motion | None = None
    details: dict[str, str] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    @property
    def missing(self) -> bool:
        """Whether there are no radiographs beside the metadata."""
        return isinstance(self.frames, MissingFrames)

    def normalisable(self, white: float | None) -> bool:
        """Whether there is something to divide counts by."""
        return self.kind != "counts" or self.flats is not None or white is not None

    def radiographs(self) -> Frames:
        """Return what is written: counts, or transmission where there is a `white`."""
        if self.white is None or self.missing:
            return self.frames
        return divided(self.frames, self.white)

    def scan(self, white: float | None = None) -> Scan:
        """Return the scan; counts become transmission as those of an NXtomo file do.

        What was found that may spoil a result is warned of; all of it is among the notes of the
        projections.

        Parameters
        ----------
        white : float, optional
            Counts of the open beam, in place of flat frames.

        Raises
        ------
        InputError
            If counts have neither flats nor `white`.
        """
        for finding in self.findings:
            finding.warn()
        projections = self.frames if self.missing else self._transmission(white)
        return Scan(
            projections,
            self.geometry,
            "transmission",
            name=self.path.name,
            truth=self.known_motion,
            mask=getattr(projections, "mask", None),
        )

    def described(self) -> Scan:
        """Return the scan without its pixels, of metadata alone or of counts without flats."""
        reason = f"{self.path}: radiographs: not read"
        return Scan(
            MissingFrames((self.geometry.views, *self.geometry.shape), reason),
            self.geometry,
            "transmission",
            name=self.path.name,
            truth=self.known_motion,
        )

    def contents(self) -> dict[str, str]:
        """Return name and value of each line that tells a person what was read."""
        count = {"flats": self.flats, "flats after": self.flats_after, "darks": self.darks}
        others = [f"{part.shape[0]} {name}" for name, part in count.items() if part is not None]
        white = self.white
        if self.missing:
            kind = "none beside the metadata"
        elif white is None:
            kind = ", ".join([self.kind, *others])
        else:
            level = f"{white:g}" if isinstance(white, float | int) else "each view's own"
            kind = f"{self.kind}: divided by {level} counts of the open beam"
        lines = {"format": f"{self.format}, {self.path.name}", "radiographs": kind, **self.details}
        motion = self.start_motion
        if motion is not None:
            u, v = np.abs(motion.shift_u).max(), np.abs(motion.shift_v).max()
            scale = np.abs(motion.magnification - 1).max()
            lines["start motion"] = f"up to {u:.3g}, {v:.3g} pixel and {scale:.2g} of magnification"
        return lines

    def _transmission(self, white: float | None) -> CountedRadiographs:
        first = [part for part in (self.darks, self.flats) if part is not None]
        before = sum(part.shape[0] for part in first)
        views = self.geometry.views
        after = [] if self.flats_after is None else [self.flats_after]
        darks = 0 if self.darks is None else self.darks.shape[0]
        count = before + views + sum(part.shape[0] for part in after)
        roles = np.arange(count)
        found = CountedRadiographs(
            FrameSequence([*first, self.radiographs(), *after]),
            path=os.fspath(self.path),
            views=roles[before : before + views],
            flats=np.concatenate([roles[darks:before], roles[before + views :]]),
            darks=roles[:darks],
            white=white,
            normalised=self.kind != "counts",
        )
        found.notes = (*map(str, self.findings), *found.notes)
        return found


def assembled(scan: ScannerScan, options: ScannerOptions, *, rotation: str) -> ScannerScan:
    """Return a scan, given as it is stored, with the options applied and its top up.

    Parameters
    ----------
    scan : ScannerScan
        Geometry, frames and motions of radiographs as they are stored.
    options : ScannerOptions
        What the user says.
    rotation : {"ccw", "cw"}
        The vendor's sense of rotation, which `scan.geometry` has.

    Raises
    ------
    InputError
        If frames do not fit the geometry.
    """
    geometry = scan.geometry
    expected = (geometry.views, *geometry.shape)
    if tuple(scan.frames.shape) != expected:
        found = "{} frames of {} x {}".format(*scan.frames.shape)
        raise InputError.at(
            scan.path, "radiographs", found, "{} of {} x {} pixels".format(*expected)
        )
    near, far = (
        float(np.median(getattr(geometry, name)))
        for name in ("source_to_axis", "source_to_detector")
    )
    if far < near * (1 - 1e-9) or near <= 0:
        found = f"{near:g} mm to the axis, {far:g} mm to the detector"
        raise InputError.at(scan.path, "distances", found, "an axis before the detector")
    if options.rotation is not None and options.rotation != rotation:
        geometry = opposite_rotation(geometry)
    if options.flip is not None:
        geometry = flipped(geometry, options.flip)
    rows, columns = mirrored_axes(geometry)
    geometry = reversed_axes(geometry, rows=rows, columns=columns)
    if options.centre_offset is not None:
        numbers = np.atleast_1d(np.asarray(options.centre_offset, np.float64))
        geometry = with_axis_at(geometry, numbers[0], None if len(numbers) < 2 else numbers[1])
    turned: dict[str, Any] = {
        name: mirrored(getattr(scan, name), rows=rows, columns=columns)
        for name in ("frames", "flats", "flats_after", "darks")
    }
    motions: dict[str, Any] = {
        name: _mirrored_motion(getattr(scan, name), rows=rows, columns=columns)
        for name in ("start_motion", "known_motion")
    }
    if options.white is not None and scan.kind == "counts":
        turned |= {"flats": _even(options.white, scan.frames), "flats_after": None}
    whole = replace(scan, geometry=geometry, **turned, **motions)
    return _without_return(whole)


def _without_return(scan: ScannerScan) -> ScannerScan:
    """Leave out a last radiograph at the place of the first: that of a check, not of the turn."""
    vectors = scan.geometry.to_astra()
    views = len(vectors) - 1
    if views < 3 or not np.allclose(
        vectors[0], vectors[-1], rtol=0, atol=1e-6 * abs(vectors).max()
    ):
        return scan
    frames = scan.frames
    shape = (views, *scan.geometry.shape)
    if scan.missing:
        frames = MissingFrames(shape, frames.reason)
    else:
        frames = ConvertedFrames(frames, lambda part, _: part, shape=shape)
    motions: dict[str, Any] = {
        name: None if motion is None else motion.subset(slice(views))
        for name in ("start_motion", "known_motion")
        for motion in [getattr(scan, name)]
    }
    message = f"radiograph {views + 1} stands where the first one does: it is left out"
    return replace(
        scan,
        geometry=scan.geometry.subset(slice(views)),
        frames=frames,
        white=scan.white[:views] if isinstance(scan.white, np.ndarray) else scan.white,
        findings=(*scan.findings, Finding("return", message, "", "info")),
        **motions,
    )


def unverified(what: str, option: str, effect: str = "turns it") -> Finding:
    """Return the finding that a sign is not verified on a real scan, and what turns it.

    Parameters
    ----------
    what : str
        Which sign, and how it was taken.
    option, effect : str
        The option, and what it does about it.
    """
    message = f"sign not verified on a real scan: {what}"
    return Finding("unverified-sign", message, f"{option} {effect}", "info")


def assumed(what: str, advice: str = "") -> Finding:
    """Return the finding that something the metadata do not tell was assumed."""
    return Finding("assumed", f"assumed: {what}", advice, "info")


def _even(white: float, frames: Frames) -> NDArray[Any]:
    """Frame of the open beam that is the same everywhere, of the frames' own type if that can."""
    fits = frames.dtype.kind in "iu" and white == int(white) <= np.iinfo(frames.dtype).max
    return np.full((1, *frames.shape[1:]), white, frames.dtype if fits else np.float32)


def _mirrored_motion(motion: Motion | None, *, rows: bool, columns: bool) -> Motion | None:
    if motion is None:
        return None
    return Motion(
        shift_u=-motion.shift_u if columns else motion.shift_u,
        shift_v=-motion.shift_v if rows else motion.shift_v,
        magnification=motion.magnification,
        cause=motion.cause,
    )
