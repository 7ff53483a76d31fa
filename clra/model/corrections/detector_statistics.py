"""Bad pixels and dead lines, told from what the detector's pixels did over the views.

The sample moves over the detector from view to view; what a bad pixel shows stays. Two signs are
looked for. A pixel that is *insensitive* varies less over the views than its neighbours do, by more
than chance allows. A pixel that *stands out* has a mean beyond those of its neighbours, by many
standard errors. Both have to hold along rows, columns and both diagonals, so that what a motionless
sample shows in all views, such as the wall of a tube on the axis, the rim of a holder or a cone, is
not taken for a defect: such lines are found along one direction or more.

Along a dead column all pixels are alike, and only their neighbours in the row tell. A line counts
as dead if most of it, of all that the sample moves over, is insensitive in that sense.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Steps (rows, columns) to the neighbours that a pixel is compared with: a row, a column, diagonals.
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
# Neighbours lie at once and twice these distances on both sides. One of the four may be bad as
# well: so squares of 3 x 3 bad pixels, and three dead lines side by side, are found.
_NEAR = (1, 2)
# Fewer columns, or rows, do not tell which of them are dead: scans of two rows are no rarity.
_FEWEST = 12
# Below so many rows or columns a sample's details are no wider than a bad pixel.
_SMALL = 40
# Chance at which a good pixel is called insensitive or standing out because of noise alone.
_CHANCE = 1e-10
# A pixel's variance is this part of its neighbours', at most, if it is insensitive: samples with
# sharp edges make variances differ by a factor of three between neighbours.
_INSENSITIVE = 0.05
# Where neighbours vary less than this part of what all do, at the rim of the sample, that counts
# for nothing: with little noise there is none to go by.
_WEAK = 0.1
# And a pixel stands out by at least this part of the spread of all line integrals, and by so many
# times what nine of ten pixels do.
_CONTRAST, _USUAL = 0.1, 6.0
# A line stands out by ten times the spread beside it: the wall of a tube, by three.
_EXTREME = 10.0
# Variances beside a border that differ by less than this factor are alike.
_ALIKE = 0.4
# The lowest variance of a detector, but for this part of its pixels, is that of the noise. What
# varies by less than the other part of it is constant.
_FLOOR, _CONSTANT = 0.04, 1e-3
# Part of a line, of all that varies beside it, that is insensitive if it is dead.
_LINE = 0.6
# Few views, in which no neighbour may vary as little as a pixel that is insensitive.
_FEW = 15
# Standard deviation, for that of the mean image, below which a pixel counts as constant.
_ROUNDING = 1e-4
# Pixels that are worked on at a time: a dozen arrays of so many are needed.
_BAND = 1 << 18
# Fewest views that tell anything.
FEWEST = 5


@dataclass(frozen=True)
class BadPixels:
    """Pixels that do not show the sample.

    Attributes
    ----------
    bad : ndarray of bool, (rows, columns)
        True where a pixel is bad, those of dead lines included.
    rows, columns : ndarray of int
        Dead lines.
    """

    bad: Mask
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]

    @property
    def single(self) -> int:
        """Number of bad pixels that lie on no dead line."""
        rest = self.bad.copy()
        rest[self.rows] = False
        rest[:, self.columns] = False
        return int(rest.sum())

    def __str__(self) -> str:
        """Return the numbers: "12 bad pixels, 2 dead columns"."""
        parts = [
            f"{count} {name}{'' if count == 1 else 's'}"
            for count, name in (
                (self.single, "bad pixel"),
                (len(self.rows), "dead row"),
                (len(self.columns), "dead column"),
            )
            if count
        ]
        return ", ".join(parts) or "no bad pixels"


class DetectorStatistics:
    """Mean and variance of each pixel over some views, without the highest and the lowest value.

    Without these two a zinger or an edge that passes once does not count.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.

    Attributes
    ----------
    views : int
        Number of views added.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.views = 0
        self._sum, self._squares = np.zeros((2, *shape))
        self._low = np.full(shape, np.inf, np.float32)
        self._high = np.full(shape, -np.inf, np.float32)

    def add(self, image: Floats) -> None:
        """Take in the line integrals of one view, (rows, columns)."""
        self.views += 1
        self._sum += image
        self._squares += np.square(image, dtype=np.float64)
        np.minimum(self._low, image, out=self._low)
        np.maximum(self._high, image, out=self._high)

    @property
    def degrees_of_freedom(self) -> int:
        """Of the variance."""
        return self.views - 3

    def moments(self) -> tuple[Floats, Floats]:
        """Return mean and variance, each (rows, columns)."""
        count = self.views - 2
        mean, variance = np.empty((2, *self._sum.shape), np.float32)
        for band in _bands(mean.shape):
            low, high = self._low[band].astype(np.float64), self._high[band].astype(np.float64)
            middle = (self._sum[band] - low - high) / count
            square = (self._squares[band] - low**2 - high**2) / count - middle**2
            # What rounding leaves of a constant is not a variance, ...
            rounding = 1e-12 * (self._squares[band] / self.views)
            mean[band] = middle
            variance[band] = np.where(square > rounding, square, 0) * count / (count - 1)
        # ... nor is anything so far below what the image itself spans: a simulation of a round
        # sample that stands still.
        variance[variance <= _ROUNDING**2 * mean.var(dtype=np.float64)] = 0
        return mean, variance

    def find(self) -> BadPixels:
        """Find the bad pixels; none of fewer than five views."""
        mean, variance = self.moments()
        none = np.zeros(0, np.intp)
        if self.views < FEWEST:
            return BadPixels(np.zeros(mean.shape, np.bool_), none, none)
        columns, rows = self._dead_lines(mean, variance), self._dead_lines(mean.T, variance.T)
        known = np.zeros(mean.shape, np.bool_)
        known[rows], known[:, columns] = True, True
        # Beside a dead line pixels are compared with what lies beyond it.
        mean, variance = _filled(mean, rows, columns), _filled(variance, rows, columns)
        if min(mean.shape) < _SMALL:
            return BadPixels(known, rows, columns)
        weak = _WEAK * float(variance.mean())
        least = self._least_excess(mean, variance)
        halo = 2 * max(_NEAR)
        for band in _bands(mean.shape):
            wide = slice(max(0, band.start - halo), band.stop + halo)
            found = self._insensitive(variance[wide], weak)
            found |= self._standing_out(mean[wide], variance[wide], least)
            known[band] |= found[band.start - wide.start :][: band.stop - band.start]
        return BadPixels(known, rows, columns)

    @property
    def _least(self) -> float:
        """Part of the neighbours' variance that no good pixel falls below."""
        from scipy.stats import f

        n = self.degrees_of_freedom
        return min(_INSENSITIVE, float(f.ppf(_CHANCE, n, n)))

    def _insensitive(self, variance: Floats, weak: float) -> Mask:
        found = np.zeros(variance.shape, np.bool_)
        # An edge that passed one neighbour and not the other counts in few views.
        rank = 0 if self.views < _FEW else 1
        for distance in _NEAR:
            lacking = np.ones_like(found)
            for step in _DIRECTIONS:
                lowest = _ranked(variance, step, distance)[rank]
                lacking &= (variance < self._least * lowest) & (lowest > weak)
            found |= lacking
        return found

    def _standing_out(self, mean: Floats, variance: Floats, least: float) -> Mask:
        found = np.zeros(mean.shape, np.bool_)
        for distance in _NEAR:
            excess = np.full(mean.shape, np.inf, np.float32)
            spread, noise = np.zeros((2, *mean.shape), np.float32)
            signs = np.zeros(mean.shape, np.float32)
            for step in _DIRECTIONS:
                beyond, width, sign = _excess(mean, step, distance)
                excess, spread = np.minimum(excess, beyond), np.maximum(spread, width)
                signs += sign
                noise = np.maximum(noise, _ranked(variance, step, distance)[2])
            error = np.sqrt((variance + noise) / (self.views - 2))
            usual = _USUAL * float(np.quantile(np.maximum(excess, 0), 0.9))
            enough = np.maximum(np.maximum(self._deviations * error, spread), max(least, usual))
            found |= (excess > enough) & (np.abs(signs) == len(_DIRECTIONS))
        return found

    def _dead_lines(self, mean: Floats, variance: Floats) -> NDArray[np.intp]:
        """Columns that show nothing of what lies beside them; up to three side by side."""
        rows, columns = variance.shape
        if columns < _FEWEST:
            return np.zeros(0, np.intp)
        least = _EXTREME * self._least_excess(mean, variance)
        best = np.zeros(columns)
        for distance in _NEAR:
            lacking, telling, extreme = np.zeros((3, columns))
            for band in _bands(mean.shape):
                varies = variance[band]
                beside = _ranked(varies, (0, 1), distance)[1]
                lacking += (varies < self._least * beside).sum(axis=0)
                telling += (beside > 0).sum(axis=0)
                beyond, width, sign = _excess(mean[band], (0, 1), distance)
                extreme += ((beyond > np.maximum(least, _EXTREME * width)) * sign).sum(axis=0)
            part = np.maximum(lacking / np.maximum(telling, rows / 8), np.abs(extreme) / rows)
            inside = slice(2 * distance, columns - 2 * distance)
            best[inside] = np.maximum(best, part)[inside]
        for border in (slice(None), slice(None, None, -1)):
            best[border][:4] = np.maximum(
                best[border][:4], self._at_border(mean[:, border], variance[:, border])
            )
        return np.flatnonzero(best > _LINE)

    def _at_border(self, mean: Floats, variance: Floats) -> NDArray[np.float64]:
        """Part of each of the first columns that is insensitive, for what lies inside of it."""
        part = np.zeros(4)
        profile = variance[:, :12].mean(axis=0)
        floor = np.quantile(variance, _FLOOR)
        for column in range(min(3, len(profile) - 4)):
            beside = profile[column + 1 : column + 5]
            lowest = np.sort(variance[:, column + 1 : column + 5], axis=1)[:, 1]
            # Where the sample only just reaches, the variance falls toward the border by itself,
            # but not far below that of the noise; and what looks like air there does no harm.
            rim = beside.min() <= _ALIKE * beside.max()
            if rim:
                lowest = np.minimum(lowest, _CONSTANT * floor)
            lacking = variance[:, column] < self._least * lowest
            if rim:
                lacking &= abs(mean[:, column]) > self._least_excess(mean, variance)
            dead = lacking.sum() / max((lowest > 0).sum(), len(variance) / 8)
            part[: column + 1] = np.maximum(part[: column + 1], dead)
        return part

    @property
    def _deviations(self) -> float:
        """Standard errors that no good pixel differs by."""
        from scipy.stats import norm

        return float(norm.isf(_CHANCE))

    @staticmethod
    def _least_excess(mean: Floats, variance: Floats) -> float:
        return _CONTRAST * float(np.std(mean) + np.sqrt(np.median(variance)))


