"""The air beside the sample: it tells how bright the beam was in each view.

A beam that decays, flickers or was refilled leaves an offset in the line integrals of a view, the
same in all its pixels. Where the detector's sides look past the sample, they show it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Series = NDArray[np.float64]
Tile = tuple[int, int, int, int]

# Strips at the left and right sides of the detector, this part of its width, at least so many
# columns, are cut into tiles: two side by side, and so many along the height.
_STRIP, _LEAST_COLUMNS, _ALONG = 0.05, 4, 8
# Tiles of air agree from view to view within this line integral, or this part of the contrast of
# the radiographs, whichever is more, on top of the noise: a sample that reaches in shows more.
_AGREEMENT, _OF_CONTRAST = 0.004, 0.03
# Part of the tiles of a side that has to be air, and of the views in which a tile has to be.
_TILES, _VIEWS = 0.25, 0.9
# Beams that are steadier than this line integral are left as they are.
_STEADY = 0.003
# Part of the views that this is judged by, without the farthest off.
_USUAL = 0.95


@dataclass(frozen=True, eq=False)
class AirRegion:
    """Tiles of the detector that look past the sample in nearly all views.

    Attributes
    ----------
    tiles : tuple of (int, int, int, int)
        First and last + 1 row, first and last + 1 column of each.
    """

    tiles: tuple[Tile, ...]

    def level(self, image: Floats) -> float:
        """Return the line integral of the air in one radiograph (rows, columns).

        The median of the tiles, so that a sample that reaches into some does not count. It is the
        transmission that is averaged: the mean of logarithms is biased by noise.
        """
        return float(np.median(-np.log(tile_means(image, self.tiles))))

    def cropped(self, rows: slice, columns: slice) -> AirRegion | None:
        """Return what a rectangle of the detector holds of it, or None if that is nothing."""
        found = []
        for top, bottom, left, right in self.tiles:
            inside = (
                max(top, rows.start) - rows.start,
                min(bottom, rows.stop) - rows.start,
                max(left, columns.start) - columns.start,
                min(right, columns.stop) - columns.start,
            )
            if inside[0] < inside[1] and inside[2] < inside[3]:
                found.append(inside)
        return AirRegion(tuple(found)) if found else None


class AirStatistics:
    """What the sides of the detector show over some views.

    Parameters
    ----------
    rows, columns : slice
        Rectangle of the detector that is used.
    """

    def __init__(self, rows: slice, columns: slice) -> None:
        self._tiles = _border_tiles(rows, columns)
        self._means: list[Series] = []
        self._contrast: list[float] = []
        self._noise: list[float] = []

    def add(self, image: Floats) -> None:
        """Take in the line integrals of one view, (rows, columns)."""
        if not self._tiles:
            return
        self._means.append(tile_means(image, self._tiles))
        self._contrast.append(float(image.std()))
        self._noise.append(
            float(
                np.median([np.median(abs(np.diff(image[_part(t)], axis=0))) for t in self._tiles])
            )
        )

    def find(self) -> AirRegion | None:
        """Find the tiles that are air.

        Returns
        -------
        AirRegion or None
            None where there is no air, and where the beam is so steady that there is nothing to
            correct.
        """
        if not self._means:
            return None
        level = -np.log(np.maximum(self._means, 1e-6))
        contrast = float(np.median(self._contrast))
        noise = 1.4826 * float(np.median(self._noise)) / np.sqrt(2)
        area = np.array(
            [(bottom - top) * (right - left) for top, bottom, left, right in self._tiles]
        )
        brightest = np.quantile(level, 0.25, axis=1)
        within = max(_AGREEMENT, _OF_CONTRAST * contrast) + 4 * noise / np.sqrt(area)
        air = (np.abs(level - brightest[:, None]) < within).mean(axis=0) >= _VIEWS
        # Outer and inner tile at one height: the rim of a truncated sample rises inwards.
        halves = air.reshape(2, 2, _ALONG).all(axis=1)
        air = np.repeat(halves[:, None], 2, axis=1).ravel()
        if air.reshape(2, -1).mean(axis=1).max() < _TILES:
            return None
        levels = np.sort(np.abs(np.median(level[:, air], axis=1)))
        usual = levels[: max(1, int(_USUAL * len(levels)))]  # some views may be blank
        error = noise / np.sqrt(area[air].sum())
        if np.sqrt(np.mean(usual**2)) < max(_STEADY, 4 * error):
            return None
        return AirRegion(tuple(t for t, good in zip(self._tiles, air, strict=True) if good))


def _border_tiles(rows: slice, columns: slice) -> tuple[Tile, ...]:
    """Tiles at the left and right sides of a part of the detector; left ones first."""
    height, across = rows.stop - rows.start, columns.stop - columns.start
    width = max(_LEAST_COLUMNS, round(_STRIP * across))
    if across < 4 * width or height < 3 * _ALONG:
        return ()
    edges = np.linspace(rows.start, rows.stop, _ALONG + 1).astype(int).tolist()
    half, left, right = width // 2, columns.start, columns.stop
    sides = [(left, left + half), (left + half, left + width)]
    sides += [(right - half, right), (right - width, right - half)]
    return tuple((top, bottom, *side) for side in sides for top, bottom in pairwise(edges))


def tile_means(image: Floats, tiles: tuple[Tile, ...]) -> Series:
    """Return the mean transmission of each tile of a radiograph of line integrals, (tiles,)."""
    return np.array([np.exp(-image[_part(t)], dtype=np.float64).mean() for t in tiles])


def _part(tile: Tile) -> tuple[slice, slice]:
    top, bottom, left, right = tile
    return slice(top, bottom), slice(left, right)
