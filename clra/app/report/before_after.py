"""Sections of a report that are pictures: slices and radiographs before and after alignment."""

from typing import TYPE_CHECKING

import numpy as np

from clra.app.report import page, pictures

if TYPE_CHECKING:
    from clra.app.report.comparison import Comparison, MatchedView

_WITHOUT_SCAN = (
    "Slices and re-projections need the scan: clra report MOTION.h5 --scan SCAN -o report.html"
)


def before_and_after(comparison: "Comparison | None") -> list[str]:
    """Return the sections' HTML; without the scan, one that says what it would take.

    Parameters
    ----------
    comparison : Comparison or None
        Slices and radiographs.
    """
    if comparison is None:
        return [page.section("Before and after", page.paragraph(_WITHOUT_SCAN))]
    flat, tall, detail = comparison.horizontal, comparison.vertical, comparison.detail
    limits = pictures.grey_limits(flat.after)
    slices = page.section(
        "Before and after",
        page.figure(
            pictures.images(
                [("Across the axis, before", flat.before, limits), ("After", flat.after, limits)],
                comparison.voxel_mm,
            ),
            f"Middle slice across the rotation axis, reconstructed by {comparison.method}. Mean "
            f"squared gradient after alignment: "
            f"{flat.sharpening:.2f} times that before (noise counts as well as edges).",
            "Horizontal slices before and after alignment",
        ),
        page.figure(
            pictures.images(
                [("Detail, before", detail.before, limits), ("After", detail.after, limits)],
                comparison.voxel_mm,
            ),
            "The part of that slice with the most structure, enlarged.",
            "Detail before and after alignment",
        ),
        page.figure(
            pictures.images(
                [("Along the axis, before", tall.before, limits), ("After", tall.after, limits)],
                comparison.voxel_mm,
            ),
            f"Middle slice along the rotation axis. All slices share one grey scale, "
            f"{limits[0]:.3g} to {limits[1]:.3g} per mm. Mean squared gradient: "
            f"{tall.sharpening:.2f} times that before.",
            "Vertical slices before and after alignment",
        ),
    )
    shown = [_match(match, comparison.pixel_mm) for match in comparison.matches]
    return [slices, page.section("Measured radiographs and their re-projections", *shown)]


def _match(match: "MatchedView", pixel_mm: float) -> str:
    before, after = match.difference.before, match.difference.after
    reach = max(float(np.percentile(np.abs(before), 99.5)), 1e-6)
    grey = pictures.grey_limits(match.measured)
    drawn = pictures.images(
        [
            ("Measured", match.measured, grey),
            ("Re-projected, after", match.reprojected, grey),
            ("Difference, before", before, (-reach, reach)),
            ("Difference, after", after, (-reach, reach)),
        ],
        pixel_mm,
    )
    rms = [float(np.sqrt(np.mean(image**2))) for image in (before, after)]
    return page.figure(
        drawn,
        f"View {match.view} ({match.why}). Differences are measured minus re-projected, slow "
        f"background removed, from -{reach:.2g} to {reach:.2g}; RMS {rms[0]:.3g} before, "
        f"{rms[1]:.3g} after. Scale bars hold at the sample.",
        f"Radiograph, re-projection and differences of view {match.view}",
    )
