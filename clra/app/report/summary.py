"""What there is to tell of an alignment: errors against a known truth, pictures, a summary."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clra.app.plausible import doubt_of_shifts
from clra.app.progress_bar import duration
from clra.app.scan_description import Facts, table, views_flagged
from clra.findings import Finding
from clra.methods.alignment.result import AlignmentResult
from clra.methods.alignment.rigid.rigid_parts import rigid_parts
from clra.methods.assessment.quality import Quality
from clra.model.gauge.gauge import Gauge, sample_points
from clra.model.gauge.modes import GAUGE_MODES
from clra.model.grid import default_grid
from clra.model.motion import Motion
from clra.model.scan import Scan

if TYPE_CHECKING:
    from clra.app.report.comparison import Comparison
    from clra.methods.assessment.agreement import Agreement
    from clra.progress import ProgressCallback

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Errors:
    """What an estimate lacks to the truth, view by view.

    Attributes
    ----------
    raw, gauge_free : ndarray, (views, 3)
        Estimate minus truth along u and v [pixel] and in magnification, as it is and without what
        a movement of the sample as a whole explains.
    valid_views : ndarray of bool, (views,)
        Views that were not flagged: the others' errors are those of a guess.
    """

    raw: Floats
    gauge_free: Floats
    valid_views: NDArray[np.bool_]

    @classmethod
    def of(cls, result: AlignmentResult, scan: Scan) -> "Errors | None":
        """Compare an estimate with the truth, if the scan knows it.

        Parameters
        ----------
        result : AlignmentResult
            Of an alignment of the scan.
        scan : Scan
            With its geometry, and its truth if it is a simulation.
        """
        if scan.truth is None:
            return None
        motion, truth = result.motion, scan.truth
        difference = Motion(
            shift_u=motion.shift_u - truth.shift_u,
            shift_v=motion.shift_v - truth.shift_v,
            magnification=1 + (motion.magnification - truth.magnification),
        )
        points = sample_points(default_grid(scan.geometry))
        fit = Gauge(scan.geometry, points, magnification=result.scale_estimated).fit(difference)
        return cls(fit.part + fit.remainder, fit.remainder, result.valid_views)

    def means(self) -> dict[str, float]:
        """Mean absolute errors by name; those of valid views where some are not."""
        errors = {"mae": self.raw, "gauge_free_mae": self.gauge_free}
        if not self.valid_views.all():
            errors |= {f"valid_{name}": of[self.valid_views] for name, of in errors.items()}
        components = ("u", "v", "magnification")
        return {
            f"{name}_{component}": float(mean)
            for name, of in errors.items()
            for component, mean in zip(components, np.abs(of).mean(axis=0), strict=True)
        }


@dataclass(frozen=True)
class Findings:
    """What a report tells of.

    Attributes
    ----------
    result : AlignmentResult
        Of the alignment.
    errors : Errors, optional
        Where the truth is known.
    comparison : Comparison, optional
        Pictures, where the scan was at hand.
    facts : mapping of str to str
        Of the scan, for reading.
    quality : Agreement, optional
        What the radiographs alone tell, where the scan was at hand.
    angles : ndarray, (views,), optional
        Of the views, not folded into one turn [degree].
    """

    result: AlignmentResult
    errors: Errors | None = None
    comparison: "Comparison | None" = None
    facts: Mapping[str, str] = field(default_factory=dict)
    quality: "Agreement | None" = None
    angles: Floats | None = None

    @property
    def notes(self) -> tuple[Finding, ...]:
        """What the run warned of, and what the scan itself tells against its result."""
        doubt = "" if self.quality is None else doubt_of_shifts(self.quality, self.result.motion)
        told = [*self.result.warnings, *([Finding("disagreement", doubt)] if doubt else [])]
        return tuple({str(finding): finding for finding in told}.values())


def findings_of(
    result: AlignmentResult,
    scan: Scan | None,
    *,
    volume: NDArray[np.float32] | None = None,
    device: Any = None,
    progress: "ProgressCallback | None" = None,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
) -> Findings:
    """Collect what a report needs; with the scan, reconstruct it before and after.

    Parameters
    ----------
    result : AlignmentResult
        Of the alignment.
    scan : Scan, optional
        The one that was aligned.
    volume : ndarray, (nz, ny, nx), optional
        By multigrid iteration, aligned: it is shown beside one that was not.
    device : str or cl.Device, optional
        Where to reconstruct.
    progress : callable, optional
        Told how far it is.
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used.
    """
    if scan is None:
        return Findings(result)
    from clra.app.report.comparison import compare, volume_level
    from clra.methods.assessment.agreement import agreement
    from clra.ops.streaming.stream import Stream

    stream = Stream(
        device,
        max_device_memory=max_device_memory,
        max_host_memory=max_host_memory,
        report=progress,
    )
    part = scan.cropped()
    motion = result.motion.about(*scan.window_offset)
    return Findings(
        result,
        errors=Errors.of(result, scan),
        comparison=compare(stream, part, motion, result.confidence, result.valid_views, volume),
        quality=agreement(stream, part, motion, volume_level(part), result.valid_views)
        if _in_both_halves(result.valid_views)
        else None,
        facts=Facts.of(scan).lines(),
        angles=angles_of(part),
    )


def angles_of(scan: Scan) -> Floats:
    """Return the angle of each view about the axis, not folded into one turn [degree].

    Parameters
    ----------
    scan : Scan
        With its geometry.
    """
    x, y = scan.geometry.source[:, 0], scan.geometry.source[:, 1]
    return np.asarray(np.rad2deg(np.unwrap(np.arctan2(x, -y))))


def _in_both_halves(valid_views: NDArray[np.bool_]) -> bool:
    """Whether two of the even views and two of the odd ones are left to compare."""
    return bool(valid_views[::2].sum() > 1 and valid_views[1::2].sum() > 1)


def summary_of(result: AlignmentResult, errors: Errors | None) -> tuple[dict[str, Any], str]:
    """Sum an alignment up.

    Parameters
    ----------
    result : AlignmentResult
        Of the alignment.
    errors : Errors, optional
        Where the truth is known.

    Returns
    -------
    values : dict
        For programs.
    text : str
        For people.
    """
    motion, confidence = result.motion, result.confidence
    aside = np.abs(np.stack([motion.shift_u, motion.shift_v]))
    (median_u, median_v), (largest_u, largest_v) = np.median(aside, axis=1), aside.max(axis=1)
    least, most = motion.magnification.min(), motion.magnification.max()
    seconds = sum(iteration.seconds for iteration in result.history)
    values = {
        "views": motion.views,
        "median_shift": [median_u, median_v],
        "largest_shift": [largest_u, largest_v],
        "magnification": [least, most],
        "confidence_median": np.median(confidence),
        "flagged": result.flagged,
        "gauge": result.gauge,
        "schedule": result.schedule,
        "device": result.device,
        "seconds": seconds,
        "history": result.history,
        "quality": None if result.quality is None else result.quality.as_dict(),
        **(errors.means() if errors else {}),
    }
    judged = result.quality
    lines = {"verdict": _verdict(judged)} if isinstance(judged, Quality) else {}
    lines |= {
        "run": f"{motion.views} views, {_levels(result)}, {duration(seconds)}",
        "shift": f"median {median_u:.2f}, {median_v:.2f} pixel along u, v; "
        f"largest {largest_u:.2f}, {largest_v:.2f}",
        "magnification": f"{least:.5f} to {most:.5f}",
        "confidence": f"median {np.median(confidence):.3f}, {views_flagged(result.flagged)}",
    }
    parts = rigid_parts(result)
    if parts:
        values["rigid"] = {
            name.replace("\u00b5", "u"): dict(zip(("rms", "largest", "sigma"), part, strict=True))
            for name, part in parts.items()
        }
        turned = [part[0] for name, part in parts.items() if "degree" in name]
        lines["rotation"] = (
            f"{', '.join(f'{angle:.3f}' for angle in turned)} degrees rms about u, v, the beam"
        )
    if result.gauge:
        lines["unobservable"] = _unobservable(result)
    if isinstance(judged, Quality):
        lines |= _hardly_determined(judged)
    if "detector_offset_u" in result.about:
        offset, tilt = (result.about[name] for name in ("detector_offset_u", "detector_tilt"))
        values |= {"detector_offset_u": offset, "detector_tilt": tilt}
        lines["detector"] = (
            f"axis {offset} aside, image turned by {tilt}; slices sharper by a factor of "
            f"{result.about.get('detector_sharpening', '?')}"
        )
    if "source_travel" in result.about:
        values["source_travel"] = lines["source"] = result.about["source_travel"]
    if errors:
        means = errors.means()
        lines["error"] = _error(means, "", result)
        if result.flagged:
            lines["not flagged"] = _error(means, "valid_", result)
    # Last, where they are seen: numbers above may flatter.
    told = [f"{f.severity}: {f}" for f in result.warnings if f.severity != "info"]
    return values, "\n".join([table(lines), *told])


def _verdict(quality: Quality) -> str:
    before, after = (100 * r for r in (quality.residual_before, quality.residual_after))
    return (
        f"{quality.verdict}; expected error {quality.error:.2f} pixel; {after:.1f} % of a held-out "
        f"radiograph not predicted, {before:.1f} % at the start"
    )


def _hardly_determined(quality: Quality) -> dict[str, str]:
    """Tell modes that held-out views hardly see, other than movements of the sample."""
    modes = [m for m in quality.modes if m.hardly_determined and m.name not in GAUGE_MODES]
    if not modes:
        return {}
    told = (
        f"{m.name} {m.amplitude:.2f}"
        + (f" +- {m.sigma:.2f} pixel" if math.isfinite(m.sigma) else " pixel, not determined")
        for m in modes
    )
    return {"hardly determined": "; ".join(told)}


def _unobservable(result: AlignmentResult) -> str:
    """Tell the gauge by mode, the largest first, as far as it can be seen."""
    parts = sorted(result.gauge.items(), key=lambda mode: -mode[1])
    what = result.about.get("unobservable")
    told = ", ".join(f"{name} {size:.2f}" for name, size in parts if size >= 0.005)
    return f"{told or 'below 0.01'} pixel rms" + (f", {what}" if what else "")


def _error(means: Mapping[str, float], which: str, result: AlignmentResult) -> str:
    raw, free = (
        f"{means[f'{which}{name}_u']:.3f}, {means[f'{which}{name}_v']:.3f}"
        for name in ("mae", "gauge_free_mae")
    )
    scale = f"; magnification {means[f'{which}mae_magnification']:.1e}"
    return f"mean {raw} pixel along u, v against the truth; gauge-free {free}" + (
        scale if result.scale_estimated else ""
    )


def _levels(result: AlignmentResult) -> str:
    """Count the iterations at each level: "4QR-1HR"."""
    levels = [iteration.level for iteration in result.history]
    return "-".join(f"{levels.count(level)}{level}" for level in dict.fromkeys(levels))
