"""A scan whose radiographs and volumes of all resolutions are files that workers share."""

import math
import shutil
import weakref
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clra.methods.execution.executor import (
    PARTS,
    Held,
    InProcess,
    Task,
    WorkerGroup,
    reconstruct_planes,
    slabs_of,
)
from clra.methods.reconstruction.fitted_fbp import VOLUMES, WINDOW
from clra.methods.shared_work.tasks import (
    Bin,
    HandOn,
    Measured,
    NumbersOf,
    ReconstructSlab,
    Simulate,
    Tabulate,
)
from clra.methods.truncation import extension
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid, default_grid
from clra.model.scan import Scan
from clra.ops.streaming.part_files import RadiographParts, TableParts, VolumeParts
from clra.ops.streaming.radiographs import PerView, Radiographs, Reading, read_here
from clra.ops.streaming.stream import Stream, equal_runs
from clra.ops.streaming.volume import PlaneSource, PlaneWriter

Kind = TypeVar("Kind")

# Views of a task at most: what a worker that is killed loses, and what one keeps on its host.
_MOST_VIEWS = 1024


class SharedRadiographs(Radiographs):
    """Radiographs of a level that tasks know as well.

    Attributes
    ----------
    measured : Measured
        What tasks know them by.
    shared : SharedScan or None
        Who reads them all, where numbers of each are asked for; None for the caller.
    """

    measured: Measured
    shared: "SharedScan | None" = None

    @classmethod
    def in_files(cls, parts: RadiographParts, level: int) -> "SharedRadiographs":
        """Return those of some files."""
        radiographs = cls.of(parts, level)
        radiographs.measured = Measured(level, parts)
        return radiographs

    def tabulated(self, stream: Stream, numbers: PerView, stage: str) -> NDArray[np.float64]:
        """Return numbers of each view, as tasks find them."""
        if self.shared is None:
            return super().tabulated(stream, numbers, stage)
        return self.shared.table(NumbersOf(self.measured, numbers), stage)


class SharedScan:
    """A scan whose radiographs and volumes of all resolutions are files that workers share.

    Files go when nobody needs them any more.

    Parameters
    ----------
    workers : WorkerGroup
        Who does the work.
    scan : Scan
        At full resolution.

    Attributes
    ----------
    held : Held
        The scan, for tasks.
    """

    def __init__(self, workers: WorkerGroup, scan: Scan) -> None:
        self.workers = workers
        self.scan = scan
        self.held: Held = workers.share(scan)

    def binned(self, stream: Stream, factor: int, *, keep: bool = False) -> SharedRadiographs:
        """Return the scan's radiographs, binned.

        Parameters
        ----------
        stream : Stream
            Of the caller, who reads a few of them.
        factor : int
            Binning factor.
        keep : bool
            Whether they are read once even if they are not binned.
        """
        if factor == 1 and not keep:
            radiographs = SharedRadiographs(stream, self.scan, 1)
            radiographs.measured = Measured(1, self.held)
        else:
            target = self.radiograph_parts("radiographs", factor)
            task = Bin(self.held, target, factor)
            stage = f"reading radiographs, binned {factor} x {factor}"
            self.workers.map(task, target.parts, stage=stage)
            radiographs = SharedRadiographs.in_files(target, factor)
        radiographs.shared = self
        return radiographs

    def fitted(
        self,
        radiographs: SharedRadiographs,
        geometry: ConeBeamGeometry,
        grid: VolumeGrid,
        *,
        positive: bool,
        terms: int,
        used: NDArray[np.bool_],
        valid_views: NDArray[np.bool_],
        circle: bool,
        beside: bool = False,
        stage: str,
    ) -> VolumeParts:
        """Reconstruct as :func:`clra.methods.reconstruction.fitted_fbp.fitted_fbp` does."""
        terms = terms if positive else 0
        options: dict[str, Any] = {
            "valid_views": valid_views,
            "circle": circle,
            "beside": beside,
            "extend": extension(radiographs, geometry, valid_views),
            "volumes": VOLUMES if terms else 1,
        }
        volume = self.volume_parts(grid, options["volumes"])
        slabs = range(len(volume.planes))
        first = options | {"positive": positive}
        self.workers.map(
            ReconstructSlab(radiographs.measured, geometry, volume, first),
            slabs,
            stage=f"{stage}: reconstructing",
        )
        for _ in range(terms):
            lacking = self.radiograph_parts("lacking", radiographs.level)
            simulate = Simulate(
                volume, geometry, lacking, radiographs.level, radiographs.measured, used
            )
            self.workers.map(simulate, lacking.parts, stage=f"{stage}: simulating")
            corrected = self.like(volume)
            source = Measured(radiographs.level, lacking)
            task = ReconstructSlab(
                source, geometry, corrected, options | {"window": WINDOW}, onto=volume
            )
            self.workers.map(task, slabs, stage=f"{stage}: correcting")
            volume = corrected
        return volume

    def simulated(
        self, volume: VolumeParts, geometry: ConeBeamGeometry, factor: int, stage: str
    ) -> SharedRadiographs:
        """Project a volume into all views."""
        target = self.radiograph_parts("simulated", factor)
        self.workers.map(Simulate(volume, geometry, target, factor), target.parts, stage=stage)
        return SharedRadiographs.in_files(target, factor)

    def source(self, volume: VolumeParts) -> "SharedVolume":
        """Return a volume in files as one that can be handed on."""
        return SharedVolume(self.workers, volume)

    def table(self, work: Task[slice, NDArray[np.float64]], stage: str) -> NDArray[np.float64]:
        """Do a task that returns rows (n, ...) for n views; return the rows of all views."""
        target = TableParts(self.workers.new_folder("table"))
        try:
            self.workers.map(Tabulate(work, target), self.chunks, stage=stage)
            return target.read(self.chunks)
        finally:
            shutil.rmtree(target.folder, ignore_errors=True)

    @cached_property
    def chunks(self) -> tuple[slice, ...]:
        """Views of each task."""
        each = chunks_each(self.workers.places, self.scan.geometry)
        return view_chunks(self.workers.places, self.scan.views, each)

    def radiograph_parts(
        self, name: str, factor: int, chunks: tuple[slice, ...] | None = None
    ) -> RadiographParts:
        """Return files for radiographs of a level: of all views, or of as many as chunks hold."""
        chunks = chunks or self.chunks
        shape = (chunks[-1].stop, *self.scan.geometry.binned(factor).shape)
        parts = RadiographParts(self.workers.new_folder(name), shape, chunks)
        weakref.finalize(parts, shutil.rmtree, parts.folder, ignore_errors=True)
        return parts

    def volume_parts(self, grid: VolumeGrid, volumes: int) -> VolumeParts:
        """Return files for a volume, of whose kind a device holds `volumes` slabs at a time."""
        workers = self.workers
        planes = tuple(slabs_of(workers.places, workers.slab_bytes, grid.shape, volumes))
        return self._in_slabs(grid, planes)

    def like(self, volume: VolumeParts) -> VolumeParts:
        """Return files for another volume in the same slabs."""
        return self._in_slabs(volume.grid, volume.planes)

    def _in_slabs(self, grid: VolumeGrid, planes: tuple[slice, ...]) -> VolumeParts:
        parts = VolumeParts(self.workers.new_folder("volume"), grid, planes)
        weakref.finalize(parts, shutil.rmtree, parts.folder, ignore_errors=True)
        return parts


