"""Alignment schedules: how often to iterate at which resolution, and when to stop."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from clra.errors import InputError

_LEVELS = {"FR": 1, "HR": 2, "QR": 4, "ER": 8, "SR": 16}
_STAGE = re.compile(r"([1-9][0-9]?)([FHQES]R)")
_EXPECTED = (
    "expected 'auto' or stages such as '1QR-1HR' or '4FR': a number of iterations (1 to 99) at "
    "full (FR), half (HR), quarter (QR), eighth (ER) or sixteenth (SR) resolution, joined by '-'"
)

# "auto" begins at an eighth of the resolution where the detector's shorter side keeps this many
# pixels. A fixed number of iterations does: they cost next to nothing there, and slow modes
# (magnification and v that drift together along the scan) need them. By the paper's count, an
# eighth 1/64 and a quarter 1/16 of an iteration, two more at the one and one at the other for what
# displaces their re-projections, it is 0.625, as 2QR-2HR, where one at half the resolution will do.
_SMALLEST = 48
_LARGE = (8, 6), (4, 3)

# Iterations after which "until converged" gives up, at a quarter and at half of the resolution.
# Three at half: spheres need one, a sandstone whose grains are 2 to 4 pixels wide at a quarter two
# or three.
_LIMIT, _LIMIT_AT_HALF = 20, 3

# Median and largest shift update that count as converged [pixel of the full-resolution detector]:
# the paper's best results are 0.25 pixel from the truth, so a tenth more changes nothing visible.
_MEDIAN, _LARGEST = 0.1, 0.5
# The median for "auto", at a quarter and at half of the resolution: slow modes go on for long at a
# few hundredths of a pixel an iteration. At a quarter iterations cost little, and a real scan of
# 135 x 160, half a turn of a parallel beam, ends at 0.3 pixel in u instead of 0.6. At half the
# sandstone of above is still moved by 0.09 in the first, and spheres by 0.02.
_SLOW, _SLOW_AT_HALF = 0.02, 0.05
# What slow modes may have left to go where they are waited for, extrapolated [pixel]; the most
# iterations at half of the resolution where that costs little; and the fewest pixels of a side that
# registration takes. Half a turn of a parallel beam takes 5, a circle 2 or 3.
_LEFT, _LEFT_LARGE, _LIMIT_SMALL, _REGISTERS = 0.003, 0.02, 6, 16
# Iterations of small detectors at an eighth, as far as there is one.
_FIRST = 4


@dataclass(frozen=True)
class Stage:
    """Some iterations at one resolution.

    Parameters
    ----------
    level : int
        Binning factor: 1, 2, 4, 8 or 16.
    iterations : int or None
        How many; None to iterate until `converged`.
    limit : int
        The most iterations.
    tolerance : float
        As for `converged`.
    slow : float
        Root mean square that slow modes may have left to go [pixel].
    """

    level: int
    iterations: int | None
    limit: int
    tolerance: float = _MEDIAN
    slow: float = math.inf

    def __str__(self) -> str:
        """Return the stage as it is written in a schedule."""
        return f"{'' if self.iterations is None else self.iterations}{level_name(self.level)}"


def coarse_level(shape: tuple[int, int], columns: int, least: int = 32) -> int:
    """Return the binning factor of a detector of which no more than some columns are looked at.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    columns : int
        That are left at most.
    least : int
        Rows and columns below which it is not halved any more.
    """
    level = 1
    while shape[1] > columns * level and min(shape) >= least * level:
        level *= 2
    return level


def level_name(level: int) -> str:
    """Return "FR", "HR", "QR", "ER" or "SR" for the binning factors 1, 2, 4, 8 and 16."""
    for name, factor in _LEVELS.items():
        if factor == level:
            return name
    raise InputError(f"level: found {level}, expected one of {tuple(_LEVELS.values())}")


def level_factor(name: str) -> int:
    """Return the binning factor of "FR", "HR", "QR", "ER" or "SR"."""
    return _LEVELS[name]


def parse_levels(text: str) -> tuple[int, ...]:
    """Read the levels of a multigrid cycle.

    Parameters
    ----------
    text : str
        Resolutions that double up to full, such as "QR-HR-FR" or "ER-QR-HR-FR"; or "auto": the
        former.

    Returns
    -------
    tuple of int
        Binning factors, ending with 1.

    Raises
    ------
    InputError
        If the text is no such cycle.
    """
    if text == "auto":
        text = "QR-HR-FR"
    factors = tuple(_LEVELS.get(name, 0) for name in str(text).upper().split("-"))
    if factors[-1] != 1 or any(a != 2 * b for a, b in pairwise(factors)):
        raise InputError(
            f"levels: found {text!r}, expected resolutions that double up to full, such as "
            "'QR-HR-FR' or 'ER-QR-HR-FR'"
        )
    return factors


def parse_schedule(text: str, shape: tuple[int, int] = (0, 0)) -> tuple[Stage, ...]:
    """Read a schedule.

    Parameters
    ----------
    text : str
        Stages in order, such as "1QR-1HR", "2ER-2QR-1HR" or "4FR"; or "auto":
        "6ER-3QR", then half of the resolution until converged (at most 3 iterations) for large
        detectors; for others "4ER", a quarter until converged (at most 20), then half (at most 6),
        without levels that are too small to be registered.
    shape : (int, int)
        Rows and columns of the detector, for "auto": large is from 384 on.

    Returns
    -------
    tuple of Stage
        At least one.

    Raises
    ------
    InputError
        If the text is no schedule; the message says what one looks like.
    """
    if text == "auto":
        smallest = min(shape) or 8 * _REGISTERS
        half = Stage(_LEVELS["HR"], None, _LIMIT_AT_HALF, _SLOW_AT_HALF, _LEFT_LARGE)
        if smallest // 8 >= _SMALLEST:
            return *(Stage(level, count, count) for level, count in _LARGE), half
        stages = (
            Stage(_LEVELS["ER"], _FIRST, _FIRST),
            Stage(_LEVELS["QR"], None, _LIMIT, _SLOW, _LEFT),
            replace(half, limit=_LIMIT_SMALL, slow=_LEFT),
        )
        fits = tuple(stage for stage in stages if smallest // stage.level >= _REGISTERS)
        return fits or (Stage(_LEVELS["FR"], None, _LIMIT, _SLOW, _LEFT),)
    written = []
    for part in str(text).upper().split("-"):
        match = _STAGE.fullmatch(part)
        if match is None:
            raise InputError(f"schedule: found {text!r}, {_EXPECTED}")
        written.append(Stage(_LEVELS[match[2]], int(match[1]), int(match[1])))
    return tuple(written)


def update_size(update_u: ArrayLike, update_v: ArrayLike) -> tuple[float, float]:
    """Return the median absolute shift update, in u or v, whichever is larger, and the largest.

    Parameters
    ----------
    update_u, update_v : array_like, (views,)
        Changes of the shifts in an iteration, signed or not [pixel of the full-resolution
        detector].
    """
    size = np.abs(np.stack([np.ravel(update_u), np.ravel(update_v)]))
    return float(np.median(size, axis=1).max()), float(np.max(size))


def converged(
    update_u: ArrayLike,
    update_v: ArrayLike,
    previous_median: float | None = None,
    tolerance: float = _MEDIAN,
) -> bool:
    """Tell whether further iterations at this resolution are worth nothing.

    Parameters
    ----------
    update_u, update_v : array_like, (views,)
        Changes of the shifts in the last iteration, signed or not [pixel of the full-resolution
        detector].
    previous_median : float, optional
        The median, as of `update_size`, of the iteration before at this resolution.
    tolerance : float
        Median below which slow modes are not waited for any more [pixel].

    Returns
    -------
    bool
        True if the median is below the tolerance and the largest update below 0.5; or if the median
        is no smaller than the previous one, and updates are not that small: above 0.1 or 0.5 they
        wander, below they are slow modes, which go on as they did.
    """
    median, largest = update_size(update_u, update_v)
    if median < _MEDIAN and largest < _LARGEST:
        return median < tolerance
    return previous_median is not None and median >= previous_median
