"""Defects of a scan are found, and corrected from then on, before anything else is done with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clra.findings import Finding
from clra.model.bad_pixels import Patches
from clra.model.corrections.air_region import AirRegion, AirStatistics
from clra.model.corrections.correction_options import CorrectionOptions
from clra.model.corrections.corrections import Corrections
from clra.model.corrections.detector_statistics import FEWEST, BadPixels, DetectorStatistics
from clra.model.corrections.rings import ring_errors
from clra.model.scan import Scan
from clra.model.validation import all_but, checked_valid_views
from clra.progress import ProgressCallback, tell

# Views that the detector's pixels are judged by: 60 tell a hot pixel from photon noise, and of
# large detectors fewer, so many that about this number of pixels is read.
_VIEWS, _FEWEST_VIEWS, _PIXELS = 60, 16, 60e6
# Parts of the detector whose pixels cannot all be bad: then the statistics mean something else.
_MOST = 0.2


def prepared(
    scan: Scan,
    options: CorrectionOptions | None = None,
    *,
    progress: ProgressCallback | None = None,
) -> Scan:
    """Return a scan with corrections for the defects that its radiographs have.

    What is found is issued as findings (:meth:`clra.findings.Finding.warn`).

    Parameters
    ----------
    scan : Scan
        At most 60 of its radiographs are read, one after another. A scan that has its corrections
        already is returned as it is.
    options : CorrectionOptions, optional
        What to look for; by default the defaults of these.
    progress : callable, optional
        Called with a :class:`clra.progress.Progress` as work goes on.

    Returns
    -------
    Scan
        The corrections are made as it is read.
    """
    options = options or CorrectionOptions()
    if scan.corrections is not None:
        for finding in scan.corrections.findings:
            finding.warn()
        return scan
    all_but(options.exclude, scan.views)  # refuses what is wrong
    findings: list[Finding] = []
    bad = air = rings = None
    wanted = options.bad_pixels or options.intensity or options.rings
    if wanted and scan.views >= FEWEST:
        statistics = DetectorStatistics(scan.geometry.shape)
        sides = AirStatistics(*scan.window)
        views = np.arange(scan.views) if options.rings else sample_of_views(scan)
        views = np.setdiff1d(views, options.exclude)
        for done, view in enumerate(views):
            tell(progress, "looking for defects", done, len(views))
            image = scan.read(int(view), int(view) + 1, check=False)[0]
            statistics.add(image)
            sides.add(image)
        tell(progress, "looking for defects", len(views), len(views))
        if options.bad_pixels:
            bad, told = _usable(statistics.find())
            findings += told
        if options.intensity:
            air = sides.find()
            findings += _intensity(air)
        if options.rings:
            mean = statistics.moments()[0]
            if bad is not None:
                Patches(bad).fill(mean)
            rings = ring_errors(mean)
    for finding in findings:
        finding.warn()
    corrections = Corrections(
        zingers=options.zingers,
        bad=bad,
        air=air,
        rings=rings,
        beam_hardening=options.beam_hardening,
        excluded=options.exclude,
        findings=tuple(findings),
    )
    return replace(scan, corrections=corrections)


def with_detector_of(scan: Scan, other: Scan) -> Scan:
    """Return another scan by the same detector with the scan's mask, bad pixels and rings."""
    return replace(other, mask=scan.mask, corrections=scan.corrections)


def used_views(scan: Scan, valid: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    """Return which views to use, (views,): those that are valid and not excluded; None for all."""
    excluded = () if scan.corrections is None else scan.corrections.excluded
    left = all_but(excluded, scan.views)
    if left is None or valid is None:
        return valid if left is None else left
    return checked_valid_views(valid & left, scan.views)


def sample_of_views(scan: Scan) -> NDArray[np.intp]:
    """Return the views by which the detector is judged, spread evenly over the scan."""
    rows, columns = scan.geometry.shape
    count = min(_VIEWS, max(_FEWEST_VIEWS, int(_PIXELS / (rows * columns))), scan.views)
    return np.unique(np.linspace(0, scan.views - 1, count).round().astype(np.intp))


def _usable(found: BadPixels) -> tuple[NDArray[np.bool_] | None, list[Finding]]:
    """Bad pixels to correct, if any, and what to tell users of them."""
    part = float(found.bad.mean())
    if part == 0:
        return None, []
    measured: dict[str, float | str] = {
        "bad_pixels": int(found.bad.sum()),
        "single": found.single,
        "rows": " ".join(map(str, found.rows)),
        "columns": " ".join(map(str, found.columns)),
    }
    if part > _MOST:
        finding = Finding(
            "bad-pixels",
            f"{part:.0%} of the pixels seem to show nothing of the sample, none is corrected",
            "check that the radiographs are of one sample that turns, or give a mask",
            measured=measured,
        )
        return None, [finding]
    told = f"{found}: interpolated from their neighbours"
    return found.bad, [Finding("bad-pixels", told, severity="info", measured=measured)]


def _intensity(air: AirRegion | None) -> list[Finding]:
    if air is None:
        return []
    told = f"the beam's intensity changes: taken from {len(air.tiles)} regions of air in each view"
    return [Finding("intensity", told, severity="info", measured={"regions": len(air.tiles)})]
