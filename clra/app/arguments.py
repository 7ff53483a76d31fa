"""Option values that are more than a number or a name."""

import math
import re
from pathlib import Path

from clra.errors import InputError


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
    from clra.io.volumes.volume_files import HDF5, TIFF

    expected = ", ".join((HDF5[0], *TIFF))
    if path.suffix.lower() == ".zarr":
        raise InputError(f"{path}: zarr volumes cannot be written yet, expected {expected}")
    if path.suffix.lower() not in HDF5 + TIFF:
        raise InputError(f"{path}: found suffix {path.suffix!r}, expected one of {expected}")
