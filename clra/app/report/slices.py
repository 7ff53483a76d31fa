"""Slices of a scan without and with its motion corrected, by the best method for its trajectory."""

import numpy as np
from numpy.typing import NDArray

from clra.methods.correction import corrected
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.methods.reconstruction.imgr import imgr
from clra.methods.reconstruction.katsevich import exact_helices, katsevich
from clra.methods.reconstruction.missing_views import without_gaps
from clra.model.binning import binned_motion
from clra.model.grid import VolumeGrid, default_grid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

Image = NDArray[np.float32]


class Slicer:
    """Reconstructs slices, before and after correction.

    Katsevich's method where it can treat the scan, which then is corrected by resampling; else
    ramp-filtered back-projection, with the motion absorbed into the geometry.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        As measured, at full resolution.
    motion : Motion
        Of its views.
    level : int
        Binning factor to reconstruct at.
    valid_views : ndarray of bool, (views,), optional
        Views for the slices after correction, all by default.

    Attributes
    ----------
    grid : VolumeGrid
        Of the whole field of view at that level.
    method : str
        What it reconstructs by, for reading.
    """

    def __init__(
        self,
        stream: Stream,
        scan: Scan,
        motion: Motion,
        level: int,
        valid_views: NDArray[np.bool_] | None = None,
    ) -> None:
        grid = default_grid(scan.geometry)
        self.grid = grid.binned(level) if level > 1 else grid
        self._stream, self._valid_views = stream, valid_views
        self._radiographs = Radiographs(stream, scan, level)
        before, after = scan.geometry, scan.geometry.with_motion(motion)
        self._geometries = [g.binned(level) if level > 1 else g for g in (before, after)]
        if level > 1:
            scan = Scan(self._radiographs, self._geometries[0])
        try:
            whole = without_gaps(scan)
            helical = Radiographs(stream, whole, 1)
            exact_helices(helical, whole.geometry, self.grid)
            # Rotations of the sample are more than resampling can undo.
            ideal = corrected(stream, scan, binned_motion(motion, level, before.shape))
        except ValueError:
            self.method = "ramp-filtered back-projection"
            return
        self.method = "Katsevich's method"
        self._helical = helical, Radiographs(stream, without_gaps(ideal, valid_views), 1)
        self._geometries = [whole.geometry] * 2

    def images(self, plane: VolumeGrid) -> tuple[Image, Image]:
        """Reconstruct a slice before and after correction.

        Parameters
        ----------
        plane : VolumeGrid
            One plane of :attr:`grid`, or one row of it along y.

        Returns
        -------
        ndarray, ndarray
            float32 (y, x), or (z, x) with the top of the sample first [1/mm].
        """
        before, after = self._geometries
        stream, stage = self._stream, "report: slices"
        if self.method.startswith("ramp"):
            volumes = [
                ramp_fbp(
                    stream, self._radiographs, geometry, plane, valid_views=valid_views, stage=stage
                )
                for geometry, valid_views in ((before, None), (after, self._valid_views))
            ]
        else:
            volumes = [
                katsevich(stream, radiographs, before, plane, stage=stage)
                for radiographs in self._helical
            ]
        without, corrected_one = (_upright(volume.to_host()) for volume in volumes)
        return without, corrected_one


class MultigridSlicer:
    """Slices of volumes by multigrid iteration, without alignment and with it.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        As measured: it is reconstructed once more, without alignment.
    volume : ndarray, (nz, ny, nx)
        Aligned, on the grid of the whole field of view.

    Attributes
    ----------
    grid : VolumeGrid
        Of the whole field of view.
    method : str
        What it reconstructs by, for reading.
    """

    method = "multigrid iteration, without and with alignment inside"

    def __init__(self, stream: Stream, scan: Scan, volume: Image) -> None:
        self.grid = default_grid(scan.geometry)
        self._volumes = imgr(stream, scan, self.grid).volume.to_host(), volume

    def images(self, plane: VolumeGrid) -> tuple[Image, Image]:
        """Cut a slice out of both, as :meth:`Slicer.images` does."""
        corner = [axis[0] for axis in plane.coordinates()]
        start = [
            int(np.argmin(np.abs(axis - first)))
            for axis, first in zip(self.grid.coordinates(), corner, strict=True)
        ]
        window = tuple(slice(a, a + n) for a, n in zip(start[::-1], plane.shape, strict=True))
        without, aligned = (_upright(volume[window]) for volume in self._volumes)
        return without, aligned


def _upright(volume: Image) -> Image:
    """Image of a volume of one plane or of one row."""
    return np.ascontiguousarray(volume[0] if len(volume) == 1 else volume[::-1, 0])
