"""The curves of a report: corrections, errors and confidence of each view."""

from collections.abc import Sequence

import numpy as np

from clra.app.report.charts import Curve, captioned, chart
from clra.app.report.figures import FAINT, SCALE, WARN, U, V
from clra.app.report.summary import Errors, Floats
from clra.model.motion import Motion
from clra.model.rigid.rigid_motion import RigidMotion

_RETURNS = " Errors of the stage come mirrored about the middle, where it turns back."


def corrections(motion: Motion, angles: Floats | None, *, returns: bool = False) -> str:
    """Shift and magnification that undo the motion, as in the paper's Figures 5 and 7.

    Parameters
    ----------
    motion : Motion
        As estimated; its inverse is drawn.
    angles : ndarray, (views,), optional
        Of the views [degree].
    returns : bool
        Whether the stage came back after half of the views.
    """
    undo = motion.inverse()
    shift = [Curve("u (columns)", U, undo.shift_u), Curve("v (rows)", V, undo.shift_v)]
    scale = [Curve("magnification", SCALE, undo.magnification)]
    flat = (0.999, 1.001) if np.ptp(undo.magnification) < 1e-6 else None
    return captioned(
        [
            chart("Shift", "correction [pixel]", shift, angles=angles),
            chart("Magnification", "correction", scale, angles=angles, limits=flat),
        ],
        "Shift and magnification that bring each measured radiograph back to where the ideal "
        "geometry puts it: the inverse of the estimated motion. Positive u is toward higher "
        "columns, positive v toward higher rows; in pixels of the full detector."
        + (_RETURNS if returns else ""),
    )


def rigid_motion(motion: RigidMotion, angles: Floats | None) -> str:
    """Draw translations and rotations that the sample made.

    Parameters
    ----------
    motion : RigidMotion
        As estimated.
    angles : ndarray, (views,), optional
        Of the views [degree].
    """
    axes = (("u", U), ("v", V), ("beam", SCALE))
    um, degrees = 1e3 * motion.translation, np.degrees(motion.rotation)
    near, per_u = np.median(motion.optics[:, :2], axis=0)
    return captioned(
        [
            chart(
                title,
                label,
                [Curve(n, c, v) for (n, c), v in zip(axes, table.T, strict=True)],
                angles=angles,
            )
            for title, label, table in (
                ("Translation", "along the axis [\u00b5m at the sample]", um),
                ("Rotation", "about the axis [degree]", degrees),
            )
        ],
        "How the sample moved and turned, in the axes of each view: u toward higher columns, v "
        "toward higher rows, the beam toward the detector. At the depth of the rotation axis one "
        f"pixel of the detector is {1e3 * near / per_u:.3g} \u00b5m of the sample.",
    )


def error_of_views(errors: Errors, angles: Floats | None) -> str:
    """Error of the estimated shift of each view.

    Parameters
    ----------
    errors : Errors
        Against the known motion.
    angles : ndarray, (views,), optional
        Of the views [degree].
    """
    charts = [
        chart(
            f"Error of {name}",
            "estimate - truth [pixel]",
            [
                Curve("raw", FAINT, errors.raw[:, k]),
                Curve("gauge-free", colour, errors.gauge_free[:, k]),
            ],
            angles=angles,
            band=(-0.5, 0.5),
        )
        for k, name, colour in ((0, "u (columns)", U), (1, "v (rows)", V))
    ]
    return captioned(
        charts,
        "Estimated minus true shift (the scan is a simulation that knows its motion). Raw: as it "
        "is. Gauge-free: without what a movement of the sample as a whole explains, which changes "
        "where the volume lies but not how sharp it is. Shaded: half a pixel, below which motion "
        "leaves no visible trace.",
    )


def confidence(values: Floats, flagged: Sequence[int], angles: Floats | None) -> str:
    """Confidence of each view, the flagged ones marked.

    Parameters
    ----------
    values : ndarray, (views,)
        0 to 1.
    flagged : sequence of int
        Views that are rejected.
    angles : ndarray, (views,), optional
        Of the views [degree].
    """
    rejected = np.isin(np.arange(len(values)), np.asarray(flagged, dtype=int))
    curves = [Curve("valid", U, np.where(rejected, np.nan, values))]
    if rejected.any():
        curves.append(Curve("flagged", WARN, np.where(rejected, values, np.nan), cross=True))
    low = float(values[~rejected].min()) if (~rejected).any() else 0.0
    floor = -0.05 if rejected.any() else max(0.0, low - 0.1)
    return captioned(
        [chart("Confidence", "confidence", curves, angles=angles, limits=(floor, 1.02))],
        "Correlation of each measured radiograph with its re-projection in the band of frequencies "
        "that is registered. A flagged view fits far worse than the others; it was given the "
        "motion of its neighbours.",
    )