def _bands(shape: tuple[int, ...]) -> list[slice]:
    """Cut rows into bands of limited size."""
    rows, columns = shape
    count = -(-rows * columns // _BAND)
    edges = [rows * k // count for k in range(count + 1)]
    return [slice(a, b) for a, b in pairwise(edges)]


def _ranked(values: Floats, step: tuple[int, int], distance: int) -> tuple[Floats, ...]:
    """Sort the four neighbours on a line through each pixel; beyond borders they are mirrored."""
    reach = 2 * distance
    padded = np.pad(values, reach, mode="reflect" if min(values.shape) > reach else "symmetric")
    rows, columns = values.shape
    a, b, c, d = (
        padded[reach + k * step[0] :, reach + k * step[1] :][:rows, :columns]
        for k in (-reach, -distance, distance, reach)
    )
    # A sorting network: ten times as fast as sorting.
    low, other_low = np.minimum(a, b), np.minimum(c, d)
    high, other_high = np.maximum(a, b), np.maximum(c, d)
    inner, other_inner = np.maximum(low, other_low), np.minimum(high, other_high)
    return (
        np.minimum(low, other_low),
        np.minimum(inner, other_inner),
        np.maximum(inner, other_inner),
        np.maximum(high, other_high),
    )


def _excess(mean: Floats, step: tuple[int, int], distance: int) -> tuple[Floats, Floats, Floats]:
    """How far a pixel is beyond its neighbours, how much they differ, and on which side it is.

    One of four neighbours on either side of their range does not count.
    """
    first, second, third, fourth = _ranked(mean, step, distance)
    above, below = mean - third, second - mean
    side = np.sign(above - below)
    # Of three of them: two may be alike by chance, such as on either side of a round sample.
    return np.maximum(above, below), np.minimum(fourth - second, third - first), side


def _filled(values: Floats, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Floats:
    """Values whose dead lines are interpolated linearly between the lines beside them."""
    for axis, lines in ((0, rows), (1, columns)):
        if not len(lines):
            continue
        values = values.copy()
        moved = np.moveaxis(values, axis, 0)
        good = np.setdiff1d(np.arange(len(moved)), lines)
        for line in lines:
            right = int(np.searchsorted(good, line))
            a, b = good[max(right - 1, 0)], good[min(right, len(good) - 1)]
            weight = 0.5 if a == b else (line - a) / (b - a)
            moved[line] = (1 - weight) * moved[a] + weight * moved[b]
    return values
