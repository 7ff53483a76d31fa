"""The sample before and after alignment: slices, and radiographs against their re-projections."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clra.app.report.slices import MultigridSlicer, Slicer
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid, default_grid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.slab_projector import SlabProjector
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import Volume

Image = NDArray[np.float32]

# Most columns of the radiographs that slices, and that whole volumes, are made from: a slice fills
# a page, and a volume of this size is a small part of the work of aligning.
_SLICE_COLUMNS, _VOLUME_COLUMNS = 800, 256
# Sigma of the background that is taken off a difference of radiographs [pixel]: intensities of a
# ramp-filtered reconstruction are a few per cent off over large areas.
_BACKGROUND = 12.0
# Slices that can be scrolled through; each takes some 20 KiB of the page, twice.
_SLICES = 15


@dataclass(frozen=True)
class Pair:
    """One picture without and with the motion corrected."""

    before: Image
    after: Image

    @property
    def sharpening(self) -> float:
        """Mean squared gradient after, relative to before."""
        energies = [
            float(np.mean([np.mean(g**2) for g in np.gradient(image.astype(np.float64))]))
            for image in (self.before, self.after)
        ]
        return energies[1] / energies[0] if energies[0] else 1.0


@dataclass(frozen=True)
class MatchedView:
    """A measured radiograph and what is left of it when its re-projection is taken off.

    Attributes
    ----------
    view : int
        Which.
    why : str
        What made it worth showing.
    measured, reprojected : ndarray, (rows, columns)
        Line integrals; the re-projection is of the aligned volume.
    difference : Pair
        Measured minus re-projected, slow background removed.
    """

    view: int
    why: str
    measured: Image
    reprojected: Image
    difference: Pair


@dataclass(frozen=True)
class Comparison:
    """Pictures for a report.

    Attributes
    ----------
    horizontal, vertical, detail : Pair
        Slices through the middle of the sample and a part of the horizontal one [1/mm].
    voxel_mm : float
        Edge of a pixel in them.
    method : str
        What reconstructed them, for reading.
    matches : tuple of MatchedView
        Some views.
    pixel_mm : float
        Edge of a pixel in those, at the sample, and of a voxel in `slices`.
    slices : tuple of (float, Pair)
        Slices across the axis at several heights [mm], from the volumes that were re-projected.
    """

    horizontal: Pair
    vertical: Pair
    detail: Pair
    voxel_mm: float
    method: str
    matches: tuple[MatchedView, ...]
    pixel_mm: float
    slices: tuple[tuple[float, Pair], ...] = ()


def compare(
    stream: Stream,
    scan: Scan,
    motion: Motion,
    confidence: NDArray[np.float64],
    valid_views: NDArray[np.bool_],
    volume: Image | None = None,
) -> Comparison:
    """Reconstruct slices and re-project some views, without and with the motion.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        The measured one.
    motion : Motion
        As estimated.
    confidence : ndarray, (views,)
        Of the estimate; the view with the least is shown.
    valid_views : ndarray of bool, (views,)
        Views to reconstruct from with the motion.
    volume : ndarray, (nz, ny, nx), optional
        By multigrid iteration, aligned: slices are of this one, and of one made without alignment.
    """
    slicer = (
        Slicer(stream, scan, motion, _level(scan, _SLICE_COLUMNS), valid_views)
        if volume is None
        else MultigridSlicer(stream, scan, volume)
    )
    horizontal, vertical = (Pair(*slicer.images(plane)) for plane in _middle_planes(slicer.grid))
    level = volume_level(scan)
    radiographs = Radiographs(stream, scan, level)
    matches, slices = _matches(stream, radiographs, scan.geometry, motion, confidence, valid_views)
    return Comparison(
        horizontal=horizontal,
        vertical=vertical,
        detail=_detail(horizontal),
        voxel_mm=slicer.grid.voxel_size,
        method=slicer.method,
        matches=matches,
        pixel_mm=_grid(scan.geometry, level).voxel_size,
        slices=slices,
    )


def volume_level(scan: Scan) -> int:
    """Binning at which whole volumes are made for a report."""
    return _level(scan, _VOLUME_COLUMNS)


def _level(scan: Scan, columns: int) -> int:
    """Binning that leaves no more than that many columns, if 8 does."""
    return next((n for n in (1, 2, 4) if scan.geometry.columns // n <= columns), 8)


def _grid(geometry: ConeBeamGeometry, level: int) -> VolumeGrid:
    grid = default_grid(geometry)
    return grid.binned(level) if level > 1 else grid


def _middle_planes(grid: VolumeGrid) -> tuple[VolumeGrid, VolumeGrid]:
    """Grids of the middle slice across the axis and of the one along it and x."""
    nz, _, nx = grid.shape
    along = VolumeGrid(shape=(nz, 1, nx), voxel_size=grid.voxel_size, centre=grid.centre)
    return grid.slab(nz // 2, nz // 2 + 1), along


def _detail(pair: Pair) -> Pair:
    """Cut out where the aligned slice has most structure, away from the border."""
    rows, columns = pair.after.shape
    size = max(8, min(rows, columns) // 4)
    gradient = sum(g.astype(np.float64) ** 2 for g in np.gradient(pair.after))
    y, x = np.ogrid[:rows, :columns]
    inside = np.hypot(y - (rows - 1) / 2, x - (columns - 1) / 2) < 0.42 * min(rows, columns)
    total = np.pad(np.cumsum(np.cumsum(gradient * inside, axis=0), axis=1), ((1, 0), (1, 0)))
    energy = (
        total[size:, size:] - total[:-size, size:] - total[size:, :-size] + total[:-size, :-size]
    )
    top, left = np.unravel_index(int(energy.argmax()), energy.shape)
    window = np.s_[top : top + size, left : left + size]
    return Pair(pair.before[window], pair.after[window])


def _matches(
    stream: Stream,
    radiographs: Radiographs,
    geometry: ConeBeamGeometry,
    motion: Motion,
    confidence: NDArray[np.float64],
    valid_views: NDArray[np.bool_],
) -> tuple[tuple[MatchedView, ...], tuple[tuple[float, Pair], ...]]:
    chosen = _views_worth_showing(motion, confidence)
    views = sorted(chosen)
    measured = np.concatenate([radiographs.read(slice(view, view + 1)) for view in views])
    grid = _grid(geometry, radiographs.level)
    differences, simulated, picked = [], measured, []
    moved = geometry.with_motion(motion)
    for name, full, used in (("before", geometry, None), ("after", moved, valid_views)):
        here = full.binned(radiographs.level) if radiographs.level > 1 else full
        stage = f"report: volume {name}"
        volume = ramp_fbp(stream, radiographs, here, grid, valid_views=used, stage=stage)
        planes = _Picked(grid)
        volume.write(planes)
        picked.append(planes)
        simulated = _reprojected(stream, volume, here.subset(views))
        pairs = [_fitted(s, m) for s, m in zip(simulated, measured, strict=True)]
        simulated = np.stack(pairs)
        differences.append(
            [_without_background(m - s) for m, s in zip(measured, pairs, strict=True)]
        )
    matches = tuple(
        MatchedView(
            view=view,
            why=chosen[view],
            measured=measured[k],
            reprojected=simulated[k],
            difference=Pair(differences[0][k], differences[1][k]),
        )
        for k, view in enumerate(views)
    )
    before, after = picked
    heights = grid.coordinates()[2]
    slices = tuple(
        (float(heights[k]), Pair(before.planes[k], after.planes[k])) for k in before.wanted
    )
    return matches, slices


class _Picked:
    """Takes some planes of a volume, evenly from a tenth of its height to nine tenths."""

    def __init__(self, grid: VolumeGrid) -> None:
        last = grid.shape[0] - 1
        places = np.linspace(0.1 * last, 0.9 * last, _SLICES).round().astype(int)
        self.wanted = [int(k) for k in np.unique(places)]
        self.planes: dict[int, Image] = {}

    def write(self, start: int, part: Image) -> None:
        """Take planes (n, y, x) from plane `start` on."""
        for k in self.wanted:
            if start <= k < start + len(part):
                self.planes[k] = part[k - start].copy()


def _views_worth_showing(motion: Motion, confidence: NDArray[np.float64]) -> dict[int, str]:
    """Return the farthest moved view of the middle half, and the least sure one of all."""
    first, last = motion.views // 4, max(motion.views // 4 + 1, 3 * motion.views // 4)
    aside = np.hypot(
        motion.shift_u - np.median(motion.shift_u), motion.shift_v - np.median(motion.shift_v)
    )
    farthest = first + int(np.argmax(aside[first:last]))
    unsure = int(np.argmin(confidence))
    return {unsure: "least confidence", farthest: "farthest moved"}


def _reprojected(stream: Stream, volume: Volume, geometry: ConeBeamGeometry) -> Image:
    images = stream.empty((geometry.views, *geometry.shape))
    SlabProjector(stream, volume, geometry)(images, slice(0, geometry.views))
    return stream.download(images)


def _fitted(simulated: Image, measured: Image) -> Image:
    """Scale and offset of the re-projection that suit the measured radiograph best."""
    x, y = simulated.astype(np.float64), measured.astype(np.float64)
    spread = np.mean((x - x.mean()) ** 2)
    gain = np.mean((x - x.mean()) * (y - y.mean())) / spread if spread else 0.0
    return np.asarray(y.mean() + gain * (x - x.mean()), dtype=np.float32)


def _without_background(image: Image) -> Image:
    from scipy.ndimage import gaussian_filter

    return np.asarray(image - gaussian_filter(image, _BACKGROUND), dtype=np.float32)
