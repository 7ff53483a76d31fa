"""Volumes in files that workers share, on their way out."""

from dataclasses import dataclass

from clra.methods.execution.executor import WorkerGroup, reconstruct_planes
from clra.model.grid import VolumeGrid
from clra.ops.streaming.multigrid import cropped
from clra.ops.streaming.part_files import VolumeParts
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import KeptVolume, PlaneWriter


@dataclass(frozen=True)
class SharedVolume(KeptVolume):
    """Planes of a volume that is in files; workers hand them on.

    Parameters
    ----------
    workers : WorkerGroup
        Who does it.
    parts : VolumeParts
        The volume.
    grid : VolumeGrid
        Of the planes.
    first : int
        Plane of the volume with which they begin.
    """

    workers: WorkerGroup
    parts: VolumeParts
    grid: VolumeGrid
    first: int = 0

    def write(self, target: PlaneWriter) -> None:
        """Hand all planes on, (z, y, x), some at a time."""
        work = PlanesOfVolume(self.parts, self.grid, self.first)
        reconstruct_planes(self.workers, work, self.grid.shape, target, stage="writing planes")


@dataclass(frozen=True)
class PlanesOfVolume:
    """Hands on some planes of a volume: a task."""

    volume: VolumeParts
    grid: VolumeGrid
    first: int

    def __call__(self, stream: Stream, planes: slice, target: PlaneWriter) -> None:
        """Hand on planes of the grid; `target` counts them from the first of these."""
        part = self.grid.slab(planes.start, planes.stop)
        first = self.first + planes.start
        cropped(stream, self.volume.volume(stream), first, part).write(target)
