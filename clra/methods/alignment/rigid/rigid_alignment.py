"""Alignment by rigid motion of the sample: translations and rotations of each view.

The shifts of Algorithms 1 and 2 come first: they are most of what shows. Then the same iteration
goes on with up to six parameters a view, which are solved for together from the derivatives of the
re-projection.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.options import Solver
from clra.methods.alignment.region import Region
from clra.methods.alignment.rejected_views import outliers
from clra.methods.alignment.result import AlignmentResult, Iteration
from clra.methods.alignment.rigid.rigid_level import RigidLevel
from clra.methods.alignment.rigid.rigid_solution import RigidStep
from clra.model.gauge.gauge import sample_points
from clra.model.rigid.rigid_gauge import without_rigid_gauge
from clra.model.rigid.rigid_motion import RigidMotion
from clra.model.scan import Scan
from clra.model.schedule import level_name
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

FREE = {
    "rigid": (0, 1, 2, 3, 4, 5),
    "shift+roll": (0, 1, 5),
    "shift+scale+roll": (0, 1, 2, 5),
}
"""Parameters of `clra.model.rigid.rigid_motion.PARAMETERS` that each kind of estimate frees."""

# Expected standard deviation of a step along the beam [voxel at full resolution] and of rotations
# [rad]; shifts are not held. A step along the beam is seen 50 times less well than one across it.
_BEAM, _TURN = 0.5, 3e-3
# Longest step [voxel of the level; rad times the binning]: beyond, derivatives mean nothing.
_LONGEST, _STEEPEST = 2.0, 0.02
# Iterations by binning: of small detectors, whose finest details are needed, and of large ones.
_SMALL, _LARGE = ((2, 2), (1, 4)), ((4, 2), (2, 3))
_LARGE_FROM = 384  # pixels of the shorter side
_BIAS_AFTER = 2  # iterations of a level, when most of the motion is in


def rigid_stages(shape: tuple[int, int]) -> tuple[tuple[int, int], ...]:
    """Return binnings and iterations for a detector of (rows, columns)."""
    return _LARGE if min(shape) >= _LARGE_FROM else _SMALL


@dataclass
class RigidAlignment:
    """One alignment in several degrees of freedom.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        At full resolution.
    region : Region
        Where to reconstruct, at full resolution.
    solver : Solver
        Parts of the iteration.
    estimate : str
        A key of `FREE`.
    start : AlignmentResult
        Of the shifts alone.
    anchor : bool
        Whether to take the movement of the sample as a whole out of the motion.
    """

    stream: Stream
    scan: Scan
    region: Region
    solver: Solver
    estimate: str
    start: AlignmentResult
    anchor: bool
    motion: RigidMotion = field(init=False)
    history: list[Iteration] = field(init=False)
    rejected: NDArray[np.bool_] = field(init=False)
    last: RigidStep = field(init=False)

    def __post_init__(self) -> None:
        self.motion = RigidMotion.from_shifts(self.start.motion, self.scan.geometry)
        self.history = list(self.start.history)
        self.rejected = ~self.start.valid_views
        self.points = sample_points(self.region.sample, count=200)

    def align(self, stages: Sequence[tuple[int, int]] | None = None) -> AlignmentResult:
        """Go through the resolutions; a stage is a binning and a number of iterations."""
        for factor, iterations in stages or rigid_stages(self.scan.geometry.shape):
            self._align_level(factor, iterations)
        return self.result()

    def _align_level(self, factor: int, iterations: int) -> None:
        voxel = self.region.grid.voxel_size
        prior = np.array([0, 0, _BEAM * voxel, _TURN, _TURN, _TURN])
        free = FREE[self.estimate]
        # What lies beside the circle that all views see is projected as well, if there is anything.
        solver = replace(self.solver, circle=self.solver.circle and not self.region.truncated)
        level = RigidLevel(self.stream, self.scan, self.region.grid, solver, factor, free, prior)
        longest = factor * np.array([_LONGEST * voxel] * 3 + [_STEEPEST] * 3)
        for iteration in range(1, iterations + 1):
            started = time.perf_counter()
            name = level_name(factor)
            step = level.step(
                self.motion,
                valid_views=~self.rejected,
                measure=iteration >= min(_BIAS_AFTER, iterations),
                title=f"{name}, {self.estimate} {iteration}/{iterations}",
            )
            table = np.clip(step.table, -longest, longest)
            self.rejected |= outliers(step.correlation)
            table = self._interpolated(table)
            before = self.motion
            self.motion = self.motion.then(self.motion.with_table(table))
            if self.anchor:
                self.motion = without_rigid_gauge(self.motion, self.scan.geometry, self.points)
            self.last = step
            moved = np.stack(
                [self.motion.shift_u - before.shift_u, self.motion.shift_v - before.shift_v]
            )
            self.history.append(
                Iteration.of(
                    name,
                    iteration,
                    moved,
                    step.correlation,
                    step.residual,
                    time.perf_counter() - started,
                )
            )

    def _interpolated(self, table: Floats) -> Floats:
        """Give rejected views the step between their neighbours'."""
        if not self.rejected.any() or self.rejected.all():
            return table
        views = np.arange(len(table))
        valid = views[~self.rejected]
        columns = [np.interp(views, valid, column[valid]) for column in table.T]
        return np.stack(columns, axis=1)

    def result(self) -> AlignmentResult:
        """Return what the iterations so far gave."""
        valid = ~self.rejected
        return AlignmentResult(
            motion=self.motion,
            valid_views=valid,
            confidence=np.clip(np.where(valid, self.last.correlation, 0.0), 0.0, 1.0),
            sigma=self._sigma(),
            history=tuple(self.history),
            gauge=self.start.gauge,
            schedule=self.start.schedule,
            device=self.start.device,
        )

    def _sigma(self) -> Floats:
        """Return standard errors of shifts [pixel], magnification and rotations [rad]."""
        near, per_u, per_v = self.motion.optics[:, :3].T
        sigma = self.last.sigma.copy()
        for column, factor in enumerate((per_u / near, per_v / near, 1 / near)):
            sigma[:, column] *= factor
        return sigma
