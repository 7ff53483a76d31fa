"""Judge an alignment by views that were held out: a verdict, error bars, undetermined modes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.region import region_of
from clra.methods.alignment.result import AlignmentResult
from clra.methods.assessment.held_out import FEW, HeldOut, Predicted
from clra.methods.assessment.quality import Quality, judged
from clra.methods.assessment.residual_regions import by_part_of_scan
from clra.methods.assessment.soft_modes import Modes
from clra.methods.assessment.standard_errors import below_four_cycles, standard_errors
from clra.model.gauge.gauge import sample_points
from clra.model.grid import default_grid
from clra.model.motion import Motion
from clra.model.sampling.angular_coverage import covered
from clra.model.scan import Scan
from clra.ops.streaming.radiographs import Reading
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

# Mean absolute error over root mean square, of normal errors.
_MEAN = 0.8
# Part of the distance to their predictions at which views lie closer than at the start: of 9
# views that did not move 0.77 to 1.3 is left by chance, of 9 that moved by half a pixel 0.4.
_CLOSER, _CLOSER_OF_FEW = 0.9, 0.6
# Points of the sample by which the gauge is known.
_POINTS = 300


def assess(
    stream: Stream,
    scan: Scan,
    aligned: AlignmentResult,
    start: Motion,
    *,
    scale: bool,
    reading: Reading | None = None,
) -> AlignmentResult:
    """Judge an alignment by views that are held out.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        That was aligned, at full resolution.
    aligned : AlignmentResult
        What was found.
    start : Motion
        Where it started.
    scale : bool
        Whether magnifications were estimated.
    reading : callable, optional
        Reads radiographs; this process by default.

    Returns
    -------
    AlignmentResult
        With its quality, and with standard errors that count what held-out views find to be left;
        with the start as its motion if the one that was found predicts them no better.
    """
    region = region_of(stream, scan, default_grid(scan.geometry))
    held_out = HeldOut(stream, scan, region.grid, reading)
    radiographs, views = held_out.radiographs(aligned.valid_views)

    def predicted(
        motion: Motion, whole: bool, name: str, further: Motion | None = None
    ) -> Predicted:
        return held_out.predict(
            radiographs,
            views,
            motion,
            further,
            magnification=scale,
            whole=whole,
            stage=f"held-out views, {name}",
        )

    before = predicted(start, len(views) < FEW, "before")
    after = predicted(aligned.motion, True, "after")
    points = sample_points(default_grid(scan.geometry), _POINTS)

    def left_of(found: Predicted) -> Floats:
        return found.left(scan.geometry, magnification=scale)

    kept_start = not _better(before, after, left_of)
    if kept_start and aligned.motion != start:
        aligned = replace(aligned, motion=start)
        after = predicted(start, True, "start")
    left = left_of(after)
    tilts = covered(scan.geometry) < np.pi - 1e-6
    sigma = standard_errors(aligned, left, held_out.level, truncated=region.truncated, tilts=tilts)
    # Phase correlation knows no standard errors.
    known = np.isfinite(sigma[:, :2]).all(axis=1)
    spread = sigma[known, :2].mean(axis=0) if known.any() else np.array(_rms(left)[:2])

    modes = Modes(scan.geometry.subset(views), points, magnification=scale)
    put_in = modes.added(held_out.level)
    nudged = predicted(
        aligned.motion, False, "with a known motion", _motion(scan.views, views, put_in)
    )
    slow = float(np.sqrt(np.mean(below_four_cycles(left[views, 2]) ** 2)))
    quality = Quality(
        verdict="good",
        level=held_out.level,
        residual_before=float(np.nanmedian(before.residual)),
        residual_after=float(np.nanmedian(after.residual)),
        shift_before=_rms(left_of(before)),
        shift_after=_rms(left),
        error=float(_MEAN * spread.max()),
        slow_magnification=slow,
        distortion=slow * float(np.hypot(*scan.geometry.shape)) / math.sqrt(12),
        sharpness=after.sharpness / before.sharpness if before.sharpness else 1.0,
        kept_start=kept_start,
        residual=tuple(after.residual.tolist()),
        regions=_rounded(by_part_of_scan(after.parts)),
        modes=modes.found(
            aligned.motion.subset(views),
            aligned.gauge,
            after.shift[views],
            put_in,
            (nudged.shift - after.shift)[views],
            np.isfinite(nudged.residual[views]),
        ),
    )
    return replace(aligned, sigma=sigma, quality=judged(quality, len(views)))


def _better(before: Predicted, after: Predicted, left_of: Callable[[Predicted], Floats]) -> bool:
    """Whether the same held-out views are predicted better after than before."""
    both = np.isfinite(before.residual) & np.isfinite(after.residual)
    gain = before.residual[both] ** 2 - after.residual[both] ** 2
    certain = gain.mean() > 2 * gain.std() / np.sqrt(max(1, both.sum() - 1))
    apart = [np.sqrt(np.nanmean(left_of(p)[both, :2] ** 2)) for p in (before, after)]
    closer = _CLOSER if both.sum() >= FEW // 2 else _CLOSER_OF_FEW
    return bool((certain and gain.mean() > 0) or apart[1] < closer * apart[0])


def _motion(views: int, chosen: NDArray[np.intp], table: Floats) -> Motion:
    """Return a motion of some of the views, (chosen, 3); the others do not move."""
    whole = np.zeros((views, 3))
    whole[chosen] = table
    u, v, m = whole.T
    return Motion(shift_u=u, shift_v=v, magnification=np.exp(m))


def _rounded(parts: Floats) -> tuple[tuple[tuple[float, ...], ...], ...]:
    return tuple(tuple(tuple(row) for row in part) for part in np.round(parts, 4).tolist())


def _rms(left: Floats) -> tuple[float, float, float]:
    u, v, m = np.sqrt(np.nanmean(left**2, axis=0)).tolist()
    return u, v, m
