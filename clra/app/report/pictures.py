"""Slices and radiographs of a report, as self-contained images."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from clra.app.report.figures import drawn
from clra.app.scan_description import metric

Floats = NDArray[Any]


def images(pictures: Sequence[tuple[str, Floats, tuple[float, float]]], pixel_mm: float) -> str:
    """Draw grey pictures side by side, each with a scale bar.

    Parameters
    ----------
    pictures : sequence of (str, ndarray, (float, float))
        Title, 2-D image, and the values that are black and white.
    pixel_mm : float
        Edge of a pixel [mm].

    Returns
    -------
    str
        Data address of an image.
    """
    ratios = [image.shape[1] / image.shape[0] for _, image, _ in pictures]
    height = min(10.2 / sum(ratios), 7.0)

    def draw(figure: Figure) -> None:
        detectors = figure.subplots(1, len(pictures), width_ratios=ratios, squeeze=False)[0]
        for axes, (title, image, (black, white)) in zip(detectors, pictures, strict=True):
            axes.imshow(image, cmap="gray", vmin=black, vmax=white, interpolation="nearest")
            axes.set_title(title)
            axes.axis("off")
            _scale_bar(axes, image.shape, pixel_mm)

    return drawn(draw, (10.4, height + 0.35), "png")


def _scale_bar(axes: Any, shape: tuple[int, ...], pixel_mm: float) -> None:
    """Draw a bar of a round length, about a fifth of the picture's width."""
    rows, columns = shape
    wanted = 0.22 * columns * pixel_mm
    decade = 10.0 ** np.floor(np.log10(wanted))
    length = decade * max(step for step in (1.0, 2.0, 5.0) if step * decade <= wanted * 1.0001)
    left, bottom = 0.04 * columns, rows - 0.05 * min(rows, columns) - 1
    bar = length / pixel_mm
    outline = {"facecolor": "black", "alpha": 0.45, "edgecolor": "none", "pad": 2.0}
    axes.plot([left, left + bar], [bottom, bottom], color="white", lw=3, solid_capstyle="butt")
    axes.text(
        left,
        bottom - 0.025 * min(rows, columns),
        metric(float(length)).replace("um", "\u00b5m"),
        color="white",
        ha="left",
        va="bottom",
        fontsize=9,
        bbox=outline,
    )


def grey_limits(image: Floats) -> tuple[float, float]:
    """Values of which all but 1 % of the pixels at either end are inside.

    Parameters
    ----------
    image : ndarray
        What the grey scale has to suit.
    """
    low, high = np.percentile(image, (0.5, 99.5))
    return (float(low), float(high)) if high > low else (float(low) - 1, float(low) + 1)
