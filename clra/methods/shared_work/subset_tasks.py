"""Steps of OSEM-TR as tasks: views of a subset are compared, then each slab is changed."""

from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pyopencl.array import Array

from clra.methods.execution.executor import Held
from clra.methods.ordered_subsets.passes import StepRule
from clra.methods.ordered_subsets.subset_rays import SubsetRays
from clra.methods.reconstruction.osem_tr import OrderedSubsets, ray_sums
from clra.methods.shared_work.tasks import Measured
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.view_selection import rows_that_see, runs, views_that_see
from clra.ops.statistics.poisson import RayStatistics
from clra.ops.streaming.multigrid import add_to_slab
from clra.ops.streaming.part_files import RadiographParts, VolumeParts
from clra.ops.streaming.slab_projector import SlabAdjoint, SlabProjector, constant_volume
from clra.ops.streaming.stream import Stream


@dataclass(frozen=True)
class SumRays:
    """Sums up line integrals of some views, and lengths of their rays; returns the two."""

    measured: Measured
    geometry: ConeBeamGeometry
    grid: VolumeGrid

    def __call__(self, stream: Stream, views: slice) -> tuple[float, float]:
        """Return what :func:`clra.methods.reconstruction.osem_tr.ray_sums` does."""
        radiographs = self.measured.some(stream, views)
        return ray_sums(stream, radiographs, self.geometry.subset(views), self.grid)


@dataclass(frozen=True)
class RaiseSlab:
    """Adds a value to a slab."""

    volume: VolumeParts
    target: VolumeParts
    value: float

    def __call__(self, stream: Stream, index: int) -> None:
        """Add it to slab `index`, into a file of its own."""
        grid = self.volume.grid.slab(*_ends(self.volume.planes[index]))
        raised = constant_volume(stream, grid, self.value)
        add_to_slab(stream, raised, 0, self.volume.read(stream, index))
        self.target.write(stream, index, raised.get(0))


@dataclass(frozen=True)
class Likelihood:
    """What tells how likely radiographs are; the same for all tasks.

    Parameters
    ----------
    options : OrderedSubsets
        Photons and background; not the volume to start from.
    used : ndarray of bool, (rows, columns)
        Pixels that count.
    """

    options: OrderedSubsets
    used: NDArray[np.bool_]

    def statistics(self, stream: Stream, level: int) -> RayStatistics:
        """Return the statistics of radiographs binned by `level`."""
        return self.options.statistics(stream, self.used, level)


@dataclass(frozen=True)
class SubsetViews:
    """Measured views in the order of their subsets.

    Parameters
    ----------
    likelihood : Held
        As :class:`Likelihood`.
    measured : Measured
        Radiographs of all views of the scan.
    order : ndarray of int, (n,)
        Views that are meant.
    geometry : ConeBeamGeometry
        Of these n views.
    grid : VolumeGrid
        Of the volume.
    """

    likelihood: Held
    measured: Measured
    order: NDArray[np.intp]
    geometry: ConeBeamGeometry
    grid: VolumeGrid

    def rays(
        self, stream: Stream, views: slice
    ) -> tuple[SubsetRays, ConeBeamGeometry, RayStatistics]:
        """Return the rays of some views, with their geometry and statistics."""
        geometry = self.geometry.subset(views)
        statistics = self.likelihood.get().statistics(stream, self.measured.level)
        rays = SubsetRays(
            stream, self.measured.all(stream), self.order[views], geometry, self.grid, statistics
        )
        return rays, geometry, statistics


@dataclass(frozen=True)
class WeighViews:
    """Weighs the rays of some views by their lengths and curvatures."""

    subset: SubsetViews
    target: RadiographParts

    def __call__(self, stream: Stream, views: slice) -> None:
        """Write images whose back-projection is the precomputed denominator."""
        rays, geometry, _ = self.subset.rays(stream, views)
        with self.target.writing(views) as write:
            for run in rays.runs(0, geometry.views):
                stream.report("weighing", run.start, geometry.views)
                write(stream.download(rays.weighted(run)))


