"""What radiographs alone tell against a scan: truncation, a fading beam, clipped pixels."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from clra.errors import InputError
from clra.findings import Finding
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import axis_ranges
from clra.model.sampling.angular_coverage import covered, fan_angle
from clra.model.scan import Scan

Floats = NDArray[np.float64]

# Views that are looked at, at most, and of these the ones of which every pixel is.
_VIEWS, _CLOSELY = 48, 6
# Pixels that the shorter side has in what is looked at coarsely, at least, and those, of the
# detector's, that its brightest part is a mean of, along each side.
_FINE, _SMOOTH = 512, 9
# Transmission that only counts have; phase contrast and wrong flats stay below 3.
_COUNTS = 10.0
# Part of the largest line integral that may be left in the outermost columns. Scatter and an uneven
# open beam leave one or two per cent.
_AT_BORDER = 0.03
# Line integral by which the brightest part of the radiographs may change during a scan, and the
# rank correlation with time from which on it is a trend.
_FADED, _TREND = 0.03, 0.95
# Part of the pixels that may all show the same largest value: dead ones are fewer.
_CLIPPED = 0.005
# Part of the pixels that may show the same smallest value, where others are noisy.
_SATURATED = 0.05
# Part of the columns by which the axis may lie aside before half of the sample is out of sight.
_ASIDE = 0.1
# Part of the detector's height by which views have to rise for ends along z to be looked at, how
# many views there are at each, and the part of the largest line integral that may be left in their
# outermost rows.
_LIFT, _END_VIEWS, _AT_END = 0.1, 3, 0.1
# Views below which none can be held out without leaving a gap.
_FEW = 40


def refuse_counts(scan: Scan) -> None:
    """Raise if what is called transmission holds counts.

    Parameters
    ----------
    scan : Scan
        One of its radiographs is read.

    Raises
    ------
    InputError
        If half of the pixels are more than ten times as bright as the open beam.
    """
    if scan.kind != "transmission":
        return
    middle = scan.views // 2
    typical = float(np.nanmedian(np.asarray(scan.projections[middle : middle + 1])))
    if typical > _COUNTS:
        raise InputError(
            f"{scan.name}: kind='transmission': found a median of {typical:.4g}, expected I / I0, "
            "at most about 1: are these counts? Divide by the flat field first (clra import)"
        )


def radiograph_findings(scan: Scan) -> list[Finding]:
    """Look at some of the radiographs, and at the geometry, for what spoils alignments.

    Parameters
    ----------
    scan : Scan
        A few dozen of its radiographs are read.

    Returns
    -------
    list of Finding
        Empty if all is well.
    """
    views = np.unique(np.linspace(0, scan.views - 1, _VIEWS).astype(int))
    looks = np.array([_look(scan.read(int(view), int(view) + 1)[0]) for view in views])
    spread = looks[:, 0]
    # A blank one, or one of something else, says nothing.
    odd = np.abs(np.log((spread + 1e-12) / np.median(spread + 1e-12))) > math.log(2)
    if odd.all():
        return []
    views, (bright, largest, *borders) = views[~odd], looks[~odd, 1:].T
    most = float(largest.max())
    closely = views[:: max(1, len(views) // _CLOSELY)]
    images = [scan.read(int(view), int(view) + 1)[0] for view in closely]
    found = [_fading(bright, views), *_clipped(images)]
    columns = np.stack(borders, axis=1) - bright[:, None]
    found.append(_truncation(columns, most, scan.geometry))
    found += [_axial(scan, most), _arc(scan.geometry), _few(scan.geometry)]
    return [finding for finding in found if finding is not None]


def _look(image: NDArray[np.float32]) -> tuple[float, ...]:
    """Spread of a radiograph, its brightest part, its largest value, and its left and right."""
    step = max(1, min(image.shape) // _FINE)
    rows, columns = (n // step for n in image.shape)
    blocks = image[: rows * step, : columns * step].reshape(rows, step, columns, step)
    small = blocks.mean(axis=(1, 3))
    # Means over some pixels: the brightest single ones are noise.
    bright = np.quantile(uniform_filter(small, max(1, _SMOOTH // step)), 0.05)
    left, right = _border(image[:, [0, -1]])
    return float(image.std()), float(bright), float(np.quantile(small, 0.999)), left, right


def _border(sides: NDArray[np.float32]) -> Floats:
    """Mean of the outermost columns, without their ends."""
    rows = len(sides)
    return np.asarray(sides[rows // 8 : rows - rows // 8].mean(axis=0), np.float64)


def _fading(bright: Floats, views: NDArray[np.int_]) -> Finding | None:
    if len(views) < 8:
        return None
    ranks = np.argsort(np.argsort(bright))
    trend = float(np.corrcoef(ranks, np.arange(len(ranks)))[0, 1])
    change = float(np.median(bright[-3:]) - np.median(bright[:3]))
    if abs(change) < _FADED or abs(trend) < _TREND:
        return None
    percent = 100 * (math.exp(-change) - 1)
    return Finding(
        "beam-decay",
        f"the brightest part of the radiographs changes steadily by {percent:+.0f} % from the "
        "first view to the last",
        "the beam is not what the flats show: take flats before and after the scan and import "
        "with both, or divide each radiograph by its background",
        measured={"change": change},
    )


def _clipped(images: list[NDArray[np.float32]]) -> list[Finding | None]:
    stack = np.stack(images)
    highest, lowest = float(stack.max()), float(stack.min())
    reach = 1e-5 * max(abs(highest), abs(lowest))
    dark, bright = np.mean(stack >= highest - reach), np.mean(stack <= lowest + reach)
    advice = "use another exposure or filter; alignment follows edges that are not the sample's"
    found: list[Finding | None] = []
    # Blocks of one value: single pixels that are stuck are dealt with elsewhere.
    if dark > _CLIPPED and _in_blocks(stack >= highest - reach):
        found.append(
            Finding(
                "clipped-detector",
                f"{dark:.1%} of the pixels have the same largest line integral, {highest:.3g}: "
                "darker parts of the sample are cut off",
                advice,
                measured={"part": float(dark), "value": highest},
            )
        )
    # Air is exactly 0 in simulations only.
    if lowest != 0 and bright > _SATURATED and _noisy(stack[stack.shape[0] // 2], lowest + reach):
        found.append(
            Finding(
                "clipped-detector",
                f"{bright:.1%} of the pixels have the same smallest line integral, {lowest:.3g}, "
                "without noise: the detector is saturated there",
                advice,
                measured={"part": float(bright), "value": lowest},
            )
        )
    return found


def _in_blocks(mask: NDArray[np.bool_]) -> bool:
    """Whether most of the pixels set have neighbours at both sides and change from view to view."""
    inside = mask[:, :, 1:-1] & mask[:, :, :-2] & mask[:, :, 2:]
    always = mask.all(axis=0).sum() / max(1, mask.any(axis=0).sum())
    return bool(inside.sum() > 0.3 * mask.sum() and (len(mask) < 2 or always < 0.5))


def _noisy(image: NDArray[np.float32], lowest: float) -> bool:
    """Whether pixels that are not clipped are noisy: fourth differences alternate in sign."""
    clear, values = image > lowest, image.astype(np.float64)
    for _ in range(4):
        values, clear = np.diff(values, axis=1), clear[:, 1:] & clear[:, :-1]
    both = clear[:, 1:] & clear[:, :-1]
    # Rounding alternates, too.
    if both.sum() < 100 or np.median(np.abs(values[clear])) < 2e-3 * float(image.max()):
        return False
    # The edges of the sample are few: signs, so that large products do not count more.
    signs = np.sign(values[:, 1:][both]) * np.sign(values[:, :-1][both])
    return bool(signs.mean() < -0.3)  # -0.6 for white noise, positive for smooth images


def _truncation(columns: Floats, most: float, geometry: ConeBeamGeometry) -> Finding | None:
    """Of line integrals in the left and right columns above the background's."""
    typical = np.median(columns, axis=0)
    # Views that moved far may well show the sample at a border.
    cut = float(np.median(columns.max(axis=1)))
    aside = float(np.median(geometry.principal[:, 0])) - (geometry.columns - 1) / 2
    if abs(aside) > _ASIDE * geometry.columns:
        left, right = typical > _AT_BORDER * most
        near_left = aside < 0
        if (left and not right and near_left) or (right and not left and not near_left):
            return Finding(
                "half-fan",
                f"the axis is seen {abs(aside):.0f} columns beside the detector's middle, and the "
                "sample is cut off at that side: a scan of half the fan",
                "the sample is taken to reach as far at the other side; check the axis column "
                "(--centre-offset) if it does not",
                measured={"aside": aside},
            )
    if not cut > _AT_BORDER * most:
        return None
    return Finding(
        "truncation",
        f"the sample reaches beyond the sides of the detector (line integrals of {cut:.3g} in its "
        f"outermost columns, {most:.3g} inside)",
        "shifts along u are less certain; intensities are too high, most towards the border of "
        "the field of view",
        measured={"border": cut, "largest": most},
    )


