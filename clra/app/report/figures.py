"""The figures of a report, as self-contained images."""

import base64
import io
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import (
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
)
from numpy.typing import NDArray

from clra.methods.alignment.result import Iteration

Floats = NDArray[Any]

# Colours that also colour-blind eyes tell apart (Okabe and Ito), one a quantity throughout.
U, V, SCALE, WARN, INK, FAINT = "#0072B2", "#D55E00", "#00805A", "#B3006B", "#26323d", "#aab4be"

_STYLE: Any = {
    "font.size": 9.5,
    "font.family": "sans-serif",
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6eaee",
    "grid.linewidth": 0.8,
    "xtick.color": "#5b6875",
    "ytick.color": "#5b6875",
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "savefig.facecolor": "white",
    "svg.hashsalt": "clra",  # the same report twice is the same file
}


def drawn(
    draw: Callable[[Figure], None], size: tuple[float, float], kind: str, dpi: int = 150
) -> str:
    """Draw a figure and return it as the data address of an ``<img>``.

    Parameters
    ----------
    draw : callable
        Given the figure to draw on.
    size : (float, float)
        Width and height [inch].
    kind : {"svg", "png"}
        Format.
    dpi : int
        Pixels an inch, of what is not vectors.
    """
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        file = io.BytesIO()
        metadata = {"Date": None} if kind == "svg" else {"Software": None}
        figure.savefig(file, format=kind, dpi=dpi, metadata=metadata)
    mime = "image/svg+xml" if kind == "svg" else "image/png"
    return f"data:{mime};base64,{base64.b64encode(file.getvalue()).decode('ascii')}"


def convergence(history: Sequence[Iteration]) -> str:
    """Draw the updates, errors (where the truth is known) and residuals of each iteration.

    Parameters
    ----------
    history : sequence of Iteration
        Of the run.

    Returns
    -------
    str
        Data address of an image.
    """
    known = history[0].mae_u is not None

    def draw(figure: Figure) -> None:
        detectors = list(figure.subplots(1, 3 if known else 2, sharex=True))
        number = np.arange(1, len(history) + 1)
        _updates(detectors[0], history, number)
        if known:
            _errors(detectors[1], history, number)
        _residuals(detectors[-1], history, number)
        for axes in detectors:
            axes.set_xlabel("iteration")
            axes.set_title(axes.get_title("left"), pad=18)  # above the names of the levels
            axes.set_xlim(0.5, len(history) + 0.5)
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            _mark_levels(axes, [iteration.level for iteration in history])

    return drawn(draw, (10.4, 3.5), "svg")


def _logarithmic(axes: Any) -> None:
    """Label the steps 1, 2 and 5 of a decade as people write them."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _updates(axes: Any, history: Sequence[Iteration], number: Floats) -> None:
    axes.plot(number, [i.update_u_median for i in history], "o-", color=U, ms=4, label="u")
    axes.plot(number, [i.update_v_median for i in history], "o-", color=V, ms=4, label="v")
    axes.plot(number, [i.update_max for i in history], "o:", color=FAINT, ms=3, label="largest")
    axes.axhline(0.1, color=INK, lw=0.8, ls="--")
    axes.set(ylabel="|update of the shift| [pixel]", title="Update")
    _logarithmic(axes)
    _legend_inside(axes)


def _errors(axes: Any, history: Sequence[Iteration], number: Floats) -> None:
    series = (("u", U, "mae_u", "gauge_free_u"), ("v", V, "mae_v", "gauge_free_v"))
    for name, colour, raw, free in series:
        axes.plot(
            number,
            _values(history, raw),
            "o:",
            color=colour,
            ms=3.5,
            alpha=0.6,
            label=f"{name} raw",
        )
        axes.plot(
            number, _values(history, free), "o-", color=colour, ms=4, label=f"{name} gauge-free"
        )
    axes.axhline(0.25, color=INK, lw=0.8, ls="--")
    axes.set(ylabel="mean |error| [pixel]", title="Error against the truth")
    _logarithmic(axes)
    _legend_inside(axes)


def _values(history: Sequence[Iteration], name: str) -> list[float]:
    found = (getattr(iteration, name) for iteration in history)
    return [np.nan if value is None else float(value) for value in found]


def _residuals(axes: Any, history: Sequence[Iteration], number: Floats) -> None:
    levels = [iteration.level for iteration in history]
    for level in dict.fromkeys(levels):
        chosen = [k for k, name in enumerate(levels) if name == level]
        axes.plot(number[chosen], [history[k].residual for k in chosen], "o-", color=SCALE, ms=4)
    axes.set_ylim(bottom=0)
    axes.set(ylabel="RMS after registration [attenuation]", title="Residual")


def _legend_inside(axes: Any) -> None:
    axes.legend(loc="best", fontsize=8, handlelength=1.6, labelspacing=0.25)


def _mark_levels(axes: Any, levels: Sequence[str]) -> None:
    """Shade every other level and write its name at the top."""
    start = 0
    for index, level in enumerate(dict.fromkeys(levels)):
        count = levels.count(level)
        if index % 2:
            axes.axvspan(start + 0.5, start + count + 0.5, color="#f2f5f8", zorder=0)
        axes.text(
            start + 0.5 + count / 2,
            1.0,
            level,
            transform=axes.get_xaxis_transform(),
            ha="center",
            va="bottom",
            fontsize=8,
            color="#5b6875",
        )
        start += count
