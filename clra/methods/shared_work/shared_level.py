"""One resolution of an alignment, whose work is shared out to several workers."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.level import At, Level
from clra.methods.alignment.options import Solver
from clra.methods.alignment.reprojection import (
    Registered,
    in_full_pixels,
    register,
    reprojected,
)
from clra.methods.execution.executor import Held
from clra.methods.shared_work.shared_scan import SharedRadiographs, SharedScan
from clra.methods.shared_work.tasks import Measured
from clra.model.geometry import ConeBeamGeometry
from clra.ops.registration.gauss_newton import ESTIMATE_FIELDS
from clra.ops.streaming.part_files import VolumeParts
from clra.ops.streaming.stream import Stream


@dataclass
class SharedLevel(Level):
    """A level whose radiographs and volumes are in files.

    The gauge, acceleration and the stop rule stay with the caller.

    Parameters
    ----------
    shared : SharedScan
        Its scan, and who does the work.
    """

    shared: SharedScan = field(kw_only=True)

    def _binned(self) -> SharedRadiographs:
        return self.shared.binned(self.stream, self.factor)

    def _reconstructed(self, at: At, radiographs: SharedRadiographs, stage: str) -> VolumeParts:
        return self.shared.fitted(
            radiographs,
            at.geometry,
            self.grid,
            positive=self.solver.positive,
            terms=self.terms,
            used=self.used,
            valid_views=at.valid_views,
            circle=self.circle,
            beside=self.region.truncated,
            stage=stage,
        )

    def _registered(
        self, at: At, radiographs: SharedRadiographs, volume: VolumeParts, stage: str
    ) -> Registered:
        task = Register(
            self.shared.held,
            radiographs.measured,
            volume,
            at.geometry,
            self.solver,
            at.known,
            at.first,
            at.magnification,
            at.pulled,
        )
        tables = self.shared.workers.map(task, self.shared.chunks, stage=stage)
        return in_full_pixels(np.concatenate(tables), self.factor, self.scan.geometry.shape)

    def _simulated(self, at: At, volume: VolumeParts, stage: str) -> SharedRadiographs:
        return self.shared.simulated(volume, at.geometry, self.factor, stage)


@dataclass(frozen=True)
class Register:
    """Registers some views with their re-projections; returns ten numbers a view."""

    scan: Held
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
