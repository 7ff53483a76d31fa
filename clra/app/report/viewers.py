"""Pictures before and after alignment, one over the other, and grey pictures side by side."""

import base64
import io
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow  # which matplotlib brings

from clra.app.report.page import embedded
from clra.app.scan_description import metric

if TYPE_CHECKING:
    from clra.app.report.comparison import Pair

Grey = tuple[float, float]

# Pixels above which a picture is stored as JPEG: what PNG saves of noise is nothing.
_LOSSLESS = 64 * 64
_JPEG_QUALITY = 85


def picture(image: NDArray[Any], limits: Grey) -> str:
    """Return a grey picture as a data address.

    Parameters
    ----------
    image : ndarray, (rows, columns)
        Values.
    limits : (float, float)
        Those that are black and white.
    """
    black, white = limits
    scaled = np.clip((image.astype(np.float64) - black) / (white - black), 0, 1)
    small = image.size <= _LOSSLESS
    file = io.BytesIO()
    drawn = Pillow.fromarray(np.rint(255 * scaled).astype(np.uint8))
    drawn.save(file, "PNG" if small else "JPEG", quality=_JPEG_QUALITY)
    encoded = base64.b64encode(file.getvalue()).decode("ascii")
    return f"data:image/{'png' if small else 'jpeg'};base64,{encoded}"


def viewer(pair: "Pair", limits: Grey, pixel_mm: float, caption: str, alt: str) -> str:
    """Return a picture before over the same after, with a slider between them.

    Parameters
    ----------
    pair : Pair
        Without and with the motion corrected.
    limits : (float, float)
        Values that are black and white.
    pixel_mm : float
        Edge of a pixel [mm].
    caption, alt : str
        Of the figure.
    """
    return _figure([("", pair)], limits, pixel_mm, caption, alt)


def scroller(
    slices: Sequence[tuple[float, "Pair"]], limits: Grey, pixel_mm: float, caption: str, alt: str
) -> str:
    """Return slices at several heights, one at a time, each before over after.

    Parameters
    ----------
    slices : sequence of (float, Pair)
        Height [mm] and slice.
    limits, pixel_mm, caption, alt
        As :func:`viewer` takes them.
    """
    named = [(f"z = {height:+.3g} mm", pair) for height, pair in slices]
    return _figure(named, limits, pixel_mm, caption, alt)


def _figure(
    named: Sequence[tuple[str, "Pair"]], limits: Grey, pixel_mm: float, caption: str, alt: str
) -> str:
    shown = [
        {"place": name, "before": picture(p.before, limits), "after": picture(p.after, limits)}
        for name, p in named
    ]
    middle = len(shown) // 2
    length = _bar_length(named[0][1].after.shape[1] * pixel_mm)
    part = 100 * length / (named[0][1].after.shape[1] * pixel_mm)
    scale = metric(length).replace("um", "\u00b5m")
    controls = (
        '<label class="control"><span>before | after</span>'
        '<input class="split" type="range" min="0" max="100" value="50"></label>'
    )
    if len(shown) > 1:
        controls += (
            '<label class="control"><span>height</span><input class="slice" type="range" min="0" '
            f'max="{len(shown) - 1}" value="{middle}"><output></output></label>' + embedded(shown)
        )
    return (
        '<figure class="viewer"><div class="stage">'
        f'<img class="after" src="{shown[middle]["after"]}" alt="{escape(alt)}, after">'
        f'<img class="before" src="{shown[middle]["before"]}" alt="{escape(alt)}, before">'
        '<div class="edge"></div><span class="tag first">before</span>'
        f'<span class="tag last">after</span><div class="scale" style="width:{part:.2f}%">'
        f"{escape(scale)}</div></div>{controls}"
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def tiles(pictures: Sequence[tuple[str, NDArray[Any], Grey]], caption: str) -> str:
    """Return grey pictures side by side, as far as there is room.

    Parameters
    ----------
    pictures : sequence of (str, ndarray, (float, float))
        Title, 2-D image, and the values that are black and white.
    caption : str
        Of the figure.
    """
    shown = "".join(
        f'<div class="tile"><span>{escape(title)}</span>'
        f'<img src="{picture(image, limits)}" alt="{escape(title)}"></div>'
        for title, image, limits in pictures
    )
    return (
        f'<figure><div class="tiles">{shown}</div>'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def _bar_length(width_mm: float) -> float:
    """Return a round length, about a fifth of the picture's width [mm]."""
    wanted = 0.22 * width_mm
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(decade * max(step for step in (1, 2, 5) if step * decade <= wanted * 1.0001))


def grey_limits(image: NDArray[Any]) -> Grey:
    """Values of which all but 1 % of the pixels at either end are inside.

    Parameters
    ----------
    image : ndarray
        What the grey scale has to suit.
    """
    low, high = np.percentile(image, (0.5, 99.5))
    return (float(low), float(high)) if high > low else (float(low) - 1, float(low) + 1)
