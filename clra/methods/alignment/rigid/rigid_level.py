"""One resolution of a rigid alignment: reconstruct, project, and solve for six numbers a view."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.options import Solver
from clra.methods.alignment.reprojection import binned_mask, used_pixels
from clra.methods.alignment.rigid.rigid_solution import RigidStep, equations, solve
from clra.methods.reconstruction.fitted_fbp import fitted_fbp, reprojections
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.rigid.rigid_motion import RigidMotion
from clra.model.scan import Scan
from clra.ops.registration.rigid_registration import (
    IMAGES,
    PRODUCTS,
    RigidRegistration,
    rigid_table,
)
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.slab_projector import SlabMoments
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import Volume

Floats = NDArray[np.float64]

# Sigmas of the band-pass [pixel of the level]: the narrowest that splines allow, for rotations
# move fine structure far from the axis.
_BAND = (0.7, 8.0)


@dataclass
class RigidLevel:
    """The radiographs of one resolution, and what their re-projections are displaced by.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        At full resolution.
    grid : VolumeGrid
        At full resolution.
    solver : Solver
        Parts of the iteration.
    factor : int
        Binning.
    free : tuple of int
        Parameters to estimate, of `clra.model.rigid.rigid_motion.PARAMETERS`.
    prior : ndarray, (6,)
        Expected standard deviation of each parameter [mm, rad]; 0 for unknown.
    """

    stream: Stream
    scan: Scan
    grid: VolumeGrid
    solver: Solver
    factor: int
    free: tuple[int, ...]
    prior: Floats
    radiographs: Radiographs = field(init=False)
    bias: Floats | None = field(init=False, default=None)  # what is found where nothing moved

    def __post_init__(self) -> None:
        self.radiographs = self._binned()
        if self.factor > 1:
            self.grid = self.grid.binned(self.factor)

    def step(
        self, motion: RigidMotion, *, valid_views: NDArray[np.bool_], measure: bool, title: str
    ) -> RigidStep:
        """Return what is left of the motion.

        Parameters
        ----------
        motion : RigidMotion
            As known so far.
        valid_views : ndarray of bool, (views,)
            Views to reconstruct from.
        measure : bool
            Whether to find the bias, if it is not known.
        title : str
            What progress reports begin with.
        """
        geometry = self.scan.geometry.with_motion(motion).binned(self.factor)
        volume = self.reconstructed(self.radiographs, geometry, valid_views, title)
        found = self.registered(self.radiographs, volume, geometry, title)
        if measure and self.bias is None and self.solver.unbias:
            doing = f"{title}, of what is simulated"
            still = self._simulated(volume, geometry, doing)
            del volume
            again = self.reconstructed(still, geometry, valid_views, doing)
            self.bias = self.registered(still, again, geometry, doing).table
        return found if self.bias is None else found.less(self.bias)

    def registered(
        self, radiographs: Any, volume: Any, geometry: ConeBeamGeometry, title: str
    ) -> RigidStep:
        """Return what displaces radiographs against re-projections of a volume, view by view."""
        rows = self._equations(radiographs, volume, geometry, f"{title}: registering")
        return solve(rows, self.free, self.prior)

    def reconstructed(
        self,
        radiographs: Any,
        geometry: ConeBeamGeometry,
        valid_views: NDArray[np.bool_],
        title: str,
    ) -> Any:
        """Return a volume of radiographs whose geometry has absorbed the motion."""
        return fitted_fbp(
            self.stream,
            radiographs,
            geometry,
            self.grid,
            positive=self.solver.positive,
            terms=self.solver.terms,
            valid_views=valid_views,
            circle=self.solver.circle,
            used=used_pixels(self.scan, self.factor),
            stage=title,
        )

    def _binned(self) -> Radiographs:
        return Radiographs(self.stream, self.scan, self.factor)

    def _simulated(self, volume: Any, geometry: ConeBeamGeometry, stage: str) -> Radiographs:
        return reprojections(self.stream, volume, geometry, self.factor, stage)

    def _equations(
        self, radiographs: Any, volume: Any, geometry: ConeBeamGeometry, stage: str
    ) -> Floats:
        return rigid_equations(
            self.stream, self.scan, radiographs, volume, geometry, self.free, stage
        )


def rigid_equations(
    stream: Stream,
    scan: Scan,
    radiographs: Radiographs,
    volume: Volume,
    geometry: ConeBeamGeometry,
    free: tuple[int, ...],
    stage: str,
) -> Floats:
    """Return the normal equations of each view against re-projections of a volume.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        At full resolution, with its mask.
    radiographs : Radiographs
        Measured line integrals at the resolution of `geometry`.
    volume : Volume
        Reconstruction.
    geometry : ConeBeamGeometry
        Of the radiographs, with the motion known so far absorbed.
    free : tuple of int
        Parameters to estimate.
    stage : str
        What progress reports call this.

    Returns
    -------
    ndarray, (views, numbers)
        See :func:`clra.methods.alignment.rigid.rigid_solution.equations`.
    """
    mask = scan.registration_mask
    views, rows, columns = radiographs.shape
    # The registration keeps eight images of a view twice.
    chunks = stream.chunks(views, 2 * IMAGES * radiographs.view_bytes)
    register = RigidRegistration(
        stream.context,
        (rows, columns),
        views=max(chunk.stop - chunk.start for chunk in chunks),
        low_pass=_BAND[0],
        high_pass=_BAND[1],
        mask=None if mask is None else binned_mask(mask, radiographs.level),
        allocator=stream.memory,
    )
    project = SlabMoments(stream, volume, geometry)
    table, found = rigid_table(geometry), []
    for chunk in chunks:
        stream.report(stage, chunk.start, views)
        count = chunk.stop - chunk.start
        measured = stream.upload(radiographs.read(chunk))
        simulated, over_depth = (stream.empty((count, rows, columns)) for _ in range(2))
        project.moments(simulated, over_depth, chunk)
        out = stream.empty((count, register.blocks, PRODUCTS))
        numbers = stream.upload(table[chunk])
        register(stream.queue, out, measured, simulated, over_depth, numbers)
        totals = stream.download(out).astype(np.float64)
        found.append(equations(totals, free, register.total_weight, register.low_pass))
        del measured, simulated, over_depth, numbers, out
    stream.report(stage, views, views)
    return np.concatenate(found)
