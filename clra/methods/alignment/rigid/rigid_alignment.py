"""Alignment by rigid motion of the sample: translations and rotations of each view.

The shifts of Algorithms 1 and 2 come first: they are most of what shows. Then the same iteration
goes on with up to six parameters a view, which are solved for together from the derivatives of the
re-projection.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from clra.errors import Cancelled
from clra.findings import Finding
from clra.methods.alignment.options import Solver
from clra.methods.alignment.region import Region
from clra.methods.alignment.rejected_views import outliers
from clra.methods.alignment.result import (
    AlignmentInterrupted,
    AlignmentResult,
    Iteration,
    finished,
)
from clra.methods.alignment.rigid.observability import held
from clra.methods.alignment.rigid.rigid_level import RigidLevel
from clra.methods.alignment.rigid.rigid_state import RigidState
from clra.methods.execution.checkpoint import Checkpoint, Saved
from clra.methods.execution.packing import State
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
    checkpoint : Checkpoint, optional
        Keeps each finished iteration.
    shifts : (dict, dict), optional
        By which the alignment of the shifts goes on, kept beside it.
    make_level : callable
        Makes a :class:`RigidLevel` of its first seven arguments.
    """

    stream: Stream
    scan: Scan
    region: Region
    solver: Solver
    estimate: str
    start: AlignmentResult
    anchor: bool
    checkpoint: Checkpoint | None = None
    shifts: State = field(default_factory=lambda: ({}, {}))
    make_level: Callable[..., RigidLevel] = RigidLevel
    done: RigidState = field(init=False)

    def __post_init__(self) -> None:
        motion = RigidMotion.from_shifts(self.start.motion, self.scan.geometry)
        self.done = RigidState(motion, ~self.start.valid_views, list(self.start.history))
        self.points = sample_points(self.region.sample, count=200)

    def align(
        self, saved: Saved | None = None, stages: Sequence[tuple[int, int]] | None = None
    ) -> AlignmentResult:
        """Go through the resolutions, or what is left of them; what is finished stays if it ends.

        Parameters
        ----------
        saved : Saved, optional
            What a checkpoint holds, of this alignment or of the shifts alone.
        stages : sequence of (int, int), optional
            Binnings and numbers of iterations; those of `rigid_stages` by default.

        Raises
        ------
        AlignmentInterrupted
            On Ctrl-C; carries the result so far.
        """
        try:
            self._align(saved, stages or rigid_stages(self.scan.geometry.shape))
        except Cancelled:
            done = finished(self.done.history)
            Finding("cancelled", f"the alignment was ended early, after {done}").warn()
        except KeyboardInterrupt:
            raise AlignmentInterrupted(self.result()) from None
        return self.result()

    def _align(self, saved: Saved | None, stages: Sequence[tuple[int, int]]) -> None:
        self.done = (saved and RigidState.kept(saved)) or self.done
        first, begun = self.done.position
        for index, (factor, iterations) in enumerate(stages):
            if index > first:
                self.done = replace(self.done, bias=None, slow=type(self.done.slow)())
            if index >= first and (index > first or begun < iterations):
                self._align_level(factor, iterations, index, begun if index == first else 0)
        table = self.done.motion.table + self._clipped(self.done.slow.left(), 1)
        self.done.motion = self._anchored(self.done.motion.with_table(table))
        assert self.done.last is not None
        alone = self._of_slow_modes_too(self.done.last.alone)
        free = FREE[self.estimate]
        self.done.motion = held(self.done.motion, alone, ~self.done.rejected, free)

    def _align_level(self, factor: int, iterations: int, index: int, begun: int) -> None:
        voxel = self.region.grid.voxel_size
        prior = np.array([0, 0, _BEAM * voxel, _TURN, _TURN, _TURN])
        free = FREE[self.estimate]
        # What lies beside the circle that all views see is projected as well, if there is anything.
        solver = replace(self.solver, circle=self.solver.circle and not self.region.truncated)
        level = self.make_level(
            self.stream, self.scan, self.region.grid, solver, factor, free, prior
        )
        level.bias = self.done.bias
        for iteration in range(begun + 1, iterations + 1):
            started, before = time.perf_counter(), self.done
            name, unbiased = level_name(factor), level.bias is None
            step = level.step(
                before.motion,
                valid_views=~before.rejected,
                measure=iteration >= min(_BIAS_AFTER, iterations),
                title=f"{name}, {self.estimate} {iteration}/{iterations}",
            )
            rejected = before.rejected | outliers(step.correlation)
            table = self._interpolated(self._clipped(step.table, factor), rejected)
            motion = self._anchored(before.motion.then(before.motion.with_table(table)))
            if not unbiased or not self.solver.unbias:
                before.slow.add(motion.table - before.motion.table, ~rejected)
            moved = [getattr(motion, n) - getattr(before.motion, n) for n in ("shift_u", "shift_v")]
            entry = Iteration.of(
                name,
                iteration,
                np.stack(moved),
                step.correlation,
                step.residual,
                time.perf_counter() - started,
            )
            history = [*before.history, entry]
            self.done = RigidState(
                motion, rejected, history, (index, iteration), step, level.bias, before.slow
            )
            if self.checkpoint is not None:
                self.checkpoint.save(finished(history), *self.done.packed(self.shifts))

    def _anchored(self, motion: RigidMotion) -> RigidMotion:
        if not self.anchor:
            return motion
        return without_rigid_gauge(motion, self.scan.geometry, self.points)

    def _clipped(self, table: Floats, factor: int) -> Floats:
        """Shorten what is beyond the reach of a level."""
        longest = np.array([_LONGEST * self.region.grid.voxel_size] * 3 + [_STEEPEST] * 3)
        return np.asarray(np.clip(table, -factor * longest, factor * longest))

    @staticmethod
    def _interpolated(table: Floats, rejected: NDArray[np.bool_]) -> Floats:
        """Give rejected views the step between their neighbours'."""
        if not rejected.any() or rejected.all():
            return table
        views = np.arange(len(table))
        columns = [np.interp(views, views[~rejected], column[~rejected]) for column in table.T]
        return np.stack(columns, axis=1)

    def result(self) -> AlignmentResult:
        """Return what the iterations so far gave; the shifts alone before the first."""
        done = self.done
        if done.last is None:
            return self.start
        valid = ~done.rejected
        near, per_u, per_v = done.motion.optics[:, :3].T
        sigma = self._of_slow_modes_too(done.last.sigma)
        for column, factor in enumerate((per_u / near, per_v / near, 1 / near)):
            sigma[:, column] *= factor
        return AlignmentResult(
            motion=done.motion,
            valid_views=valid,
            confidence=np.clip(np.where(valid, done.last.correlation, 0.0), 0.0, 1.0),
            sigma=sigma,
            history=tuple(done.history),
            gauge=self.start.gauge,
            schedule=self.start.schedule,
            device=self.start.device,
        )

    def _of_slow_modes_too(self, sigma: Floats) -> Floats:
        """Return standard errors that count what adds up in slow modes."""
        return np.asarray(sigma * self.done.slow.growth(self.scan.views))
