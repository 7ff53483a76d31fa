"""Re-projection alignment from coarse to fine: Algorithms 1 and 2 of the paper.

Reconstruct from the radiographs as they are, project the volume forward, register each measured
radiograph with its simulated counterpart, correct, repeat; first at a quarter of the resolution,
then at half. The correction is absorbed into the geometry: no radiograph is resampled, and the
simulated ones come out in the frame of the measured ones, so that what registration finds is what
is left.
"""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from clra.errors import Cancelled
from clra.findings import Finding
from clra.methods.alignment.level import Level
from clra.methods.alignment.limits import false_shifts, far_motion, lost_features, warned
from clra.methods.alignment.options import Solver
from clra.methods.alignment.prealignment.axis_column import axis_column
from clra.methods.alignment.prealignment.prealignment import Prealignment, is_open, prealigned
from clra.methods.alignment.region import Region
from clra.methods.alignment.rejected_views import Rejections
from clra.methods.alignment.reprojection import Registered
from clra.methods.alignment.result import (
    PREALIGNED,
    AlignmentInterrupted,
    AlignmentResult,
    Iteration,
    finished,
)
from clra.methods.alignment.steps.acceleration import MotionSteps
from clra.methods.alignment.steps.magnifications import Magnifications
from clra.methods.alignment.steps.slow_modes import SlowSteps
from clra.methods.execution import packing
from clra.methods.execution.checkpoint import Checkpoint, Saved
from clra.model.gauge.gauge import Gauge, sample_points
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.model.schedule import Stage, converged, level_name, update_size
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

_LOG = logging.getLogger(__name__)


