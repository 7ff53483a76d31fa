"""One resolution of a rigid alignment, whose work is shared out to several workers."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.reprojection import used_pixels
from clra.methods.alignment.rigid.rigid_level import RigidLevel, rigid_equations
from clra.methods.execution.executor import Held
from clra.methods.shared_work.shared_scan import SharedRadiographs, SharedScan
from clra.methods.shared_work.tasks import Measured
from clra.model.geometry import ConeBeamGeometry
from clra.ops.streaming.part_files import VolumeParts
from clra.ops.streaming.stream import Stream


@dataclass
class SharedRigidLevel(RigidLevel):
    """A level whose radiographs and volumes are in files.

    The normal equations of all views are solved by the caller: it takes all of them to tell how
    much noise is enlarged.

    Parameters
    ----------
    shared : SharedScan
        Its scan, and who does the work.
    """

    shared: SharedScan = field(kw_only=True)

    def reconstructed(
        self,
        radiographs: SharedRadiographs,
        geometry: ConeBeamGeometry,
        valid_views: NDArray[np.bool_],
        title: str,
    ) -> VolumeParts:
        """Return a volume of radiographs whose geometry has absorbed the motion."""
        return self.shared.fitted(
            radiographs,
            geometry,
            self.grid,
            positive=self.solver.positive,
            terms=self.solver.terms,
            used=used_pixels(self.scan, self.factor),
            valid_views=valid_views,
            circle=self.solver.circle,
            stage=title,
        )

    def _binned(self) -> SharedRadiographs:
        return self.shared.binned(self.stream, self.factor)

    def _simulated(
        self, volume: VolumeParts, geometry: ConeBeamGeometry, stage: str
    ) -> SharedRadiographs:
        return self.shared.simulated(volume, geometry, self.factor, stage)

    def _equations(
        self,
        radiographs: SharedRadiographs,
        volume: VolumeParts,
        geometry: ConeBeamGeometry,
        stage: str,
    ) -> NDArray[np.float64]:
        held, measured = self.shared.held, radiographs.measured
        return self.shared.table(RigidEquations(held, measured, volume, geometry, self.free), stage)


@dataclass(frozen=True)
class RigidEquations:
    """Compares some views with their re-projections; returns rows of normal equations."""

    scan: Held
    measured: Measured
    volume: VolumeParts
    geometry: ConeBeamGeometry
    free: tuple[int, ...]

    def __call__(self, stream: Stream, views: slice) -> NDArray[np.float64]:
        """Return a row a view, see :func:`clra.methods.alignment.rigid.rigid_solution.solve`."""
        return rigid_equations(
            stream,
            self.scan.get(),
            self.measured.some(stream, views),
            self.volume.volume(stream),
            self.geometry.subset(views),
            self.free,
            "registering",
        )
