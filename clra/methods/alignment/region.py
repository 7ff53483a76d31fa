"""Where alignment reconstructs: what radiographs show of the sample, past what all of them see."""

import math
from dataclasses import dataclass, replace

import numpy as np

from clra.methods.alignment.reprojection import with_margin
from clra.methods.truncation import AT_BORDER, extension, falls_outwards, truncated
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid, axis_ranges
from clra.model.sampling.angular_coverage import covered
from clra.model.scan import Scan
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

# Width of the grid of a truncated sample, in fields of view, by how far the sample seems to reach
# beyond each side: least, growth with the square, most. What lies beside the field is in the
# radiographs and has to be in the re-projections, but what is empty there fills with streaks. The
# reach of samples with a thin rim is underestimated. Before odd harmonics are fitted, rock and
# balls of 1.0, 1.2, 1.5 and 2.0 fields are in u at 0.08 to 0.05, 0.12 to 0.02, 0.2 and 0.4 to 0.2
# pixel; with 1.6 for all at 0.10 to 0.07, 0.18 to 0.02, 0.35 to 0.07 and the same, with 1.2 for all
# those of 2.0 at 1.
_WIDTH, _GROWTH, _WIDEST = 1.15, 18.0, 1.6
# Corrections of the volume of a truncated sample: 1 ended at 0.24 pixel, 2 at 0.18, 4 at 0.14; and
# of an arc: of 200 degrees 1 at 0.035, 2 at 0.025, 3 at 0.017, of 140 degrees 1 at 0.09, 2 at 0.05,
# 4 at 0.03. With 300 photons a pixel 3 are as good as 1.
_TERMS = 3
# What rays climb from the axis to the border of the field of view, in heights of the detector.
_SLOPE = 0.1
# Radiographs at each end of a scan that are looked at.
_PROBED = 5


@dataclass(frozen=True)
class Region:
    """Where to reconstruct, at full resolution.

    Parameters
    ----------
    grid : VolumeGrid
        Holds whatever the radiographs show.
    sample : VolumeGrid
        What a movement of the sample as a whole is judged by.
    truncated : bool
        Whether the sample reaches beyond the left or right border of the detector.
    short : bool
        Whether the views cover no whole turn.
    """

    grid: VolumeGrid
    sample: VolumeGrid
    truncated: bool = False
    short: bool = False

    def terms(self, usual: int) -> int:
        """Return how many corrections the volume needs where `usual` do for others."""
        return max(usual, _TERMS) if (self.truncated or self.short) and usual else usual


def region_of(stream: Stream, scan: Scan, grid: VolumeGrid, *, own: bool = True) -> Region:
    """Find out where to reconstruct.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        A few of its radiographs are read.
    grid : VolumeGrid
        Of the field of view, or the caller's.
    own : bool
        Whether it may become wider, where the sample is truncated, and higher, where views at the
        ends of a scan show something past it; a margin along z it gets in any case.
    """
    radiographs = Radiographs(stream, scan, 1)
    cut = bool(truncated(radiographs, scan.geometry)) and falls_outwards(radiographs)
    sample = with_margin(grid)
    wide = sample
    if own and cut:
        nz, ny, nx = sample.shape
        width = width_of(extension(radiographs, scan.geometry))
        wide = replace(sample, shape=(nz, round(width * ny), round(width * nx)))
    if own:
        wide = _as_high_as_seen(radiographs, scan.geometry, wide)
    return Region(wide, sample, cut, covered(scan.geometry) < 2 * math.pi)


def width_of(reach: float) -> float:
    """Return how wide the grid is, in fields of view, for what :func:`extension` finds."""
    return min(_WIDTH + _GROWTH * reach**2, _WIDEST) if reach else 1.0


def _as_high_as_seen(
    radiographs: Radiographs, geometry: ConeBeamGeometry, grid: VolumeGrid
) -> VolumeGrid:
    """Add planes at the ends of z past which radiographs show something."""
    low, high = axis_ranges(geometry)
    half = 0.5 * grid.shape[0] * grid.voxel_size
    bottom, top = grid.centre[2] - half, grid.centre[2] + half
    matrices = geometry.projection_matrices()
    more = [0, 0]
    for end, (edge, views, reach) in enumerate(
        (
            (bottom, np.argsort(low)[:_PROBED], bottom - low.min()),
            (top, np.argsort(-high)[:_PROBED], high.max() - top),
        )
    ):
        if reach <= 0:
            continue
        for view in np.sort(views):
            row = matrices[view, 1:, 2] * edge + matrices[view, 1:, 3]
            beyond = np.arange(geometry.rows) - row[0] / row[1]
            # Rows count upwards or downwards.
            side = 1.0 if geometry.v[view, 2] > 0 else -1.0
            past = (beyond * side > 0) if end else (beyond * side < 0)
            means = radiographs.read(slice(int(view), int(view) + 1))[0].mean(axis=1)
            if past.any() and means[past].max() > AT_BORDER * means.max():
                more[end] = int(
                    np.ceil((reach + _SLOPE * (high[view] - low[view])) / grid.voxel_size)
                )
                break
    if not any(more):
        return grid
    nz, ny, nx = grid.shape
    x, y, z = grid.centre
    z += 0.5 * (more[1] - more[0]) * grid.voxel_size
    return replace(grid, shape=(nz + sum(more), ny, nx), centre=(x, y, z))
