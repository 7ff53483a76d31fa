"""Drift correction by a reference scan: a sparse second scan, taken so quickly that nothing moved.

Each reference view is registered with the view of the scan that looked from the same place; what
drifted slowly between is a smooth curve through what was found [1]_ [2]_. Jitter from view to view
it cannot see.

References
----------
.. [1] A. Sasov, X. Liu, P. L. Salmon, "Compensation of mechanical inaccuracies in micro-CT and
   nano-CT", Proc. SPIE 7078 (2008).
.. [2] G. R. Myers et al., "The high cone-angle helical micro-CT method", Proc. SPIE 8506 (2012).
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline

from clra.errors import InputError
from clra.findings import warn
from clra.methods.alignment.rejected_views import outliers
from clra.methods.alignment.reprojection import (
    Registered,
    in_full_pixels,
    register,
    registration_for,
)
from clra.methods.alignment.result import AlignmentResult, Iteration
from clra.methods.correction import corrected
from clra.model.gauge.gauge import Gauge, sample_points
from clra.model.grid import default_grid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.model.view_selection import match_views
from clra.ops.registration.gauss_newton import ESTIMATE_FIELDS, SMALLEST
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

# Views that see the sample's points farther apart than this, root mean square, show different
# perspectives: at 3 pixels of 512 columns a pair's shift is still found to 0.05 pixel.
_ALIKE = 3.0
# Fewest pairs that a smoothing spline can be fitted to.
_FEWEST = 5
# Part of the views, at an end of the scan, that may have no reference view beside or beyond them:
# the smooth curve stays what it was at the last one.
_BEYOND = 0.15
# Points of the sample by which views are compared: twice as many find the same pairs.
_POINTS = 40
# Resolutions at which pairs are registered: a quarter catches drifts of 64 pixels; full resolution,
# of radiographs corrected by that, is ten times as good on detectors of 128 columns.
_LEVELS = (4, 1)


def align_to_reference(
    stream: Stream, scan: Scan, reference: Scan, *, scale: bool, truth: Motion | None = None
) -> AlignmentResult:
    """Correct a scan's slow drift alone, as the result of an alignment.

    Parameters
    ----------
    stream, scan, reference, scale
        As for :func:`drift_from_reference`.
    truth : Motion, optional
        To report errors against.

    Returns
    -------
    AlignmentResult
        One iteration, at full resolution. Confidence and standard errors are those of the views
        that were registered, and linear between them; no view is flagged.
    """
    started = time.perf_counter()
    drift = drift_from_reference(stream, scan, reference, scale=scale)
    found, motion = drift.registered, drift.motion
    gauge = Gauge(scan.geometry, sample_points(default_grid(scan.geometry)), magnification=scale)

    def everywhere(values: Floats) -> Floats:
        return np.interp(np.arange(scan.views), drift.views, values)

    return AlignmentResult(
        motion=motion,
        valid_views=np.ones(scan.views, np.bool_),
        history=(
            Iteration.of(
                "FR",
                1,
                np.stack([motion.shift_u, motion.shift_v]),
                found.correlation,
                found.residual,
                time.perf_counter() - started,
                **({} if truth is None else gauge.error(motion, truth).means()),
            ),
        ),
        confidence=np.clip(everywhere(found.correlation), 0.0, 1.0),
        sigma=np.stack([everywhere(column) for column in found.sigma.T], axis=1),
        gauge=dict(gauge.fit(motion).rms_by_mode),
        schedule="reference",
        device=stream.device.name.strip(),
    )


@dataclass(frozen=True)
class Drift:
    """A slow drift found by a reference scan.

    Attributes
    ----------
    motion : Motion
        Of every view of the scan: the smooth curve.
    views : ndarray of int, (pairs,)
        Views that a reference view was registered with, in order of time.
    registered : Registered
        What was found for each.
    """

    motion: Motion
    views: NDArray[np.intp]
    registered: Registered


def drift_from_reference(stream: Stream, scan: Scan, reference: Scan, *, scale: bool) -> Drift:
    """Find the slow drift of a scan against a reference scan.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        Views in the order in which they were taken, evenly in time.
    reference : Scan
        Some of its views again, taken so quickly that nothing moved; at least five, from the same
        places, as spread in time as the drift is to be known.
    scale : bool
        Whether to estimate the magnification too.

    Returns
    -------
    Drift
        Each component a cubic smoothing spline over the view number, whose smoothness is chosen by
        generalised cross-validation; constant beyond the first and the last pair.

    Raises
    ------
    InputError
        If the detectors differ or fewer than five reference views have a view alike.
    """
    points = sample_points(default_grid(scan.geometry), count=_POINTS)
    try:
        match = match_views(scan.geometry, reference.geometry, points)
    except ValueError as error:
        raise InputError(f"{reference.name}: {error}") from error
    # One pair a view, in order of time.
    order = np.lexsort((match.distance, match.views))
    first = np.concatenate([[True], np.diff(match.views[order]) > 0])
    pairs = order[first & (match.distance[order] <= _ALIKE)]
    if len(pairs) < _FEWEST:
        raise InputError(
            f"{reference.name}: found {len(pairs)} views that look like one of {scan.name} to "
            f"within {_ALIKE:g} pixels (the nearest: {match.distance.min():.3g} pixels), expected "
            f"{_FEWEST} or more"
        )
    if len(pairs) < reference.views:
        warn(
            "reference-views",
            f"{reference.name}: {reference.views - len(pairs)} of {reference.views} views look "
            f"like none of {scan.name}, or like the same one as another, and are left out",
        )
    views = match.views[pairs]
    found = _registered(stream, scan.subset(views), reference.subset(pairs), scale)
    # What the two geometries know to differ is no drift.
    drift = Motion(
        shift_u=found.motion.shift_u - match.offset_u[pairs],
        shift_v=found.motion.shift_v - match.offset_v[pairs],
        magnification=found.motion.magnification,
    )
    good = ~outliers(found.correlation)
    if good.sum() < _FEWEST:
        raise InputError(
            f"{reference.name}: found {good.sum()} views that could be registered, expected "
            f"{_FEWEST} or more"
        )
    ends = views[good][0], views[good][-1]
    if max(ends[0], scan.views - 1 - ends[1]) > _BEYOND * scan.views:
        warn(
            "reference-gap",
            f"{reference.name}: found views beside {ends[0]} to {ends[1]} of {scan.name}'s 0 to "
            f"{scan.views - 1}: beyond these the drift is not known, and taken to stay as it was",
        )
    smooth = _smooth(scan.views, views[good], drift.subset(good))
    return Drift(smooth, views, replace(found, motion=drift))


def _registered(stream: Stream, scan: Scan, reference: Scan, scale: bool) -> Registered:
    """Register each view of the scan with the reference view of the same number."""
    known = Motion.identity(scan.views)
    levels = [n for n in _LEVELS if min(scan.geometry.shape) // n >= SMALLEST or n == 1]
    for level in levels:
        nearer = scan if level == levels[0] else corrected(stream, scan, known)
        measured, still = (Radiographs(stream, s, level) for s in (nearer, reference))
        registration = registration_for(stream, scan, measured, first=False, magnification=scale)
        table = np.empty((scan.views, len(ESTIMATE_FIELDS)))
        for chunk in stream.chunks(scan.views, 2 * measured.view_bytes):
            stream.report("registering with the reference", chunk.start, scan.views)
            moved, unmoved = (stream.upload(r.read(chunk)) for r in (measured, still))
            unknown = np.ones(chunk.stop - chunk.start)
            table[chunk] = register(stream, registration, moved, unmoved, unknown)
        stream.report("registering with the reference", scan.views, scan.views)
        found = in_full_pixels(table, level, scan.geometry.shape)
        known = found.motion.then(known)
    return replace(found, motion=known)


def _smooth(count: int, views: NDArray[np.intp], motion: Motion) -> Motion:
    """Smooth curves through what was found at some views, for all of them."""
    time = np.clip(np.arange(count), views[0], views[-1])

    def curve(values: Floats) -> Floats:
        return np.asarray(make_smoothing_spline(views.astype(np.float64), values)(time))

    return Motion(
        shift_u=curve(motion.shift_u),
        shift_v=curve(motion.shift_v),
        magnification=np.exp(curve(np.log(motion.magnification))),
    )
