"""Multigrid reconstruction as tasks: what a level does with chunks of views and with slabs."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.reprojection import reprojected
from clra.methods.execution.executor import Held
from clra.methods.reconstruction.residuals import RadiographComparison, residual_chunks
from clra.methods.shared_work.tasks import Measured
from clra.model.geometry import ConeBeamGeometry
from clra.ops.streaming.multigrid import cropped, prolongate, restrict
from clra.ops.streaming.part_files import RadiographParts, VolumeParts
from clra.ops.streaming.stream import Stream

# The block that is averaged is eight times as large as what it gives.
_BLOCK_VOLUMES = 8


@dataclass(frozen=True)
class ProlongateSlab:
    """Interpolates a slab between the voxels of a volume that is half as fine."""

    coarse: VolumeParts
    target: VolumeParts

    def __call__(self, stream: Stream, index: int) -> None:
        """Write slab `index` of the target."""
        fine = prolongate(
            stream,
            self.coarse.volume(stream),
            self.target.grid,
            planes=self.target.planes[index],
        )
        self.target.write(stream, index, fine.get(0))


@dataclass(frozen=True)
class RestrictSlab:
    """Averages blocks of a volume that is twice as fine."""

    fine: VolumeParts
    target: VolumeParts

    def __call__(self, stream: Stream, index: int) -> None:
        """Write slab `index` of the target."""
        fine, planes = self.fine.volume(stream), self.target.planes[index]
        coarse = restrict(stream, fine, volumes=_BLOCK_VOLUMES, planes=planes)
        self.target.write(stream, index, cropped(stream, coarse, 0, coarse.grid).get(0))


@dataclass(frozen=True)
class RestoreSlab:
    """Writes a slab of an array (z, y, x) that is mapped from a file."""

    planes: NDArray[np.float32]
    target: VolumeParts

    def __call__(self, stream: Stream, index: int) -> None:
        """Write slab `index` of the target."""
        self.target.write_planes(index, self.planes)


@dataclass(frozen=True)
class CompareWithVolume:
    """Projects a volume into some views and compares; returns a deviance and ten numbers a view.

    Parameters
    ----------
    scan : Held
        At full resolution.
    measured : Measured
        Its radiographs, binned.
    volume : VolumeParts
        To project.
    geometry : ConeBeamGeometry
        Of all radiographs.
    known : ndarray, (views,)
        Magnification that it has absorbed.
    compare : RadiographComparison
        How to compare.
    target : RadiographParts
        Takes what is simulated.
    """

    scan: Held
    measured: Measured
    volume: VolumeParts
    geometry: ConeBeamGeometry
    known: NDArray[np.float64]
    compare: RadiographComparison
    target: RadiographParts

    def __call__(self, stream: Stream, views: slice) -> tuple[float, NDArray[np.float64] | None]:
        """Return what the comparison of some views does."""
        radiographs = self.measured.some(stream, views)
        volume, geometry = self.volume.volume(stream), self.geometry.subset(views)
        with self.target.writing(views) as write:
            return self.compare(
                stream,
                self.scan.get(),
                radiographs,
                reprojected(stream, radiographs, volume, geometry, "comparing"),
                self.known[views],
                lambda _, simulated: write(simulated),
            )


@dataclass(frozen=True)
class SubtractSimulated:
    """Subtracts simulated radiographs from the measured ones.

    Parameters
    ----------
    measured : Measured
        Binned radiographs.
    simulated : RadiographParts
        Of as many views.
    used : ndarray of bool, (rows, columns)
        Pixels that count.
    moved : ndarray, (views, 3), or None
        As for :func:`clra.methods.reconstruction.residuals.residual_chunks`.
    target : RadiographParts
        Takes what is left.
    """

    measured: Measured
    simulated: RadiographParts
    used: NDArray[np.bool_]
    moved: NDArray[np.float64] | None
    target: RadiographParts

    def __call__(self, stream: Stream, views: slice) -> None:
        """Subtract some views."""
        chunks = residual_chunks(
            stream,
            self.measured.some(stream, views),
            self.simulated.some(views),
            self.used,
            moved=None if self.moved is None else self.moved[views],
        )
        with self.target.writing(views) as write:
            for _, lacking in chunks:
                write(lacking)
