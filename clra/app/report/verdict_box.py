"""What a report says first: whether the alignment is to be trusted, and why."""

import math

from clra.app.report import page
from clra.methods.alignment.result import SupportsAsDict
from clra.methods.assessment.quality import Quality

_ROWS = ("first rows", "middle rows", "last rows")
_WORDS = {
    "good": "Good: errors are most likely below 0.3 pixel",
    "doubtful": "Doubtful: look at the reasons before you use it",
    "failed": "Failed: the result is of no use",
}


def verdict_box(given: SupportsAsDict | None) -> str:
    """Return the verdict's HTML.

    Parameters
    ----------
    given : Quality or None
        As the alignment judged itself by views that were held out.
    """
    if given is None:
        text = "This alignment was not judged by views that were held out."
        return page.told("info verdict", "No verdict", page.paragraph(text))
    quality = Quality.from_dict(given.as_dict())
    u, v, _ = quality.shift_after
    before_u, before_v, _ = quality.shift_before
    rows = [
        [
            "held-out radiograph that is not predicted",
            f"{100 * quality.residual_before:.1f} %",
            f"{100 * quality.residual_after:.1f} %",
        ],
        [
            "held-out views lie beside their prediction, u, v [pixel]",
            f"{before_u:.2f}, {before_v:.2f}",
            f"{u:.2f}, {v:.2f}",
        ],
        ["expected mean error [pixel]", "", f"{quality.error:.2f}"],
    ]
    reasons = [str(reason) for reason in quality.reasons]
    return page.told(
        f"{quality.verdict} verdict",
        _WORDS.get(quality.verdict, quality.verdict),
        *([page.listing(reasons)] if reasons else []),
        page.folded("Numbers behind the verdict", page.table(["", "before", "after"], rows)),
        *filter(None, (_modes_table(quality), _regions_table(quality))),
    )


def _modes_table(quality: Quality) -> str:
    """Modes and how far the data determine them; empty if not known."""
    if not quality.modes:
        return ""
    rows = [
        [
            mode.name,
            f"{mode.amplitude:.3f}",
            f"{100 * mode.seen:.0f} %",
            f"{mode.sigma:.3f}" if math.isfinite(mode.sigma) else "not determined",
        ]
        for mode in quality.modes
    ]
    return page.folded(
        "Slow modes and movements of the sample: how far the data determine them",
        page.table(["mode", "found [pixel]", "part of an error seen", "uncertainty [pixel]"], rows),
        page.paragraph(
            "A known motion along each mode was added, and views were held out again: the part of "
            "it that they show. Sizes are root mean squares over the views; magnifications count "
            "as the displacement at half of the detector's half diagonal. The volume is as sharp "
            "with an error along a mode that is not seen."
        ),
    )


def _regions_table(quality: Quality) -> str:
    """Residual by part of the scan and the detector; empty if not known."""
    if not quality.regions:
        return ""
    count = len(quality.regions)
    rows = [
        [
            f"part {part + 1} of {count}" if not third else "",
            _ROWS[third],
            *(f"{100 * value:.1f} %" for value in values),
        ]
        for part, thirds in enumerate(quality.regions)
        for third, values in enumerate(thirds)
    ]
    return page.folded(
        "Residual by part of the scan and of the detector",
        page.table(["views", "", "first columns", "middle columns", "last columns"], rows),
        page.paragraph(
            "RMS of a held-out radiograph less its prediction, as a part of the radiograph's "
            "contrast in the band that is registered."
        ),
    )
