"""What every method is made of, as tasks: chunks of views, and slabs of the volume."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.methods.execution.executor import Held, Task
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.methods.reconstruction.fitted_fbp import reprojections
from clra.model.geometry import ConeBeamGeometry
from clra.model.scan import Scan
from clra.ops.streaming.part_files import RadiographParts, TableParts, VolumeParts
from clra.ops.streaming.radiographs import PerView, Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import PlaneWriter, Volume


@dataclass(frozen=True)
class Measured:
    """Radiographs of a level: in files, or those of a scan at full resolution.

    Parameters
    ----------
    level : int
        Binning factor.
    source : RadiographParts or Held
        The files, or the scan.
    """

    level: int
    source: RadiographParts | Held

    def all(self, stream: Stream) -> Radiographs:
        """Return all of them."""
        if isinstance(self.source, RadiographParts):
            return Radiographs.of(self.source, self.level)
        return Radiographs(stream, self.source.get(), self.level)

    def some(self, stream: Stream, views: slice) -> Radiographs:
        """Return consecutive ones as radiographs of their own."""
        if isinstance(self.source, RadiographParts):
            return Radiographs.of(self.source.some(views), self.level)
        return Radiographs(stream, self.source.get().subset(views), self.level)


@dataclass(frozen=True)
class Bin:
    """Bins some radiographs of a scan into a file."""

    scan: Held
    target: RadiographParts
    level: int

    def __call__(self, stream: Stream, views: slice) -> None:
        """Bin views into their file."""
        scan: Scan = self.scan.get()
        binned = Radiographs(stream, scan.subset(views), self.level)
        self.target.write(views, binned.read(slice(0, views.stop - views.start)))


@dataclass(frozen=True)
class Tabulate:
    """Leaves numbers of some views in a file: more than a scheduler should have to pass on.

    Parameters
    ----------
    work : callable
        Task that returns rows (n, ...) for n views.
    target : TableParts
        Takes them.
    """

    work: Task[slice, NDArray[np.float64]]
    target: TableParts

    def __call__(self, stream: Stream, views: slice) -> None:
        """Do the work for views."""
        self.target.write(views, self.work(stream, views))


@dataclass(frozen=True)
class NumbersOf:
    """Returns numbers of some radiographs."""

    measured: Measured
    numbers: PerView

    def __call__(self, stream: Stream, views: slice) -> NDArray[np.float64]:
        """Return rows (n, ...) for views."""
        radiographs = self.measured.some(stream, views)

        def numbers(images: NDArray[np.float32], part: slice) -> NDArray[np.float64]:
            return self.numbers(images, slice(views.start + part.start, views.start + part.stop))

        return radiographs.tabulated(stream, numbers, "reading")


@dataclass(frozen=True)
class ReconstructSlab:
    """Reconstructs a slab by filtered back-projection.

    Parameters
    ----------
    measured : Measured
        Radiographs.
    geometry : ConeBeamGeometry
        Of these, with the motion absorbed.
    target : VolumeParts
        Takes the slabs.
    options : mapping
        Further keyword arguments of :func:`clra.methods.reconstruction.fbp.ramp_fbp`.
    onto : VolumeParts, optional
        In the same slabs: what is reconstructed is added to them, in files of their own, so that a
        task that is done again finds the old ones.
    """

    measured: Measured
    geometry: ConeBeamGeometry
    target: VolumeParts
    options: Mapping[str, Any]
    onto: VolumeParts | None = None

    def __call__(self, stream: Stream, index: int) -> None:
        """Reconstruct slab `index` into its file."""
        planes, grid = self.target.planes[index], self.target.grid
        onto = None
        if self.onto is not None:
            volumes = self.options.get("volumes", 1)
            onto = Volume(stream, grid.slab(planes.start, planes.stop), volumes=volumes)
            onto.put(0, self.onto.read(stream, index))
        volume = ramp_fbp(
            stream,
            self.measured.all(stream),
            self.geometry,
            grid,
            planes=planes,
            onto=onto,
            **self.options,
        )
        assert len(volume.planes) == 1  # slabs are cut to what the smallest device takes
        self.target.write(stream, index, volume.get(0))


@dataclass(frozen=True)
class Simulate:
    """Projects a volume into some views; `measured` gives what radiographs have beyond that."""

    volume: VolumeParts
    geometry: ConeBeamGeometry
    target: RadiographParts
    level: int
    measured: Measured | None = None
    used: NDArray[np.bool_] | None = None

    def __call__(self, stream: Stream, views: slice) -> None:
        """Project views into their file."""
        lacking_of = None
        if self.measured is not None and self.used is not None:
            lacking_of = self.measured.some(stream, views), self.used
        made = reprojections(
            stream,
            self.volume.volume(stream),
            self.geometry.subset(views),
            self.level,
            "simulating",
            lacking_of=lacking_of,
        )
        self.target.write(views, made.read(slice(0, views.stop - views.start)))


@dataclass(frozen=True)
class HandOn:
    """Hands some planes of a volume on.

    Parameters
    ----------
    volume : VolumeParts
        The volume.
    first : int
        Plane of it with which to begin.
    """

    volume: VolumeParts
    first: int

    def __call__(self, stream: Stream, planes: slice, target: PlaneWriter) -> None:
        """Hand planes on; both they and `target` count from the first of all and of them."""
        wanted = slice(self.first + planes.start, self.first + planes.stop)
        self.volume.volume(stream).write(target, wanted)
