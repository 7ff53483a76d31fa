"""Files of frames that are numbered in their names, and those that are missing among them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clra.findings import Finding
from clra.io.frames.frame_views import Frames, MissingFrames
from clra.io.frames.stacks import FrameStack, RawLayout

TIFF_LAYOUT = RawLayout()
# So many numbers of missing files are listed.
_LISTED = 8


def numbered_files(folder: Path, pattern: str) -> list[tuple[int, Path]]:
    """Return the files of a folder whose names match, with the number in the first group, sorted.

    Parameters
    ----------
    folder : Path
        Where to look; there may be no such folder.
    pattern : str
        Regular expression of whole names, upper and lower case alike.
    """
    expression = re.compile(pattern, re.IGNORECASE)
    names = sorted(os.listdir(folder)) if folder.is_dir() else []
    matches = [(expression.fullmatch(name), name) for name in names]
    return sorted((int(match[1]), folder / name) for match, name in matches if match)


def frames_or_missing(
    files: Iterable[Path],
    shape: tuple[int, int, int],
    path: Path,
    expected: str,
    layout: RawLayout = TIFF_LAYOUT,
) -> Frames:
    """Return the frames in files, or a stand-in where there are none.

    Parameters
    ----------
    files : iterable of Path
        In the order of the views.
    shape : (int, int, int)
        Of the radiographs, as the metadata tell it.
    path : Path
        The metadata.
    expected : str
        Which files were looked for.
    layout : RawLayout
        Of headerless files.
    """
    found = list(files)
    if not found:
        return MissingFrames(shape, f"{path}: radiographs: found none, expected {expected}")
    return FrameStack(found, layout)


def stack_or_none(files: Iterable[Path], layout: RawLayout = TIFF_LAYOUT) -> FrameStack | None:
    """Return the frames in files, or None where there are none."""
    found = list(files)
    return FrameStack(found, layout) if found else None


def present_views(
    numbers: Sequence[int], first: int, views: int
) -> tuple[NDArray[np.intp], list[Finding]]:
    """Tell of which views there are files, and warn of those without.

    Parameters
    ----------
    numbers : sequence of int
        In the names of the files that there are, in order.
    first : int
        That of the first view.
    views : int
        How many views the metadata tell.

    Returns
    -------
    ndarray of int, list of Finding
        All views where there are no files, as many as views, or numbers that fit no views.
    """
    index = np.asarray(numbers, np.intp) - first
    inside = bool(len(index)) and 0 <= index.min() and index.max() < views
    if len(index) == views or not inside:
        return np.arange(views), []
    lost = sorted(set(range(views)) - set(index.tolist()))
    listed = ", ".join(str(view + first) for view in lost[:_LISTED])
    more = " and so on" if len(lost) > _LISTED else ""
    message = f"{len(lost)} of {views} radiographs are missing: numbers {listed}{more}"
    return index, [Finding("missing-radiographs", message, "the others keep their angles")]
