"""The report of an alignment: one HTML page that needs nothing else."""

import importlib.metadata
import os
import platform
from collections.abc import Sequence
from typing import Any

import numpy as np

from clra.app.progress_bar import duration
from clra.app.report import figures, page, view_charts
from clra.app.report.before_after import before_and_after
from clra.app.report.summary import Errors, Findings, Floats
from clra.app.report.verdict_box import verdict_box
from clra.app.scan_description import listed
from clra.io.atomic import atomic_path
from clra.methods.alignment.result import Iteration
from clra.methods.alignment.rigid.rigid_parts import rigid_parts
from clra.methods.assessment.agreement import Agreement
from clra.model.rigid.rigid_motion import RigidMotion

_COMPONENTS = {"u": ".3f", "v": ".3f", "magnification": ".1e"}  # of an error, as told
_UNOBSERVABLE = {
    "taken out": " It was taken out of the motion.",
    "left in": " It was left in the motion; clra align --gauge anchored takes it out.",
}


def write_report(path: str | os.PathLike[str], findings: Findings) -> None:
    """Write the page.

    Parameters
    ----------
    path : path-like
        HTML file; appears whole or not at all.
    findings : Findings
        What to tell.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    text = render(findings)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def render(findings: Findings) -> str:
    """Build the page as text.

    Parameters
    ----------
    findings : Findings
        What to tell.
    """
    result = findings.result
    body = [
        verdict_box(result.quality),
        *(page.told(f.severity, f.message, *_advice(f.advice)) for f in findings.notes),
        page.cards(_cards(findings)),
        *before_and_after(findings.comparison),
        _corrections(findings),
        *([_rigid(findings)] if isinstance(result.motion, RigidMotion) else []),
        *([_errors(findings.errors, findings.angles)] if findings.errors else []),
        _trust(findings),
        *([_history(result.history)] if result.history else []),
        *([_quality(findings.quality)] if findings.quality else []),
        _settings(findings),
    ]
    subtitle = [f"{result.motion.views} radiographs"]
    if result.history:
        subtitle.append(f"aligned in {duration(sum(i.seconds for i in result.history))}")
    if result.device:
        subtitle.append(f"on {result.device}")
    name = result.scan or "a scan"
    versions = ", ".join(f"{name} {version}" for name, version in _versions().items())
    return page.page(f"Alignment of {name}", " ".join(subtitle), body, f"Made by {versions}.")


def _cards(findings: Findings) -> list[tuple[str, str, str, str]]:
    result = findings.result
    motion, confidence = result.motion, result.confidence
    aside = np.abs(np.stack([motion.shift_u, motion.shift_v]))
    median, largest = np.median(aside, axis=1), aside.max(axis=1)
    scale = motion.magnification
    flagged = len(result.flagged)
    cards = [
        ("Shift, median", f"{median[0]:.2f}, {median[1]:.2f}", "pixel", "|u|, |v|"),
        ("Shift, largest", f"{largest[0]:.2f}, {largest[1]:.2f}", "pixel", "|u|, |v|"),
        (
            "Magnification",
            f"{1e3 * (scale.min() - 1):+.2f} to {1e3 * (scale.max() - 1):+.2f}",
            "10\u207b\u00b3",
            "range about 1",
        ),
        (
            "Confidence, median",
            f"{np.median(confidence):.3f}",
            "",
            f"{flagged} of {motion.views} views flagged",
        ),
    ]
    if findings.errors is not None:
        means = findings.errors.means()
        for name, prefix, note in (
            ("Error, gauge-free", "gauge_free_mae", "mean |u|, |v|; below 0.5 cannot be seen"),
            ("Error, raw", "mae", "mean |u|, |v|, with the sample's own movement"),
        ):
            value = f"{means[f'{prefix}_u']:.3f}, {means[f'{prefix}_v']:.3f}"
            cards.append((name, value, "pixel", note))
    elif result.history:
        last = result.history[-1]
        value = f"{last.update_u_median:.3f}, {last.update_v_median:.3f}"
        cards.append(("Last update, median", value, "pixel", "|u|, |v|; converged below 0.1"))
    return cards


def _corrections(findings: Findings) -> str:
    result = findings.result
    returns = result.about.get("path") == "double helix"
    return page.section(
        "Correction of each radiograph",
        view_charts.corrections(result.motion, findings.angles, returns=returns),
    )


def _rigid(findings: Findings) -> str:
    motion = findings.result.motion
    assert isinstance(motion, RigidMotion)
    rows = [
        [name, *(f"{value:.3g}" if np.isfinite(value) else "" for value in part)]
        for name, part in rigid_parts(findings.result).items()
    ]
    return page.section(
        "Motion of the sample",
        view_charts.rigid_motion(motion, findings.angles),
        page.folded(
            "Numbers of the six parts",
            page.table(["", "rms", "largest", "standard error"], rows),
            shown=True,
        ),
    )


def _advice(advice: str) -> list[str]:
    return [page.paragraph(f"What to do: {advice}.")] if advice else []


def _history(history: Sequence[Iteration]) -> str:
    known = history[0].mae_u is not None
    caption = (
        "Left: how far each iteration still moved the radiographs (median over the views; dotted: "
        "the farthest moved one); dashed: 0.1 pixel, below which the run counts as converged. "
    )
    if known:
        caption += (
            "Middle: mean distance to the true motion, raw and without the gauge; dashed: 0.25 "
            "pixel. "
        )
    caption += (
        "Right: what is left of the radiographs when their registered re-projections are taken "
        "off; levels of resolution (QR, HR, FR) are not comparable with each other."
    )
    head = ["level", "iteration", "update u", "update v", "largest", "residual", "correlation"]
    head += ["error u", "error v", "gauge-free u", "gauge-free v"] if known else []
    rows = [
        [
            i.level,
            str(i.iteration),
            *(f"{x:.3f}" for x in (i.update_u_median, i.update_v_median, i.update_max)),
            f"{i.residual:.3g}",
            f"{i.correlation:.4f}",
            *(
                "" if x is None else f"{x:.3f}"
                for x in (i.mae_u, i.mae_v, i.gauge_free_u, i.gauge_free_v)
                if known
            ),
            duration(i.seconds),
        ]
        for i in history
    ]
    return page.section(
        "Convergence",
        page.figure(figures.convergence(history), caption, "Convergence by iteration"),
        page.folded("Numbers of each iteration", page.table([*head, "time"], rows)),
    )


def _errors(errors: Errors, angles: Floats | None) -> str:
    means = errors.means()
    names = {
        "raw": "mae",
        "gauge-free": "gauge_free_mae",
        "raw, without flagged views": "valid_mae",
        "gauge-free, without flagged views": "valid_gauge_free_mae",
    }
    rows = [
        [told, *(f"{means[f'{name}_{c}']:{form}}" for c, form in _COMPONENTS.items())]
        for told, name in names.items()
        if f"{name}_u" in means
    ]
    return page.section(
        "Error of each view",
        view_charts.error_of_views(errors, angles),
        page.folded(
            "Mean errors",
            page.table(["mean absolute error", "u [pixel]", "v [pixel]", "magnification"], rows),
            shown=True,
        ),
    )


def _trust(findings: Findings) -> str:
    result = findings.result
    flagged = result.flagged
    parts = [view_charts.confidence(result.confidence, flagged, findings.angles)]
    if result.median_sigma:
        u, v, m = result.median_sigma
        parts.append(
            page.paragraph(
                f"Standard error of a view's registration, median: {u:.3f} pixel in u, {v:.3f} "
                f"pixel in v, {m:.1e} in magnification."
            )
        )
    if flagged:
        parts.append(page.paragraph(f"Flagged views: {listed(flagged, 40)}."))
    if result.gauge:
        unobservable = result.about.get("unobservable", "")
        parts += [
            page.paragraph(
                "Gauge content: root mean square of the part of the motion found that each "
                "movement of the sample as a whole would explain. Radiographs hardly see it, and "
                "the volume is as sharp with it as without." + _UNOBSERVABLE.get(unobservable, "")
            ),
            page.folded("Gauge content by movement", page.bars(result.gauge, "pixel")),
        ]
    return page.section("How far to trust it", *parts)


def _quality(quality: Agreement) -> str:
    rows = [
        [
            "unexplained part of a radiograph",
            f"{100 * quality.unexplained_before:.1f} %",
            f"{100 * quality.unexplained_after:.1f} %",
        ],
        ["sharpness of the volume", "1", f"{quality.sharpness:.2f}"],
        [
            "disagreement of half scans, u and v [pixel]",
            "",
            f"{quality.half_u:.3f}, {quality.half_v:.3f}",
        ],
    ]
    return page.section(
        "What the radiographs alone tell",
        page.table(["", "before", "after"], rows),
        page.paragraph(
            "Unexplained: RMS of a radiograph less its re-projection, as a part of its own "
            "contrast in the band that is registered, median over the views. What stays after "
            "alignment is noise and what the reconstruction cannot do. Sharpness: mean squared "
            "gradient inside the field of view, relative to before; noise counts as sharp, too. "
            "Half scans: every view is registered with two volumes, from the even and from the "
            "odd-numbered views; how far they differ is how well the data hold the shifts. In "
            "simulations it was 0.02 to 0.05 pixel with the true motion and 0.04 to 0.11 when "
            "each view was 0.25 pixel off; what both halves share, as a movement of the sample, it "
            "cannot show."
        ),
        page.paragraph(f"Measured with radiographs binned by {quality.level}."),
    )


def _settings(findings: Findings) -> str:
    result = findings.result
    names = ("scan", "checksum", "method", "schedule", "estimate", "device")
    about = {name: getattr(result, name) for name in names} | dict(result.about)
    about |= {f"{name} version": version for name, version in result.versions.items()}
    command = result.command
    if findings.facts:
        about.pop("path", None)  # they tell more of it
    about = {key: value for key, value in about.items() if value}
    facts = {name: value.replace(" um", " \u00b5m") for name, value in findings.facts.items()}
    tables = [page.facts(values) for values in (facts, about) if values]
    parts = [page.columns(tables)]
    if command:
        parts += [page.paragraph("To do it again:"), page.code(command)]
    folded = page.folded("All settings", *parts)
    return page.section("Scan, settings and how to do it again", folded)


def _versions() -> dict[str, str]:
    names: Sequence[str] = ("clra", "numpy", "pyopencl")
    found: dict[str, Any] = {name: importlib.metadata.version(name) for name in names}
    return {**found, "Python": platform.python_version()}
