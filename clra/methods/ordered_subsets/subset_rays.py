"""Rays of some views, in an order of their own, and what the likelihood says of them."""

import numpy as np
from numpy.typing import NDArray
from pyopencl.array import Array

from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.ops.statistics.poisson import RayStatistics
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.slab_projector import ConstantVolume, SlabProjector
from clra.ops.streaming.stream import Stream

VOLUMES = 4
"""Volume, numerator, denominator, and one of ones: all on the device, or all in slabs."""


class SubsetRays:
    """Radiographs in the order of their subsets, compared with a volume.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    radiographs : Radiographs
        Measured line integrals, of all views of the scan.
    order : ndarray of int, (n,)
        Views that are meant, in their order here.
    geometry : ConeBeamGeometry
        Of these n views, in their order here.
    grid : VolumeGrid
        Of the volume.
    statistics : RayStatistics
        Of the rays; sums up their deviance.
    """

    def __init__(
        self,
        stream: Stream,
        radiographs: Radiographs,
        order: NDArray[np.intp],
        geometry: ConeBeamGeometry,
        grid: VolumeGrid,
        statistics: RayStatistics,
    ) -> None:
        self._stream, self._radiographs, self._order = stream, radiographs, order
        self._geometry, self._grid, self._statistics = geometry, grid, statistics
        self._chords: SlabProjector | None = None

    def runs(self, start: int, stop: int) -> list[slice]:
        """Cut the views `start` to `stop - 1` into runs that fit the device."""
        chunks = self._stream.chunks(stop - start, self._radiographs.view_bytes)
        return [slice(start + chunk.start, start + chunk.stop) for chunk in chunks]

    def weighted(self, views: slice) -> Array:
        """Return a c of some views: lengths within the volume by curvatures, both as measured.

        Back-projected, they are the denominator of steps with precomputed curvatures.
        """
        weighted, measured = self._lengths(views), self._measured(views)
        self._statistics.curvature(self._stream.queue, weighted, weighted, measured)
        self._stream.queue.finish()  # before the host's radiographs may go
        return weighted

    def compared(self, simulated: Array, views: slice, update: str) -> tuple[Array, Array | None]:
        """Compare some views with their projections; the deviance is added to the sum.

        Parameters
        ----------
        simulated : Array
            Line integrals of the volume (n, rows, columns); changed.
        views : slice
            In their order here.
        update : str
            As for :class:`clra.methods.reconstruction.osem_tr.OrderedSubsets`.

        Returns
        -------
        numerator, denominator : Array
            Images (n, rows, columns) that, back-projected, are those of the step; no denominator
            where it is precomputed.
        """
        queue, statistics = self._stream.queue, self._statistics
        measured = self._measured(views)
        statistics.deviance(queue, simulated, measured)
        other = None
        if update == "multiplicative":
            other = self._stream.empty(simulated.shape)
            statistics.balance(queue, simulated, other, measured)
        else:
            if update == "optimal":
                other = self._lengths(views)
                statistics.optimal_curvature(queue, other, simulated, other, measured)
            statistics.gradient(queue, simulated, simulated, measured)
        queue.finish()  # before the host's radiographs may go
        return simulated, other

    def projected(self, project: SlabProjector, views: slice) -> Array:
        """Project a volume, by the geometry of these rays, into some views."""
        integrals = self._stream.empty((views.stop - views.start, *self._geometry.shape))
        project(integrals, views)
        return integrals

    def release(self) -> None:
        """Let go of what lengths of rays are computed from."""
        self._chords = None

    def _measured(self, views: slice) -> Array:
        """Line integrals of some of the views."""
        read, chosen = self._radiographs.read, self._order[views]
        return self._stream.upload(np.concatenate([read(slice(v, v + 1)) for v in chosen]))

    def _lengths(self, views: slice) -> Array:
        """Length of each ray within the volume [mm]."""
        if self._chords is None:
            ones = ConstantVolume(self._stream, self._grid, 1.0, volumes=VOLUMES)
            self._chords = SlabProjector(self._stream, ones, self._geometry)
        return self.projected(self._chords, views)
