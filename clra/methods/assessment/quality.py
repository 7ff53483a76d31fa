"""How far an alignment can be trusted, by views that were held out: a verdict, and error bars."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from clra.findings import Finding
from clra.methods.alignment.region import region_of
from clra.methods.alignment.result import AlignmentResult
from clra.methods.assessment.held_out import HeldOut, Predicted
from clra.model.gauge.gauge import Gauge, sample_points
from clra.model.grid import default_grid
from clra.model.motion import Motion
from clra.model.sampling.angular_coverage import covered
from clra.model.scan import Scan
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

VERDICTS = ("good", "doubtful", "failed")

# Errors are so many times what held-out views see of them: the rest is in slow modes, which all
# parts of the views share; on arcs of less than a turn there are more of them, and most on less
# than half a turn. Over the kinds of `tools/stress.py` errors are 0.8 to 2 times, and 2 to 5 times,
# what is seen.
_UNSEEN, _UNSEEN_ON_ARCS, _UNSEEN_ON_TILTS, _UNSEEN_OF_CUT_OFF = 1.2, 2.2, 3.5, 4.0
# Views below which what is seen is mostly that they hardly predict each other.
_MANY = 100
# Mean absolute error over root mean square, of normal errors.
_MEAN = 0.8
# Quantile of the views' residuals above which a view counts as misplaced, and the part of what
# would explain its excess that its error along either axis is taken to be.
_USUAL, _MISPLACED = 0.75, 0.35
# Error from which on a result is doubtful, and failed [pixel].
_DOUBTFUL, _FAILED = 0.3, 2.0
# Part of a held-out radiograph that is not predicted, likewise. With the true motion it is 0.02 to
# 0.1 in good scans, and 0.13 and 0.2 in samples 1.5 and 2 times as wide as the field of view.
_UNEXPLAINED, _HOPELESS = 0.2, 0.5
# Views below which many of them are not predicted for lack of others.
_FEW = 40
# Points of the sample by which the gauge is known.
_POINTS = 300
# Views at each side over which squares of what is found left are averaged.
_AROUND = 4


@dataclass(frozen=True)
class Quality:
    """A verdict on an alignment, and the numbers behind it.

    A quarter or half of the views is held out, a non-negative volume is found from the others by
    iteration at a low resolution, and predicts them. Lengths are in pixels of the full-resolution
    detector.

    Attributes
    ----------
    verdict : {"good", "doubtful", "failed"}
        "good": errors are most likely below 0.3 pixel. "failed": the result is of no use.
    reasons : tuple of Finding
        Why it is not "good", or why the start was returned.
    level : int
        Binning factor at which views were predicted.
    residual_before, residual_after : float
        Part of a held-out radiograph that is not predicted (RMS in the band of registration),
        median over the views, at the start and with the motion that was found.
    shift_before, shift_after : (float, float, float)
        RMS over the views of what registration with the predictions finds to be left in u, v
        [pixel] and magnification, gauge-free.
    error : float
        Expected mean absolute error, the larger one of u and v [pixel].
    sharpness : float
        Mean squared gradient of the volume after, relative to before.
    kept_start : bool
        Whether the start is returned, as the motion found predicts held-out views no better.
    residual : tuple of float
        Of each view; NaN for those that were not held out.
    """

    verdict: str
    reasons: tuple[Finding, ...] = ()
    level: int = 1
    residual_before: float = 0.0
    residual_after: float = 0.0
    shift_before: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift_after: tuple[float, float, float] = (0.0, 0.0, 0.0)
    error: float = 0.0
    sharpness: float = 1.0
    kept_start: bool = False
    residual: tuple[float, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON; NaN is None there."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        plain["reasons"] = [reason.as_dict() for reason in self.reasons]
        plain["residual"] = [None if np.isnan(r) else round(r, 5) for r in self.residual]
        return plain | {name: list(plain[name]) for name in ("shift_before", "shift_after")}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Quality:
        """Return what :meth:`as_dict` wrote; names that are not known are left out."""
        known = {f.name for f in fields(cls)}
        plain = {name: value for name, value in values.items() if name in known}
        plain["reasons"] = tuple(Finding.from_dict(value) for value in plain.get("reasons", ()))
        residual = plain.get("residual", ())
        plain["residual"] = tuple(float("nan") if r is None else float(r) for r in residual)
        for name in ("shift_before", "shift_after"):
            if name in plain:
                plain[name] = tuple(plain[name])
        return cls(**plain)


def assess(
    stream: Stream, scan: Scan, aligned: AlignmentResult, start: Motion, *, scale: bool
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

    Returns
    -------
    AlignmentResult
        With its quality, and with standard errors that count what held-out views find to be left;
        with the start as its motion if the one that was found predicts them no better.
    """
    region = region_of(stream, scan, default_grid(scan.geometry))
    held_out = HeldOut(stream, scan, region.grid)
    radiographs, views = held_out.radiographs(aligned.valid_views)

    def predicted(motion: Motion, whole: bool, name: str) -> Predicted:
        stage = f"held-out views, {name}"
        return held_out.predict(
            radiographs, views, motion, magnification=scale, whole=whole, stage=stage
        )

    before = predicted(start, False, "before")
    after = predicted(aligned.motion, True, "after")
    gauge = _Left(scan, scale)
    kept_start = not _better(gauge, before, after)
    if kept_start and aligned.motion != start:
        aligned = replace(aligned, motion=start)
        after = predicted(start, True, "start")
    left = gauge.of(after)
    unseen = _unseen(scan, region.truncated) * min(1.0, np.sqrt(len(views) / _MANY))
    sigma = _standard_errors(aligned, left, after, unseen)
    # Phase correlation knows no standard errors.
    known = np.isfinite(sigma[:, :2]).all(axis=1)
    spread = sigma[known, :2].mean(axis=0) if known.any() else np.array(_rms(left)[:2])
    error = float(_MEAN * spread.max())
    quality = Quality(
        verdict="good",
        level=held_out.level,
        residual_before=float(np.nanmedian(before.residual)),
        residual_after=float(np.nanmedian(after.residual)),
        shift_before=_rms(gauge.of(before)),
        shift_after=_rms(left),
        error=error,
        sharpness=after.sharpness / before.sharpness if before.sharpness else 1.0,
        kept_start=kept_start,
        residual=tuple(after.residual.tolist()),
    )
    return replace(aligned, sigma=sigma, quality=judged(quality, len(views)))


