"""Ordered subsets: views shared out so that each subset sees all of the sample from all around."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.validation import whole

Views = NDArray[np.intp]

# Views of a subset that see a voxel, at least, where the number of subsets is chosen. With fewer
# than about this many the subsets disagree and the volume gathers noise; with twice as many a pass
# gains half as much.
_ENOUGH = 12
_MOST = 40
_HEIGHTS, _AZIMUTHS = 24, 4
# A part of the views that see the sample best: where fewer do, subsets may miss it.
_SEEN = 0.4
_GOLDEN = (5**0.5 - 1) / 2


def ordered_subsets(
    geometry: ConeBeamGeometry, grid: VolumeGrid, count: int | None = None
) -> list[Views]:
    """Share out the views of a scan.

    One view of each run of `count` successive ones goes to each subset: every `count`-th, or, where
    that would let a subset see some part of the sample from few directions (a space-filling scan
    whose angles nearly repeat), one whose place in the run changes from run to run. Subsets follow
    each other in bit-reversed order, so that directions just used are not used again soon.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of all views.
    grid : VolumeGrid
        That holds the sample.
    count : int, optional
        Number of subsets; by default so many that each voxel is seen by at least 12 views of each,
        40 at most.

    Returns
    -------
    list of ndarray of int
        Views of each subset, ascending, in the order of their use; each view is in one.

    Raises
    ------
    InputError
        If `count` is not 1 to the number of views, or so large that some subset misses a part of
        the sample.
    """
    sample = _Sample(geometry, grid)
    if count is None:
        for fewer in range(min(_MOST, max(1, sample.least // _ENOUGH)), 1, -1):
            subsets = sample.shared_out(fewer)
            if subsets is not None:
                return subsets
        return [np.arange(geometry.views)]
    count = whole("subsets", count)
    if count > geometry.views:
        raise InputError(f"subsets: found {count}, expected at most {geometry.views}, one a view")
    subsets = sample.shared_out(count)
    if subsets is None:
        raise InputError(
            f"subsets: found {count}, expected fewer: one of them does not see all of the sample"
        )
    return subsets


def bit_reversed(count: int) -> list[int]:
    """Return 0 to `count` - 1 in the order of their reversed bits.

    Parameters
    ----------
    count : int
        Any positive number.
    """
    bits = (count - 1).bit_length()
    numbers = (int(f"{k:0{bits}b}"[::-1], 2) if bits else 0 for k in range(1 << bits))
    return [number for number in numbers if number < count]


class _Sample:
    """Points on the rotation axis and around it, and which views see them from where."""

    def __init__(self, geometry: ConeBeamGeometry, grid: VolumeGrid) -> None:
        planes = grid.coordinates()[2]
        heights = np.linspace(planes[0], planes[-1], _HEIGHTS)
        radius = 0.45 * min(grid.shape[1:]) * grid.voxel_size
        around = radius * np.exp(2j * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS)
        across = np.concatenate([[0], around]) + complex(*grid.centre[:2])
        x, z = np.meshgrid(across, heights)
        pixels = geometry.project(np.stack([x.real, x.imag, z], axis=-1).reshape(-1, 3))
        with np.errstate(invalid="ignore"):
            on = (pixels >= 0) & (pixels <= np.array([geometry.columns, geometry.rows]) - 1)
        seen = np.asarray(on.all(axis=-1))
        total = seen.sum(axis=0)
        well = total >= _SEEN * total.max()
        self._seen = seen[:, well]
        # Every subset has to see the axis at each height; to the side, a few views may miss a bit.
        self._axis = (np.abs(x.ravel() - across[0]) < radius / 2)[well]
        angle = np.arctan2(geometry.source[:, 0], -geometry.source[:, 1])
        self._directions = np.exp(2j * angle)
        self.least = int(total[well].min())

    def shared_out(self, count: int) -> list[Views] | None:
        """Subsets in their order; None if one does not see the axis at some height."""
        run, place = np.divmod(np.arange(len(self._seen)), count)
        jump = np.floor(run * _GOLDEN % 1.0 * count).astype(np.intp)
        best: list[Views] | None = None
        bias = np.inf
        for member in (place, (place + jump) % count):
            subsets = [np.flatnonzero(member == k) for k in bit_reversed(count)]
            seeing = np.array([self._seen[subset].sum(axis=0) for subset in subsets])
            if seeing[:, self._axis].min(initial=1) == 0:
                continue
            sums = [self._directions[subset] @ self._seen[subset] for subset in subsets]
            found = float(np.max(np.abs(sums) / np.maximum(seeing, 1), initial=0.0))
            # A little better is no reason to leave even steps.
            if best is None or found < 0.5 * bias:
                best, bias = subsets, found
        return best