class SharedVolume(PlaneSource):
    """A volume in files that workers hand on, so that the caller holds few planes at a time.

    Parameters
    ----------
    workers : WorkerGroup
        Who does the work.
    parts : VolumeParts
        The files.

    Attributes
    ----------
    grid : VolumeGrid
        Of the volume.
    parts : VolumeParts
        The files.
    """

    def __init__(self, workers: WorkerGroup, parts: VolumeParts) -> None:
        self.grid, self.parts = parts.grid, parts
        self._workers = workers

    def write(self, target: PlaneWriter, planes: slice | None = None) -> None:
        """Hand planes on; see :class:`clra.ops.streaming.volume.PlaneSource`."""
        nz, ny, nx = self.grid.shape
        wanted = planes or slice(0, nz)
        shape = (wanted.stop - wanted.start, ny, nx)
        task = HandOn(self.parts, wanted.start)
        # Not told: whoever ended the work early still wants what is finished.
        reconstruct_planes(
            self._workers, task, shape, target, stage="writing the volume", part=None
        )


def levels_by(
    executor: InProcess | WorkerGroup, scan: Scan, here: type[Kind], shared: Callable[..., Kind]
) -> Callable[..., Kind]:
    """Return what makes levels of a scan: here, or shared out to several workers.

    Parameters
    ----------
    executor : InProcess or WorkerGroup
        Who does the work.
    scan : Scan
        That the levels are of.
    here, shared : type
        Of a level; the latter takes a :class:`SharedScan` as `shared`.
    """
    if isinstance(executor, InProcess):
        return here
    return partial(shared, shared=SharedScan(executor, scan))


def reading_by(executor: InProcess | WorkerGroup, stream: Stream) -> Reading:
    """Return what reads radiographs: this process, or several workers.

    Parameters
    ----------
    executor : InProcess or WorkerGroup
        Who does the work.
    stream : Stream
        Of this process.
    """
    if isinstance(executor, InProcess):
        return read_here(stream)
    return lambda scan, level: SharedScan(executor, scan).binned(stream, level, keep=True)


def chunks_each(places: int, geometry: ConeBeamGeometry) -> int:
    """Return how many chunks of views a worker should have of those that read a volume.

    Several, so that a slow worker holds the others up less; but together they had better read no
    more of the volume, at half the resolution, than of the radiographs.

    Parameters
    ----------
    places : int
        Workers.
    geometry : ConeBeamGeometry
        Of the scan at full resolution.
    """
    images = geometry.views * geometry.rows * geometry.columns / 4
    volume = math.prod(default_grid(geometry).shape) / 8
    return int(np.clip(images / (places * volume), 1, PARTS))


def view_chunks(places: int, views: int, each: int = PARTS) -> tuple[slice, ...]:
    """Cut views into tasks: some for each worker, none of many views."""
    count = max(each * places, -(-views // _MOST_VIEWS))
    return tuple(equal_runs(views, min(views, count)))