@dataclass
class CoarseToFine:
    """One alignment, and what its levels hand on.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        At full resolution.
    region : Region
        Where to reconstruct, at full resolution.
    schedule : str
        As it was written, for the result.
    scale : bool
        Whether to estimate magnifications.
    anchor : bool
        Whether to take the gauge out of the motion in each iteration.
    solver : Solver
        Parts of the iteration.
    start : Motion
        Where to start.
    truth : Motion, optional
        To report errors against.
    checkpoint : Checkpoint, optional
        Keeps each finished iteration.
    make_level : callable
        Makes a :class:`Level` of its first five arguments.
    """

    stream: Stream
    scan: Scan
    region: Region
    schedule: str
    scale: bool
    anchor: bool
    solver: Solver
    start: Motion
    truth: Motion | None = None
    checkpoint: Checkpoint | None = None
    make_level: Callable[[Stream, Scan, Region, Solver, int], Level] = Level
    several: bool = field(init=False)  # iterations in the schedule
    motion: Motion = field(init=False)
    origin: Motion = field(init=False)  # whose gauge stays
    history: list[Iteration] = field(init=False, default_factory=list)
    prealigned: Prealignment | None = field(init=False, default=None)
    registered: Registered | None = field(init=False, default=None)  # by the last iteration
    found: Motion = field(init=False)  # by the last iteration, with its gauge
    last: tuple[int, Floats] = field(init=False)  # its level, and updates of valid views
    fresh: bool = field(init=False)  # nothing was known of the motion before it
    steps: MotionSteps = field(init=False)  # of the level
    rejected: NDArray[np.bool_] = field(init=False)
    rejections: Rejections = field(init=False)
    position: tuple[int, int] = field(init=False, default=(0, 0))  # stage, iterations of it

    def __post_init__(self) -> None:
        excluded = () if self.scan.corrections is None else self.scan.corrections.excluded
        self.rejections = Rejections(self.scan.views, excluded)
        self.motion = self.origin = self.start
        points = sample_points(self.region.sample)
        self.gauge = Gauge(self.scan.geometry, points, magnification=self.scale)
        # Taken out of the shifts alone: to fit them a little better, the joint fit would take
        # magnifications of several per cent.
        self.shift_gauge = Gauge(self.scan.geometry, points, magnification=False)
        place = (self.scan.geometry, self.region.sample) if self.anchor else None
        self.magnifications = Magnifications(self.solver, self.start, self.scale, place)

    def align(self, stages: Sequence[Stage], saved: Saved | None = None) -> None:
        """Go through the levels, or what is left of them; what an interruption leaves is kept."""
        self.several = sum(stage.limit for stage in stages) > 1
        first, done = (0, 0) if saved is None else self._go_on_from(saved)
        try:
            if saved is None and self.solver.prealign and is_open(self.schedule, self.start):
                self._prealign(stages[0].level)
            for index, stage in enumerate(stages):
                begun = done if index == first else 0
                if index >= first and begun < stage.limit:
                    self.align_level(stage, index, begun)
        except KeyboardInterrupt:
            if self.registered is None:
                raise
            raise AlignmentInterrupted(self.result()) from None
        except Cancelled:
            if self.registered is None:
                raise
            message = f"the alignment was ended early, after {finished(self.history)}"
            Finding("cancelled", message).warn()

    def _prealign(self, coarsest: int) -> None:
        """Begin with what sums over the radiographs tell, if it is of use."""
        started = time.perf_counter()
        found = prealigned(
            self.stream,
            self.scan.geometry,
            lambda factor: self._level(factor).radiographs,
            coarsest,
            self.rejections,
            self.shift_gauge,
        )
        if found is None:
            column = axis_column(self.stream, self.scan, lambda: self._level(1).radiographs)
            self.motion = self.origin = replace(self.start, shift_u=self.start.shift_u + column)
            return
        self._begin_with(found)
        seconds = time.perf_counter() - started
        self.history.append(found.entry(seconds, **self._errors()))
        if self.checkpoint is not None:
            values = {"position": (0, 0), "history": packing.history_values(self.history)}
            self.checkpoint.save(finished(self.history), values, packing.prealigned_arrays(found))

    def _begin_with(self, found: Prealignment) -> None:
        """Take shifts from a pre-alignment; magnifications are right on average, not in a view."""
        self.prealigned, self.rejections.vouched = found, found.vouched
        self.motion = replace(found.motion, magnification=self.start.magnification)
        self.origin = self.motion

    def align_level(self, stage: Stage, index: int = 0, done: int = 0) -> None:
        """Algorithm 2, steps 1 to 6 (and 7 to 13 at the next level), after `done` iterations."""
        name = level_name(stage.level)
        # 1, 7: down-sample the measured radiographs
        level = self._level(stage.level)
        if self.registered is None:
            self.rejected = self.rejections.first(self.stream, level.radiographs)
        # Each level ends a little aside of the one before: extrapolated by the last, short steps of
        # that one, its first steps would go astray.
        steps = self.solver.acceleration()
        self.steps = MotionSteps(steps, self.scan.geometry.shape, self.scale)
        slow, previous = SlowSteps(), None
        self.magnifications.begin(level.radiographs.shape[1:])
        for iteration in range(done + 1, (stage.iterations or stage.limit) + 1):
            started = time.perf_counter()
            self.magnifications.prepare(self.motion, ~self.rejected, first=self.registered is None)
            of = f"{name} {iteration}/{stage.iterations or f'at most {stage.limit}'}"
            found = self._iterate(level, title=of)
            wrong = self.rejections.of(found.correlation) & ~self.rejected
            if self.registered is None and wrong.any():
                # They were in the first volume: again without, or what they did to the others stays
                # in the modes that data hardly see, a tenth of all that is left of random motion.
                self.rejected, level.bias = self.rejected | wrong, None
                found = self._iterate(level, title=of)
            step, note = self._move(found, stage.level)
            update = np.abs(step[:2])
            left = slow.left(step[:, ~self.rejected])
            self.history.append(
                Iteration.of(
                    name,
                    iteration,
                    update,
                    found.correlation,
                    found.residual,
                    time.perf_counter() - started,
                    note=note,
                    **self._errors(),
                )
            )
            # 6, 13: until converged, whatever becomes of views that are rejected
            update_u, update_v = update[:, ~self.rejected]
            ended = (
                stage.iterations is None
                and not self.magnifications.displaced
                and left < stage.slow
                and converged(update_u, update_v, previous, stage.tolerance)
            )
            self._keep(index, stage.limit if ended else iteration)
            if ended:
                break
            # A first step finds too little, see `_move`: the second may well find as much.
            previous = None if self.fresh else update_size(update_u, update_v)[0]
        if len({entry.level for entry in self.history} - {PREALIGNED}) == 1:
            note = warned(lost_features=lost_features(self.scan, found.correlation, stage.level))
            notes = filter(None, (self.history[-1].note, note))
            self.history[-1] = replace(self.history[-1], note="\n".join(notes))

    def _iterate(self, level: Level, *, title: str) -> Registered:
        """Algorithm 1, steps 2 to 4."""
        first = self.registered is None
        shifts_only = first and self._shifts_first
        return level.residual_motion(
            self.motion,
            self.motion.magnification / self.start.magnification,
            valid_views=~self.rejected,
            first=first,
            magnification=self.scale and not shifts_only,
            measure=not shifts_only,
            title=title,
            pulled=not self.magnifications.probing,
        )

    def _move(self, found: Registered, level: int) -> tuple[Floats, str]:
        """Algorithm 1, step 5: append what was found.

        Returns the plain step as lengths, and what was warned of.
        """
        first, self.registered = self.registered is None, found
        self.rejected = self.rejections.of(found.correlation)
        there = self.magnifications.held(self.motion.then(found.motion), found)
        self.found = self.rejections.settled(
            self.motion, there, self.rejected, first=first
        ).normalised()
        there = self.shift_gauge.anchored(self.found, self.origin) if self.anchor else self.found
        if self.prealigned is not None:
            there = self.prealigned.held(there, ~self.rejected, scale=self.scale)
        step = self.steps.step(self.motion, there)
        update = np.abs(step[:2, ~self.rejected])
        if not first:
            note = warned(false_shifts=false_shifts(*self.last, level, update))
            self.fresh = bool(note)
        else:
            note = warned(out_of_reach=far_motion(found.motion, level))
            self.fresh = True
        self.last = level, update
        aside = self.magnifications.aside(self.motion, found, ~self.rejected)
        if aside is not None:
            self.origin, there, self.fresh = aside.then(self.origin), aside.then(there), True
            self.steps.forget()  # points at other depths shift anew
        # A first step's reconstruction was blurred, and what it registered is not all that later
        # ones do: nothing to extrapolate from.
        self.motion = self.steps.next(self.motion, there, plain=self.fresh)
        return step, note

    def _level(self, factor: int) -> Level:
        return self.make_level(self.stream, self.scan, self.region, self.solver, factor)

    def _keep(self, stage: int, done: int) -> None:
        """Keep what the iterations so far gave: `done` of a stage."""
        last = self.history[-1]
        _LOG.info(
            "%s %d: median update %.3g, %.3g pixel, correlation %.3f",
            last.level,
            last.iteration,
            last.update_u_median,
            last.update_v_median,
            last.correlation,
        )
        self.position = stage, done
        if self.checkpoint is not None:
            self.checkpoint.save(finished(self.history), *self.state())

    def state(self) -> packing.State:
        """Return the plain values and arrays by which an interrupted alignment goes on."""
        level, update = self.last
        arrays = packing.prealigned_arrays(self.prealigned)
        for name in ("motion", "found", "origin"):
            arrays |= packing.motion_arrays(name, getattr(self, name))
        arrays |= {"rejected": self.rejected, "update": update}
        arrays["accepted"] = self.rejections.accepted
        values = {
            "position": self.position,
            "history": packing.history_values(self.history),
            "level": level,
            "fresh": self.fresh,
            "reasons": list(self.rejections.reasons.items()),
        }
        return values, arrays | packing.registered_arrays(self.registered)

    def _go_on_from(self, saved: Saved) -> tuple[int, int]:
        """Take up a kept state; return the stage and how many of its iterations are done."""
        arrays, values, cause = saved.arrays, saved.values, self.start.cause
        before = packing.prealigned_from(arrays)
        if before is not None:
            self._begin_with(before)
        self.history = packing.history_from(values["history"])
        stage, done = self.position = tuple(values["position"])
        self.registered = packing.registered_from(arrays)
        if self.registered is None:
            return stage, done
        self.origin = packing.motion_from(arrays, "origin", cause)
        self.motion = packing.motion_from(arrays, "motion", cause)
        self.found = packing.motion_from(arrays, "found", cause)
        self.rejected, self.fresh = arrays["rejected"], values["fresh"]
        self.rejections.accepted = arrays["accepted"].astype(np.bool_)
        self.rejections.reasons = {int(view): reason for view, reason in values["reasons"]}
        self.last = values["level"], arrays["update"]
        return stage, done

    @property
    def _shifts_first(self) -> bool:
        """Whether the magnification waits: others follow, and none is known already."""
        known = bool((self.start.magnification != 1).any())
        return self.solver.shifts_first and self.several and not known

    def _errors(self) -> dict[str, float]:
        if self.truth is None:
            return {}
        return self.gauge.error(self.motion, self.truth).means()

    def result(self) -> AlignmentResult:
        """Return what the iterations so far gave, one at least."""
        assert self.registered is not None
        for finding in self.rejections.findings(self.rejected):
            finding.warn()
        return AlignmentResult.of(
            self.motion,
            self.history,
            self.registered,
            self.rejected,
            self.gauge.fit(self.found),
            self.schedule,
            self.stream.device.name,
        )
