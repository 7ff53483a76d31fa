"""Sections of a report that are pictures: slices and radiographs before and after alignment."""

from typing import TYPE_CHECKING

import numpy as np

from clra.app.report import page
from clra.app.report.viewers import grey_limits, scroller, tiles, viewer

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
    limits, size = grey_limits(flat.after), comparison.voxel_mm
    parts = [
        viewer(
            flat,
            limits,
            size,
            f"Middle slice across the rotation axis, reconstructed by {comparison.method}. Mean "
            f"squared gradient after alignment: {flat.sharpening:.2f} times that before (noise "
            "counts as well as edges). Drag the edge between before and after.",
            "Middle slice across the axis",
        )
    ]
    if len(comparison.slices) > 1:
        middle = comparison.slices[len(comparison.slices) // 2][1]
        parts.append(
            scroller(
                comparison.slices,
                grey_limits(middle.after),
                comparison.pixel_mm,
                "Slices at several heights, by ramp-filtered back-projection of binned "
                "radiographs.",
                "Slice across the axis",
            )
        )
    parts += [
        viewer(
            detail,
            limits,
            size,
            "The part of the middle slice with the most structure, enlarged.",
            "Detail of the middle slice",
        ),
        viewer(
            tall,
            limits,
            size,
            f"Middle slice along the rotation axis. It shares its grey scale, {limits[0]:.3g} to "
            f"{limits[1]:.3g} per mm, with the middle slice across. Mean squared gradient: "
            f"{tall.sharpening:.2f} times that before.",
            "Middle slice along the axis",
        ),
    ]
    shown = [_match(match) for match in comparison.matches]
    return [
        page.section("Before and after", page.pairs(parts)),
        page.section("Measured radiographs and their re-projections", *shown),
    ]


def _match(match: "MatchedView") -> str:
    before, after = match.difference.before, match.difference.after
    reach = max(float(np.percentile(np.abs(before), 99.5)), 1e-6)
    grey = grey_limits(match.measured)
    rms = [float(np.sqrt(np.mean(image**2))) for image in (before, after)]
    return tiles(
        [
            ("Measured", match.measured, grey),
            ("Re-projected, after", match.reprojected, grey),
            ("Difference, before", before, (-reach, reach)),
            ("Difference, after", after, (-reach, reach)),
        ],
        f"View {match.view} ({match.why}). Differences are measured minus re-projected, slow "
        f"background removed, from -{reach:.2g} to {reach:.2g}; RMS {rms[0]:.3g} before, "
        f"{rms[1]:.3g} after.",
    )