def judged(quality: Quality, views: int) -> Quality:
    """Return the quality with its verdict and the reasons.

    Parameters
    ----------
    quality : Quality
        Whose numbers are known.
    views : int
        Number of views that were looked at.
    """
    reasons, grade = [], 0
    unexplained, error = quality.residual_after, quality.error
    if quality.kept_start:
        reasons.append(
            Finding(
                "no-motion",
                "held-out views are predicted no better with the motion that was found than at the "
                f"start ({100 * quality.residual_before:.1f} % of a radiograph not predicted)",
                "the start is returned",
                "info",
                {"residual": quality.residual_before},
            )
        )
    if error > _DOUBTFUL:
        grade = 2 if error > _FAILED else 1
        u, v, _ = quality.shift_after
        reasons.append(
            Finding(
                "held-out-shift",
                f"held-out views lie {u:.2f}, {v:.2f} pixel (rms along u, v) beside where a volume "
                "from the others predicts them",
                "more iterations at finer levels (such as --schedule 4QR-4HR) may help; else see "
                "the other findings",
                measured={"rms_u": u, "rms_v": v, "expected_error": error},
            )
        )
    # Of few views each is seen from where no other one is.
    if unexplained > _UNEXPLAINED and (views >= _FEW or error > _DOUBTFUL):
        grade = max(grade, 2 if unexplained > _HOPELESS else 1)
        reasons.append(
            Finding(
                "held-out-residual",
                f"{100 * unexplained:.0f} % of a held-out radiograph is not what a volume from the "
                "others predicts",
                "the geometry may be another one, the data defective, or the motion of another "
                "kind: see the other findings",
                measured={"residual": unexplained, "before": quality.residual_before},
            )
        )
    return replace(quality, verdict=VERDICTS[grade], reasons=tuple(reasons))


