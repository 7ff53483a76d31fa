"""Curves of a value per view that the reader can zoom, by view number or angle."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.app.report.page import embedded, pairs

Floats = NDArray[Any]


@dataclass(frozen=True)
class Curve:
    """Points of one colour.

    Attributes
    ----------
    name, colour : str
        In the legend.
    values : ndarray, (views,)
        NaN where there is no point.
    cross : bool
        Whether points are crosses.
    """

    name: str
    colour: str
    values: Floats
    cross: bool = False


def chart(
    title: str,
    label: str,
    curves: Sequence[Curve],
    *,
    angles: Floats | None = None,
    band: tuple[float, float] | None = None,
    limits: tuple[float, float] | None = None,
) -> str:
    """Return a chart; page.js draws it.

    Parameters
    ----------
    title, label : str
        Above it, and along its vertical axis.
    curves : sequence of Curve
        Of as many views each.
    angles : ndarray, (views,), optional
        Of the views [degree], for the other horizontal axis.
    band : (float, float), optional
        Values to be shaded.
    limits : (float, float), optional
        Of the vertical axis until it is zoomed.
    """
    views = len(curves[0].values)
    axes = {"view": {"label": "view", "values": list(range(views))}}
    if angles is not None:
        axes["angle"] = {
            "label": "angle [degree]",
            "values": [round(float(a), 4) for a in angles],
        }
    data = {
        "axes": axes,
        "label": label,
        "series": [
            {
                "name": c.name,
                "colour": c.colour,
                "cross": c.cross,
                "values": [float(f"{v:.6g}") if np.isfinite(v) else None for v in c.values],
            }
            for c in curves
        ],
        "band": band,
        "limits": limits,
    }
    keys = "".join(
        f'<span><span class="key" style="background:{c.colour}"></span>{escape(c.name)}</span>'
        for c in curves
    )
    buttons = "".join(
        f'<button type="button" data-axis="{name}" aria-pressed="{str(not k).lower()}">{name}'
        "</button>"
        for k, name in enumerate(axes)
    )
    return (
        f'<div class="chart"><div class="bar-of-tools"><span class="title">{escape(title)}</span>'
        f"{keys}{buttons if len(axes) > 1 else ''}"
        '<button type="button" class="reset" title="or double-click">whole range</button></div>'
        "<noscript>The curves need JavaScript.</noscript>"
        f'<canvas aria-label="{escape(title)}"></canvas>'
        f'<div class="bar-of-tools"><output>&nbsp;</output></div>{embedded(data)}</div>'
    )


def captioned(charts: Sequence[str], caption: str) -> str:
    """Return charts side by side, as far as there is room, with one caption."""
    hint = " Drag across a stretch to zoom in; double-click for the whole range."
    return f"<figure>{pairs(charts)}<figcaption>{escape(caption + hint)}</figcaption></figure>"
