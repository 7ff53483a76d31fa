"""A few slices of a scan and how sharp they are, wherever the detector stands."""

import numpy as np
from numpy.typing import NDArray

from clra.model.detector_pose import with_detector
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid, default_grid
from clra.model.motion import Motion
from clra.model.rotation_sense import opposite_rotation
from clra.model.scan import Scan
from clra.ops.filtering.ramp import RampFilter, taper
from clra.ops.projection.projector import BackProjector
from clra.ops.streaming.memory import DeviceMemoryError
from clra.ops.streaming.radiographs import Reading, read_here
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

VIEWS = 240
"""Views that are looked at, at most."""
# Most columns; part of the rows over which a view fades out, as for ramp-filtered back-projection;
# and part of the field of view's radius in which sharpness counts.
_COLUMNS, _FADE, _INSIDE = 200, 0.1, 0.9
# Slices, and the part of the field of view's height over which they are spread: a tilt shows far
# from the middle, as an offset that changes with height.
_PLANES, _REACH = 7, 0.8


def sharpening_by_opposite_rotation(
    stream: Stream, scan: Scan, motion: Motion, reading: Reading | None = None
) -> float:
    """How much sharper slices would be if the sample turned the other way.

    Radiographs of a narrow beam fit a wrong sense nearly as well as the right one, by a mirrored
    volume that is sharp near the axis and smeared far from it.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        Any.
    motion : Motion
        Of its views, as far as known.
    reading : callable, optional
        Reads radiographs; this process by default.

    Returns
    -------
    float
        Mean squared gradient of a slice, relative to that of the scan's own sense, median over a
        few of them: what a circle sees at the ends of its height is sharp by artefacts. 1 where the
        senses cannot be told apart, as in a parallel beam; less where the own one is right; nan if
        a few slices want more memory than there may be.
    """
    chosen = slice(0, None, max(1, scan.views // VIEWS))
    scan, motion = scan.subset(chosen), motion.subset(chosen)
    ours, other = (g.with_motion(motion) for g in (scan.geometry, opposite_rotation(scan.geometry)))
    try:
        slices = Slices(stream, scan, ours, reading=reading)
        slices.sharpnesses(ours)
        return float(np.median(slices.sharpnesses(other)))
    except DeviceMemoryError:
        return float("nan")


class Slices:
    """Slices of a scan whose filtered radiographs are kept, for any detector."""

    def __init__(
        self,
        stream: Stream,
        scan: Scan,
        geometry: ConeBeamGeometry,
        columns: int = _COLUMNS,
        inside: float = _INSIDE,
        reading: Reading | None = None,
    ) -> None:
        self.stream, self._geometry = stream, geometry
        # Pixels of the full detector in one of these radiographs.
        self.pixel = next((n for n in (1, 2, 4) if geometry.columns // n <= columns), 8)
        radiographs = (reading or read_here(stream))(scan, self.pixel)
        binned = geometry.binned(self.pixel)
        self._filtered = stream.empty(radiographs.shape)
        ramp = RampFilter(
            stream.context,
            binned,
            row_weight=taper(binned.rows, _FADE),
            allocator=stream.memory,
            scratch_limit=stream.scratch_limit,
        )
        for views in stream.chunks(scan.views, radiographs.view_bytes):
            stream.report("slices: filtering", views.start, scan.views)
            measured = stream.upload(radiographs.read(views))
            ramp(stream.queue, self._filtered[views], measured, views=views).wait()
        grid = default_grid(scan.geometry).binned(self.pixel)
        nz, ny, nx = grid.shape
        apart = _REACH * nz / (_PLANES - 1)
        # Planes far apart are neighbours in a world that is squeezed along z.
        self._squeeze = (grid.centre[2], max(apart, 1.0))
        x0, y0, _ = grid.centre
        self._planes = VolumeGrid(
            shape=(_PLANES, ny, nx), voxel_size=grid.voxel_size, centre=(x0, y0, 0.0)
        )
        self._back = BackProjector(
            stream.context, self._squeezed(binned), self._planes, volume_order="yxz"
        )
        y, x = np.ogrid[:ny, :nx]
        radius = 0.5 * inside * min(nx, ny)
        self._inside = np.hypot(y - (ny - 1) / 2, x - (nx - 1) / 2) < radius
        self._first: Floats | None = None

    def sharpness(self, offset: float, tilt: float) -> float:
        """Mean over the slices of their sharpness with the detector elsewhere."""
        moved = with_detector(self._geometry, offset_u=offset, tilt=tilt)
        return float(np.mean(self.sharpnesses(moved)))

    def sharpnesses(self, geometry: ConeBeamGeometry) -> Floats:
        """Return the mean squared gradient of each slice, relative to the first call's."""
        self._back.set_geometry(self._squeezed(geometry.binned(self.pixel)))
        nz, ny, nx = self._planes.shape
        images = self.stream.empty((ny, nx, nz))
        self._back(self.stream.queue, images, self._filtered).wait()
        slices = self.stream.download(images).astype(np.float64)
        slopes = np.gradient(slices, axis=(0, 1))
        energy = np.mean((slopes[0] ** 2 + slopes[1] ** 2)[self._inside], axis=0)
        if self._first is None:
            self._first = np.where(energy > 0, energy, 1.0)
        return np.asarray(energy / self._first)

    @property
    def structure(self) -> bool:
        """Whether any slice was more than constant."""
        return self._first is not None and bool(np.any(self._first != 1.0))

    def _squeezed(self, geometry: ConeBeamGeometry) -> ConeBeamGeometry:
        """Return the geometry in a world whose heights are divided; pixels see the same."""
        middle, factor = self._squeeze
        vectors = geometry.to_astra().reshape(-1, 4, 3)
        vectors[:, :2, 2] -= middle
        vectors[:, :, 2] /= factor
        return ConeBeamGeometry.from_astra(vectors.reshape(-1, 12), geometry.shape)
