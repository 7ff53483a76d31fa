"""What a report says first: whether the alignment is to be trusted, and why."""

from clra.app.report import page
from clra.methods.alignment.result import SupportsAsDict
from clra.methods.assessment.quality import Quality

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
    )
