"""How far an alignment can be trusted: a verdict, its reasons, and the numbers behind them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from clra.findings import Finding
from clra.methods.assessment.soft_modes import SoftMode

VERDICTS = ("good", "doubtful", "failed")

# Error from which on a result is doubtful, and failed [pixel].
_DOUBTFUL, _FAILED = 0.3, 2.0
# Part of a held-out radiograph that is not predicted, likewise. With the true motion it is 0.02 to
# 0.1 in good scans, and 0.13 and 0.2 in samples 1.5 and 2 times as wide as the field of view.
_UNEXPLAINED, _HOPELESS = 0.2, 0.5
# Views below which many of them are not predicted for lack of others.
_FEW = 40
# Slow error of the magnification from which on a result is doubtful. In good scans of
# `tools/stress.py` up to 0.003 are found, 0.007 in wood; where slow shifts of 30 pixels bend the
# volume, 0.01 to 0.024. It has to displace what the detector sees as well.
_MAGNIFIED = 0.009


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
    slow_magnification : float
        RMS of what is left of the magnification below four cycles a scan.
    distortion : float
        RMS over the detector of the displacement by it [pixel].
    sharpness : float
        Mean squared gradient of the volume after, relative to before.
    kept_start : bool
        Whether the start is returned, as the motion found predicts held-out views no better.
    residual : tuple of float
        Of each view; NaN for those that were not held out.
    regions : tuple
        RMS of what is not predicted by part of the scan, of the rows and of the columns (four,
        three and three), as a part of a radiograph's contrast.
    modes : tuple of SoftMode
        Movements of the sample as a whole and slow motions, and how far the data determine them.
    """

    verdict: str
    reasons: tuple[Finding, ...] = ()
    level: int = 1
    residual_before: float = 0.0
    residual_after: float = 0.0
    shift_before: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift_after: tuple[float, float, float] = (0.0, 0.0, 0.0)
    error: float = 0.0
    slow_magnification: float = 0.0
    distortion: float = 0.0
    sharpness: float = 1.0
    kept_start: bool = False
    residual: tuple[float, ...] = ()
    regions: tuple[tuple[tuple[float, ...], ...], ...] = ()
    modes: tuple[SoftMode, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON; NaN is None there."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        plain["reasons"] = [reason.as_dict() for reason in self.reasons]
        plain["regions"] = [[list(row) for row in part] for part in self.regions]
        plain["modes"] = [mode.as_dict() for mode in self.modes]
        plain["residual"] = [None if np.isnan(r) else round(r, 5) for r in self.residual]
        return plain | {name: list(plain[name]) for name in ("shift_before", "shift_after")}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Quality:
        """Return what :meth:`as_dict` wrote; names that are not known are left out."""
        known = {f.name for f in fields(cls)}
        plain = {name: value for name, value in values.items() if name in known}
        plain["reasons"] = tuple(Finding.from_dict(value) for value in plain.get("reasons", ()))
        plain["modes"] = tuple(SoftMode.from_dict(mode) for mode in plain.get("modes", ()))
        regions = plain.get("regions", ())
        plain["regions"] = tuple(tuple(tuple(row) for row in part) for part in regions)
        residual = plain.get("residual", ())
        plain["residual"] = tuple(float("nan") if r is None else float(r) for r in residual)
        for name in ("shift_before", "shift_after"):
            if name in plain:
                plain[name] = tuple(plain[name])
        return cls(**plain)


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
    few = views < _FEW
    if unexplained > _UNEXPLAINED and (not few or error > _DOUBTFUL):
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
    if quality.slow_magnification > _MAGNIFIED and quality.distortion > _DOUBTFUL and not few:
        grade = max(grade, 1)
        reasons.append(
            Finding(
                "magnification",
                f"held-out views are magnified by {100 * quality.slow_magnification:.1f} % (rms) "
                "against what a volume from the others predicts, slowly over the scan",
                "shifts and magnifications are wrong together, and the volume is bent: a motion as "
                "large as the field of view, or an axis that is elsewhere, does that",
                measured={"rms": quality.slow_magnification},
            )
        )
    return replace(quality, verdict=VERDICTS[grade], reasons=tuple(reasons))