@dataclass(frozen=True)
class CompareViews:
    """Projects a volume into some views of a subset and compares.

    Parameters
    ----------
    subset : SubsetViews
        Of the subset alone.
    volume : VolumeParts
        So far.
    numerator : RadiographParts
        Takes images whose back-projection is the numerator of the step.
    denominator : RadiographParts or None
        Takes those of the denominator, unless it is precomputed.
    """

    subset: SubsetViews
    volume: VolumeParts
    numerator: RadiographParts
    denominator: RadiographParts | None

    def __call__(self, stream: Stream, views: slice) -> float:
        """Compare views; return the mean deviance of their rays, times the number of views."""
        rays, geometry, statistics = self.subset.rays(stream, views)
        project = SlabProjector(stream, self.volume.volume(stream), geometry)
        update = self.subset.likelihood.get().options.update
        targets = [parts for parts in (self.numerator, self.denominator) if parts is not None]
        with ExitStack() as files:
            takers = [files.enter_context(parts.writing(views)) for parts in targets]
            for run, part in project.in_chunks(stream, rays.runs(0, geometry.views)):
                made = rays.compared(part, run, update)
                # the second is for nobody where the denominator is precomputed
                for write, images in zip(takers, made, strict=False):
                    assert images is not None
                    write(stream.download(images))
                del part, made, images
        return statistics.misfit(stream.queue, geometry.views) * geometry.views


@dataclass(frozen=True)
class BackProjectSlab:
    """Back-projects images, by the exact adjoint of the projection.

    Parameters
    ----------
    images : RadiographParts
        To be back-projected, all of them.
    geometry : ConeBeamGeometry
        Of these.
    target : VolumeParts
        Takes the slabs.
    """

    images: RadiographParts
    geometry: ConeBeamGeometry
    target: VolumeParts

    def __call__(self, stream: Stream, index: int) -> float:
        """Write slab `index`; return its largest value."""
        slab = back_projected(stream, self.images, self.geometry, self.target, index)
        self.target.write(stream, index, slab)
        return float(stream.download(slab).max())


@dataclass(frozen=True)
class StepSlab:
    """Changes a slab by what the views of a subset say of it.

    Parameters
    ----------
    volume : VolumeParts
        So far.
    images : RadiographParts
        Of the numerator.
    geometry : ConeBeamGeometry
        Of these.
    denominator : VolumeParts
        In the same slabs.
    largest : float
        Of the denominators of all slabs.
    rule : StepRule
        Of the step.
    target : VolumeParts
        Takes the changed slabs, so that a task that is done again finds the old ones.
    """

    volume: VolumeParts
    images: RadiographParts
    geometry: ConeBeamGeometry
    denominator: VolumeParts
    largest: float
    rule: StepRule
    target: VolumeParts

    def __call__(self, stream: Stream, index: int) -> None:
        """Write slab `index`, changed."""
        numerator = back_projected(stream, self.images, self.geometry, self.target, index)
        slab, below = self.volume.read(stream, index), self.denominator.read(stream, index)
        self.rule(stream, slab, numerator, below, self.largest)
        self.target.write(stream, index, slab)


def back_projected(
    stream: Stream,
    images: RadiographParts,
    geometry: ConeBeamGeometry,
    parts: VolumeParts,
    index: int,
) -> Array:
    """Return the adjoint of images, (ny, nx, planes) of slab `index` of a volume's parts.

    Only rows that see the slab are read.
    """
    grid = parts.grid.slab(*_ends(parts.planes[index]))
    total = constant_volume(stream, grid)
    assert len(total.planes) == 1  # slabs are cut to what the smallest device takes
    adjoint = SlabAdjoint(stream, total, geometry)
    # Rays beside the outermost voxels count for them, up to the next ones.
    nz, ny, nx = (count + 2 for count in grid.shape)
    wider = VolumeGrid(shape=(nz, ny, nx), voxel_size=grid.voxel_size, centre=grid.centre)
    rows = rows_that_see(geometry, wider)
    view_bytes = 4 * images.shape[1] * images.shape[2]
    for run in runs(views_that_see(geometry, grid)):
        for chunk in stream.chunks(run.stop - run.start, view_bytes):
            start, stop = run.start + chunk.start, run.start + chunk.stop
            stream.report("back-projecting", start, geometry.views)
            seen = slice(int(rows[start:stop, 0].min()), int(rows[start:stop, 1].max()))
            # A CPU reads them in place.
            host = np.zeros((stop - start, *images.shape[1:]), np.float32)
            host[:, seen] = images.read(start, stop, seen)
            adjoint(total, stream.upload(host), slice(start, stop))
            stream.queue.finish()
    return total.get(0)


def _ends(planes: slice) -> tuple[int, int]:
    return planes.start, planes.stop
