"""What the user says against, or in place of, a scanner's metadata."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError
from clra.io.frames.stacks import Source, read_numbers
from clra.io.key_value_text import read_text


@dataclass(frozen=True, kw_only=True)
class ScannerOptions:
    """What the user says against, or in place of, a scanner's metadata.

    Parameters
    ----------
    rotation : {"ccw", "cw"}, optional
        How the sample turns as its angle grows, seen from above; the vendor's if not given.
    flip : {"columns", "rows", "both"}, optional
        The radiographs are stored mirrored against what the vendor's metadata say.
    centre_offset : float or (float, float), optional
        Column at which the axis is seen, and row at which the perpendicular from the source meets
        the detector, from the detector's middle, once row 0 is the top and columns count to the
        right as seen from the source [pixel].
    source_distance, detector_distance : float, optional
        From the source to the axis, and from there to the detector [mm].
    pixel_size : float or (float, float), optional
        Of the detector; (row, column) steps where they differ [mm].
    parallel : bool
        The beam is parallel.
    angles, z_translation : path-like, str or array_like, optional
        Turn of the sample [degree] and how far it is raised [mm] in each view: a text file with a
        number a line, ``start:stop:n`` with both ends included, or numbers.
    white : float, optional
        Counts of the open beam.
    shape : (int, int), optional
        Rows and columns, where the metadata do not tell them.

    Raises
    ------
    InputError
        If a word is none of these or a distance not above 0.
    """

    rotation: str | None = None
    flip: str | None = None
    centre_offset: float | tuple[float, ...] | None = None
    source_distance: float | None = None
    detector_distance: float | None = None
    pixel_size: float | tuple[float, float] | None = None
    parallel: bool = False
    angles: Source | ArrayLike | None = None
    z_translation: Source | ArrayLike | None = None
    white: float | None = None
    shape: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.rotation not in (None, "ccw", "cw"):
            raise InputError.at("--rotation", "rotation", repr(self.rotation), "ccw or cw")
        if self.source_distance is not None:  # behind the axis, NeXus has it negative
            object.__setattr__(self, "source_distance", abs(self.source_distance))
        for name in ("source_distance", "detector_distance", "white"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                option = f"--{name.replace('_', '-')}"
                raise InputError.at(option, name, value, "a number above 0")
        if self.pixel_size is not None and not np.all(np.asarray(self.pixel_size) > 0):
            raise InputError.at("--pixel-size", "pixel_size", self.pixel_size, "above 0 mm")

    def distances(self, source_to_axis: float, source_to_detector: float) -> tuple[float, float]:
        """Return the distances from the source to axis and detector, the user's if given [mm]."""
        behind = source_to_detector - source_to_axis
        near = self.source_distance or source_to_axis
        return near, near + (self.detector_distance or behind)

    def pixel(self, told: tuple[float, float]) -> tuple[float, float]:
        """Return width and height of a pixel, the user's if given [mm]."""
        if self.pixel_size is None:
            return told
        height, width = np.broadcast_to(np.asarray(self.pixel_size, np.float64), 2).tolist()
        return width, height

    def degrees(self, told: ArrayLike | None, path: Path) -> NDArray[np.float64]:
        """Return the angles of the views, the user's if given [degree].

        Raises
        ------
        InputError
            If neither the metadata tell them nor the user.
        """
        if self.angles is not None:
            return _listed(self.angles, "angles", None if told is None else np.size(told))
        if told is None:
            raise InputError.at(
                path, "angles", "none", "--angles FILE: they are not in this format"
            )
        return np.asarray(told, np.float64)

    def heights(self, views: int) -> NDArray[np.float64] | None:
        """Return how far the sample is raised in each view [mm], or None."""
        given = self.z_translation
        return None if given is None else _listed(given, "z_translation", views)


def _listed(given: Source | ArrayLike, what: str, count: int | None) -> NDArray[np.float64]:
    """Read numbers that the user gives, as many as there are views where that is known."""
    if count is None:
        if isinstance(given, str) and (spaced := re.fullmatch(r".*:(\d+)", given.strip())):
            count = int(spaced[1])
        elif isinstance(given, str | os.PathLike):
            lines = read_text(Path(given)).splitlines()
            count = sum(bool(line.split("#")[0].strip()) for line in lines)
        else:
            count = np.size(given)
    return read_numbers(given, what, count, "of the scan")
