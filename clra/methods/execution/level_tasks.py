"""What an iteration of alignment is made of, as tasks: chunks of views, and slabs of the volume."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.options import Solver
from clra.methods.alignment.reprojection import register, reprojected
from clra.methods.execution.travelling import Shared
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.methods.reconstruction.fitted_fbp import VOLUMES, WINDOW, reprojections
from clra.model.geometry import ConeBeamGeometry
from clra.model.scan import Scan
from clra.ops.registration.gauss_newton import ESTIMATE_FIELDS
from clra.ops.streaming.part_files import RadiographParts, VolumeParts
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import Volume


@dataclass(frozen=True)
class Measured:
    """Radiographs of a level: in files, or those of a scan at full resolution.

    Parameters
    ----------
    level : int
        Binning factor.
    source : RadiographParts or Shared
        The files, or the scan.
    """

    level: int
    source: RadiographParts | Shared

    def all(self, stream: Stream) -> Radiographs:
        """Return all of them."""
        if isinstance(self.source, Shared):
            return Radiographs(stream, self.source.get(), self.level)
        return Radiographs.of(self.source, self.level)

    def some(self, stream: Stream, views: slice) -> Radiographs:
        """Return consecutive ones as radiographs of their own."""
        if isinstance(self.source, Shared):
            return Radiographs(stream, self.source.get().subset(views), self.level)
        return Radiographs.of(self.source.some(views), self.level)


@dataclass(frozen=True)
class Bin:
    """Bins some radiographs of a scan into a file."""

    scan: Shared
    target: RadiographParts
    level: int

    def __call__(self, stream: Stream, views: slice) -> None:
        """Bin views into their file."""
        scan: Scan = self.scan.get()
        binned = Radiographs(stream, scan.subset(views), self.level)
        self.target.write(views, binned.read(slice(0, views.stop - views.start)))


@dataclass(frozen=True)
class ReconstructSlab:
    """Reconstructs a slab by filtered back-projection; `onto` adds it to another volume's slab."""

    measured: Measured
    geometry: ConeBeamGeometry
    target: VolumeParts
    valid_views: NDArray[np.bool_]
    circle: bool
    beside: bool
    positive: bool
    extend: float
    volumes: int
    onto: VolumeParts | None = None

    def __call__(self, stream: Stream, index: int) -> None:
        """Reconstruct slab `index` into its file."""
        planes, grid = self.target.planes[index], self.target.grid
        onto = None
        if self.onto is not None:
            onto = Volume(stream, grid.slab(planes.start, planes.stop), volumes=self.volumes)
            onto.put(0, self.onto.read(stream, index))
        volume = ramp_fbp(
            stream,
            self.measured.all(stream),
            self.geometry,
            grid,
            valid_views=self.valid_views,
            circle=self.circle,
            beside=self.beside,
            extend=self.extend,
            positive=self.positive and onto is None,
            window="ram-lak" if onto is None else WINDOW,
            volumes=self.volumes,
            planes=planes,
            onto=onto,
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
class Register:
    """Registers some views with their re-projections; returns ten numbers a view."""

    scan: Shared
    measured: Measured
    volume: VolumeParts
    geometry: ConeBeamGeometry
    solver: Solver
    known: NDArray[np.float64]
    first: bool
    magnification: bool
    pulled: bool

    def __call__(self, stream: Stream, views: slice) -> NDArray[np.float64]:
        """Return a row a view, see ``ESTIMATE_FIELDS``."""
        radiographs = self.measured.some(stream, views)
        volume, geometry = self.volume.volume(stream), self.geometry.subset(views)
        estimator = self.solver.registration(
            stream,
            self.scan.get(),
            radiographs,
            first=self.first,
            magnification=self.magnification,
            pulled=self.pulled,
        )
        table = np.empty((geometry.views, len(ESTIMATE_FIELDS)))
        known = self.known[views]
        pairs = reprojected(stream, radiographs, volume, geometry, "registering")
        for chunk, measured, simulated in pairs:
            table[chunk] = register(stream, estimator, measured, simulated, known[chunk])
        return table


def planned_volumes(terms: int) -> int:
    """Return how many slabs a device holds at a time."""
    return VOLUMES if terms else 1