def _axial(scan: Scan, most: float) -> Finding | None:
    """Of the rows that look past the ends of a scan along z."""
    geometry = scan.geometry
    low, high = axis_ranges(geometry)
    if np.ptp(low) < _LIFT * float(np.median(high - low)):
        return None  # a long sample does no harm where all views see the same part of it
    ends = {"bottom": (np.argsort(low), -1.0), "top": (np.argsort(-high), 1.0)}
    seen = {}
    for name, (order, outwards) in ends.items():
        rows = []
        for view in order[:_END_VIEWS]:
            image = scan.read(int(view), int(view) + 1)[0]
            smooth = uniform_filter(image, 5)
            strip = max(2, len(image) // 24)
            outermost = smooth[-strip:] if geometry.v[view, 2] * outwards > 0 else smooth[:strip]
            rows.append(float(np.quantile(outermost, 0.99) - np.quantile(smooth, 0.05)))
        seen[name] = float(np.median(rows))
    cut = {name: value for name, value in seen.items() if value > _AT_END * most}
    if not cut:
        return None
    return Finding(
        "axial-truncation",
        f"the sample reaches beyond the {' and the '.join(cut)} of what the scan covers (line "
        f"integrals of {max(cut.values()):.3g} in the outermost rows of views there, {most:.3g} "
        "elsewhere)",
        "motions of these views and the slices there are less certain: scan beyond the sample's "
        "ends, or leave these slices out",
        "info",
        {**cut, "largest": most},
    )


def _arc(geometry: ConeBeamGeometry) -> Finding | None:
    angle = covered(geometry)
    fan = fan_angle(geometry)
    if angle >= math.pi + fan or geometry.views < 2:
        return None
    return Finding(
        "limited-arc",
        f"views cover {math.degrees(angle):.0f} degrees, less than half a turn and the fan, "
        f"{math.degrees(math.pi + fan):.0f}",
        "slow motions are hardly determined: errors may be several times what they seem",
        "info",
        {"degrees": math.degrees(angle)},
    )


def _few(geometry: ConeBeamGeometry) -> Finding | None:
    if geometry.views >= _FEW:
        return None
    return Finding(
        "few-views",
        f"{geometry.views} views are few: each is seen from where no other one is",
        "take more views, or look at the slices before and after",
        "info",
        {"views": geometry.views},
    )
