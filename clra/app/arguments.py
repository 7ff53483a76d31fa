"""Option values that are more than a number or a name."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

from clra.errors import InputError

if TYPE_CHECKING:
    from clra.io.volumes.integer_limits import Limits
    from clra.model.grid import Region


def detector(option: str, text: str) -> tuple[int, int]:
    """Read "ROWSxCOLUMNS".

    Parameters
    ----------
    option : str
        Where it was given, for the message.
    text : str
        For example "256x192".

    Raises
    ------
    InputError
        If it is not that.
    """
    found = re.fullmatch(r"([1-9]\d*)[xX]([1-9]\d*)", text.strip())
    if not found:
        raise InputError(f"{option}: found {text!r}, expected ROWSxCOLUMNS such as 256x192")
    return int(found[1]), int(found[2])


def interval(option: str, text: str) -> tuple[float, float]:
    """Read "LOW,HIGH".

    Parameters
    ----------
    option : str
        Where it was given, for the message.
    text : str
        For example "-10,8".

    Raises
    ------
    InputError
        If it is not two numbers in order.
    """
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        low, high = 1.0, 0.0
    if not low <= high:
        raise InputError(f"{option}: found {text!r}, expected LOW,HIGH such as -10,8")
    return low, high


def axis_place(option: str, text: str) -> tuple[float, ...]:
    """Read "COLUMN" or "COLUMN,ROW" [pixel].

    Parameters
    ----------
    option : str
        Where it was given, for the message.
    text : str
        For example "-3.5" or "-3.5,12".

    Raises
    ------
    InputError
        If it is neither.
    """
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (1, 2) or not all(map(math.isfinite, numbers)):
        raise InputError(f"{option}: found {text!r}, expected COLUMN or COLUMN,ROW such as -3.5,12")
    return numbers


def pixel(text: str) -> float | tuple[float, float]:
    """Read the size of a pixel: one number, or "ROW,COLUMN" steps [mm].

    Parameters
    ----------
    text : str
        For example "0.139".

    Raises
    ------
    InputError
        If it is neither.
    """
    try:
        sizes = [float(part) for part in text.split(",")]
    except ValueError:
        sizes = []
    if len(sizes) not in (1, 2):
        raise InputError(f"--pixel-size: found {text!r}, expected MM, or MM,MM of row and column")
    return sizes[0] if len(sizes) == 1 else (sizes[0], sizes[1])


def view_numbers(option: str, text: str) -> tuple[int, ...]:
    """Read a list of views: "3,17,40-52", both ends of a range included.

    Parameters
    ----------
    option : str
        Where it was given, for the message.
    text : str
        Numbers and ranges.

    Raises
    ------
    InputError
        If it is none.
    """
    views: set[int] = set()
    for part in text.split(","):
        found = re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())
        first, last = (int(found[1]), int(found[2] or found[1])) if found else (1, 0)
        if first > last:
            raise InputError(f"{option}: found {text!r}, expected views such as 3,17,40-52")
        views.update(range(first, last + 1))
    return tuple(sorted(views))


def coefficients(option: str, text: str) -> tuple[float, ...]:
    """Read the coefficients of a polynomial: "0.02,0.001".

    Parameters
    ----------
    option : str
        Where it was given, for the message.
    text : str
        Numbers.

    Raises
    ------
    InputError
        If it is none.
    """
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = (math.nan,)
    if not all(map(math.isfinite, numbers)):
        raise InputError(f"{option}: found {text!r}, expected numbers such as 0.02,0.001")
    return numbers


def memory_size(option: str, text: str) -> int:
    """Read a number of bytes: "512M", "2.5G", "800MiB".

    Parameters
    ----------
    option : str
        Where it was given, for the message.
    text : str
        A number, with a unit of 1024 to some power if need be.

    Raises
    ------
    InputError
        If it is not that, or less than a byte.
    """
    found = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*([kmgt]?)(?:i?b)?", text.strip().lower())
    count = int(float(found[1]) * 1024 ** " kmgt".index(found[2] or " ")) if found else 0
    if count < 1:
        raise InputError(f"{option}: found {text!r}, expected a size such as 512M or 2.5G")
    return count


def region(option: str, text: str) -> Region:
    """Read "X0:X1,Y0:Y1,Z0:Z1" [mm]; an end that is left out is that of the field of view.

    Parameters
    ----------
    option : str
        Where it was given, for the message.
    text : str
        For example "-1:1,-1:1,0:" or ":,:,-0.5:0.5".

    Raises
    ------
    InputError
        If it is not that.
    """
    number = r"\s*([-+.\deE]*)\s*"
    found = re.fullmatch(",".join([f"{number}:{number}"] * 3), text)
    try:
        ends = [float(end) if end else None for end in found.groups()] if found else []
    except ValueError:
        ends = []
    if len(ends) != 6:
        expected = "X0:X1,Y0:Y1,Z0:Z1 in mm such as -1:1,-1:1,0:"
        raise InputError(f"{option}: found {text!r}, expected {expected}")
    return (ends[0], ends[1]), (ends[2], ends[3]), (ends[4], ends[5])


def limits_of_integers(option: str, text: str) -> Limits:
    """Read "LOW,HIGH" [1/mm] or "LOW%,HIGH%" of the voxels.

    Parameters
    ----------
    option : str
        Where it was given, for the message.
    text : str
        For example "0,0.2" or "0.1%,99.9%".

    Raises
    ------
    InputError
        If it is neither.
    """
    from clra.io.volumes.integer_limits import Limits

    parts = [part.strip() for part in text.split(",")]
    percent = all(part.endswith("%") for part in parts)
    try:
        low, high = (float(part.removesuffix("%") if percent else part) for part in parts)
    except ValueError:
        expected = "LOW,HIGH in 1/mm or LOW%,HIGH%"
        raise InputError(f"{option}: found {text!r}, expected {expected}") from None
    return Limits(low, high, percent)


def volume_file(path: Path) -> None:
    """Check that a volume of that name can be written.

    Parameters
    ----------
    path : Path
        By whose suffix the format is chosen.

    Raises
    ------
    InputError
        If there is no such format.
    """
    from clra.io.volumes.volume_files import SUFFIXES

    if path.suffix.lower() not in SUFFIXES:
        expected = ", ".join(SUFFIXES)
        raise InputError(f"{path}: found suffix {path.suffix!r}, expected one of {expected}")