class _Left:
    """Gauge-free part of what predictions find to be left."""

    def __init__(self, scan: Scan, scale: bool) -> None:
        self._geometry, self._scale = scan.geometry, scale
        self._points = sample_points(default_grid(scan.geometry), _POINTS)

    def of(self, predicted: Predicted) -> Floats:
        """Shifts and magnification, (views, 3); NaN for views that were not held out."""
        held = np.flatnonzero(np.isfinite(predicted.residual))
        u, v, m = predicted.shift[held].T
        gauge = Gauge(self._geometry.subset(held), self._points, magnification=self._scale)
        left = np.full(predicted.shift.shape, np.nan)
        left[held] = gauge.fit(Motion(shift_u=u, shift_v=v, magnification=np.exp(m))).remainder
        return left


def _better(gauge: _Left, before: Predicted, after: Predicted) -> bool:
    """Whether the same held-out views are predicted better after than before."""
    both = np.isfinite(before.residual) & np.isfinite(after.residual)
    gain = before.residual[both] ** 2 - after.residual[both] ** 2
    certain = gain.mean() > 2 * gain.std() / np.sqrt(max(1, both.sum() - 1))
    apart = [np.sqrt(np.nanmean(gauge.of(p)[both, :2] ** 2)) for p in (before, after)]
    return bool((certain and gain.mean() > 0) or apart[1] < 0.9 * apart[0])


def _unseen(scan: Scan, truncated: bool) -> float:
    """How many times what is seen of them errors are."""
    if truncated:
        return _UNSEEN_OF_CUT_OFF
    angle = covered(scan.geometry)
    if angle > 2 * np.pi - 1e-6:
        return _UNSEEN
    return _UNSEEN_ON_ARCS if angle > np.pi - 1e-6 else _UNSEEN_ON_TILTS


def _standard_errors(
    aligned: AlignmentResult, left: Floats, after: Predicted, unseen: float
) -> Floats:
    """Registration's standard errors, what is left around each view, and its own misfit."""
    sigma = aligned.sigma.copy()
    known = np.flatnonzero(np.isfinite(after.residual))
    around = uniform_filter1d(left[known] ** 2, 2 * _AROUND + 1, axis=0, mode="nearest")
    # A view that is predicted worse than most others lies so many pixels off, if that is why.
    usual = np.quantile(after.residual[known], _USUAL)
    excess = np.maximum(after.residual[known] ** 2 - usual**2, 0.0)
    misfit = _MISPLACED**2 * excess / np.maximum(after.slope[known], 1e-6) ** 2
    m = aligned.motion
    found = np.stack([m.shift_u, m.shift_v, m.magnification], axis=1)
    lost = ~aligned.valid_views
    # Along the axis along which more is left.
    share = 2 * around[:, :2] / np.maximum(around[:, :2].sum(axis=1, keepdims=True), 1e-12)
    for axis in range(3):
        square = around[:, axis]
        if axis < 2:
            square = unseen**2 * square + share[:, axis] * misfit
        everywhere = np.interp(np.arange(len(sigma)), known, square)
        sigma[:, axis] = np.hypot(sigma[:, axis], np.sqrt(everywhere))
        # Others have their neighbours' motion, and differ from it as neighbours do.
        sigma[lost, axis] = np.hypot(sigma[lost, axis], _apart(found[known, axis]))
    return sigma


def _apart(values: Floats) -> float:
    """RMS of the difference of values and the mean of their two neighbours."""
    if len(values) < 3:
        return 0.0
    return float(np.sqrt(np.mean((values[1:-1] - 0.5 * (values[:-2] + values[2:])) ** 2)))


def _rms(left: Floats) -> tuple[float, float, float]:
    u, v, m = np.sqrt(np.nanmean(left**2, axis=0)).tolist()
    return u, v, m
