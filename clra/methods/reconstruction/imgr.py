"""Multigrid iterative reconstruction (IMGR), with re-projection alignment inside.

Algorithm 3 of the paper. The lowest resolution is reconstructed by ordered subsets; at each higher
one the prolongated volume is projected once, and corrected by what the measured radiographs hold
beyond the simulated ones: what is left there is fine detail, which filtered back-projection inverts
well. The same simulated radiographs serve to register the measured ones, so that alignment costs
nothing but the registration.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import Cancelled, InputError
from clra.findings import Finding
from clra.methods.alignment.limits import far_motion, lost_features, warned
from clra.methods.alignment.rejected_views import Rejections, from_neighbours
from clra.methods.alignment.reprojection import Registered, with_margin
from clra.methods.alignment.result import AlignmentResult, Iteration
from clra.methods.execution.checkpoint import Checkpoint, Saved
from clra.methods.reconstruction.imgr_level import MultigridLevel
from clra.methods.reconstruction.imgr_state import (
    ImgrState,
    ImgrStep,
    MultigridResult,
    ReconstructionInterrupted,
)
from clra.methods.reconstruction.osem_tr import OrderedSubsets
from clra.methods.reconstruction.residuals import between
from clra.model.gauge.gauge import Gauge, sample_points
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.model.schedule import converged, level_factor, level_name, parse_levels
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import CroppedVolume

# Cycles after which it ends in any case; without alignment a second one changes little.
_CYCLES, _CYCLES_UNALIGNED = 3, 1
# A cycle whose misfit at full resolution is no smaller than this part of the last one's is in vain.
_FALLS = 0.98


def imgr(
    stream: Stream,
    scan: Scan,
    grid: VolumeGrid,
    *,
    levels: str = "auto",
    cycles: int | None = None,
    align: bool = False,
    scale: bool = True,
    anchor: bool = True,
    motion: Motion | None = None,
    valid_views: NDArray[np.bool_] | None = None,
    truth: Motion | None = None,
    osem: OrderedSubsets | None = None,
    state: ImgrState | None = None,
    checkpoint: Checkpoint | None = None,
    saved: Saved | None = None,
    make_level: Callable[..., MultigridLevel] = MultigridLevel,
) -> MultigridResult:
    """Reconstruct from coarse to fine, and align on the way.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        At full resolution.
    grid : VolumeGrid
        Where to reconstruct, at full resolution.
    levels : str
        Of a cycle: "QR-HR-FR", or "ER-QR-HR-FR" for large detectors; "auto" is the former.
    cycles : int, optional
        Most cycles; by default one without alignment, else until converged, three at most.
    align : bool
        Whether to register the radiographs, once a level.
    scale, anchor : bool
        Whether to estimate magnifications, and to take out of the motion in each step what a
        movement of the sample would explain, see :func:`clra.align`.
    motion : Motion, optional
        Where to start; by default no motion.
    valid_views : ndarray of bool, (views,), optional
        Views to reconstruct from, all by default; where it aligns it finds out by itself.
    truth : Motion, optional
        To report errors against.
    osem : OrderedSubsets, optional
        How the lowest level is reconstructed.
    state : ImgrState, optional
        Where an interrupted run stopped: it goes on to the last bit as if it had not.
    checkpoint : Checkpoint, optional
        Keeps what each finished level gives.
    saved : Saved, optional
        In place of `state`: what the checkpoint kept of it.
    make_level : callable
        Makes a :class:`MultigridLevel` of its arguments.

    Returns
    -------
    MultigridResult
        Of the levels that were finished, brought to full resolution, if a progress callback raised
        ``Cancelled``.

    Raises
    ------
    InputError
        If an option is none of the above.
    ReconstructionInterrupted
        On Ctrl-C after at least one level.

    References
    ----------
    .. [1] "Multi-resolution radiograph alignment for motion correction in X-ray micro-tomography",
       Algorithm 3.
    """
    factors = parse_levels(levels)
    osem = osem or OrderedSubsets()
    if not isinstance(osem.initial, str):
        raise InputError("initial: found a volume, expected 'fbp' or 'uniform' for imgr")
    if align and scan.views < 2:
        raise InputError(f"{scan.name}: found {scan.views} view, expected at least 2 to align")
    cycles = cycles or (_CYCLES if align else _CYCLES_UNALIGNED)
    start = motion or Motion.identity(scan.views)
    wide = with_margin(grid)
    run = _Run(
        stream,
        scan,
        wide,
        factors,
        align,
        scale,
        anchor,
        osem,
        truth,
        start,
        checkpoint,
        make_level,
    )
    if saved is not None:
        state = ImgrState.kept(saved, lambda factor, planes: run.level(factor).restored(planes))
    rejected = np.zeros(scan.views, np.bool_) if valid_views is None else ~valid_views
    run.done = state or ImgrState(None, start, rejected)
    try:
        try:
            run.cycles(cycles)
        except Cancelled:
            if not run.done.steps:
                raise
            message = f"the reconstruction was ended early: it is that of {run.done.finished}"
            Finding("cancelled", message).warn()
        margin = (wide.shape[0] - grid.shape[0]) // 2
        volume = CroppedVolume(run.full(), margin, grid)
    except KeyboardInterrupt:
        if not run.done.steps:
            raise
        raise ReconstructionInterrupted(run.done, run.alignment()) from None
    return MultigridResult(volume, run.done.motion, run.done.steps, run.alignment())


@dataclass
class _Run:
    """One reconstruction."""

    stream: Stream
    scan: Scan
    grid: VolumeGrid
    factors: Sequence[int]
    align: bool
    scale: bool
    anchor: bool
    osem: OrderedSubsets
    truth: Motion | None
    start: Motion
    checkpoint: Checkpoint | None
    make_level: Callable[..., MultigridLevel]
    done: ImgrState = field(init=False)

    def __post_init__(self) -> None:
        points = sample_points(self.grid)
        self.gauge = Gauge(self.scan.geometry, points, magnification=self.scale)
        self.shift_gauge = Gauge(self.scan.geometry, points, magnification=False)
        excluded = () if self.scan.corrections is None else self.scan.corrections.excluded
        self.rejections = Rejections(self.scan.views, excluded)
        self._levels: dict[int, MultigridLevel] = {}

    def cycles(self, most: int) -> None:
        """Algorithm 3, steps 3 to 25."""
        while not self.done.ended:
            cycle, position = divmod(len(self.done.steps), len(self.factors))
            title = f"cycle {cycle + 1}, {level_name(self.factors[position])}"
            done = self._correct(self.level(self.factors[position]), cycle + 1, title)
            # 22, 25: until converged
            last = position + 1 == len(self.factors)
            ended = last and (cycle + 1 == most or self._converged(done))
            self.done = replace(done, ended=ended)
            if self.checkpoint is not None:
                self.done.keep(self.checkpoint)

    def full(self) -> Any:
        """Return the volume at full resolution, whatever level was finished last."""
        volume = self.done.volume
        for factor in (4, 2, 1):
            if factor < level_factor(self.done.steps[-1].level):
                # Not told: whoever ended the work early still wants what is finished.
                volume = self.level(factor).brought(volume, None)
        return volume

    def _correct(self, level: MultigridLevel, cycle: int, title: str) -> ImgrState:
        """One resolution of a cycle: steps 4 to 9, 10 to 15, or 16 to 21."""
        started = time.perf_counter()
        before = self.done.motion
        # 2, 23, 11, 17: the volume so far at this resolution
        volume = self._so_far(level, title)
        # 5, 12, 18: simulated radiographs; 6, 13, 19: register them with the measured ones
        simulated, misfit, found = level.simulate(
            volume,
            before,
            registering=self.align,
            first=not self.done.history,
            magnification=self.scale,
            title=title,
        )
        # 7, 14, 20: transform, by absorbing the motion in the geometry
        done = self.done if found is None else self._moved(found)
        motion, rejected = done.motion, done.rejected
        shape = self.scan.geometry.shape
        moved = between(before, motion, shape, level.factor) if self.align else None
        # 15, 21: calculate the update, back-project and filter
        volume = level.corrected(
            volume, simulated, motion, moved=moved, valid_views=~rejected, title=title
        )
        del simulated
        if level.lowest:
            # 9: OSEM-TR
            volume = level.reconstruct(volume, motion, ~rejected, title)
        step = ImgrStep(cycle, level_name(level.factor), misfit, time.perf_counter() - started)
        self.stream.report(f"{title}: misfit {misfit:.4g} before", 1, 1)
        history = done.history if found is None else self._history(step, motion, found, level)
        return replace(done, volume=volume, steps=(*done.steps, step), history=history)

    def _so_far(self, level: MultigridLevel, title: str) -> Any:
        """Bring what there is to a level's resolution."""
        if self.done.volume is not None:
            return level.brought(self.done.volume, title)
        if self.align:
            odd = self.rejections.first(self.stream, level.radiographs)
            self.done = replace(self.done, rejected=odd)
        return level.first(self.done.motion, ~self.done.rejected)

    def _moved(self, found: Registered) -> ImgrState:
        """Append what was found to the motion, and tell which views are rejected."""
        rejected = self.rejections.of(found.correlation)
        there = from_neighbours(self.done.motion.then(found.motion), rejected)
        motion = self.shift_gauge.anchored(there, self.start) if self.anchor else there
        return replace(
            self.done,
            motion=motion.normalised(),
            rejected=rejected,
            registered=found,
            found=there,
        )

    def _history(
        self, step: ImgrStep, motion: Motion, found: Registered, level: MultigridLevel
    ) -> tuple[Iteration, ...]:
        """Append what a registration did; warn if it says that it had better not."""
        far = "" if self.done.history else far_motion(found.motion, level.factor)
        # Noise may well hide at full resolution what coarser ones could tell.
        told = level.factor > 1 and step.cycle == 1
        lost = lost_features(self.scan, found.correlation, level.factor) if told else ""
        before = self.done.motion
        update = [motion.shift_u - before.shift_u, motion.shift_v - before.shift_v]
        errors = {} if self.truth is None else self.gauge.error(motion, self.truth).means()
        iteration = Iteration.of(
            step.level,
            step.cycle,
            np.stack(update),
            found.correlation,
            found.residual,
            step.seconds,
            misfit=step.misfit,
            note=warned(out_of_reach=far, lost_features=lost),
            **errors,
        )
        return (*self.done.history, iteration)

    def _converged(self, done: ImgrState) -> bool:
        """Tell whether another cycle is worth nothing."""
        before, after = self.done.motion, done.motion
        count = len(self.factors)
        if len(done.steps) > count and (
            done.steps[-1].misfit > _FALLS * done.steps[-1 - count].misfit
        ):
            return True
        return self.align and converged(
            after.shift_u - before.shift_u, after.shift_v - before.shift_v
        )

    def alignment(self) -> AlignmentResult | None:
        """Return what was found of the motion, if anything was registered."""
        if self.done.registered is None or self.done.found is None:
            return None
        for finding in self.rejections.findings(self.done.rejected):
            finding.warn()
        return AlignmentResult.of(
            self.done.motion,
            self.done.history,
            self.done.registered,
            self.done.rejected,
            self.gauge.fit(self.done.found),
            "-".join(map(level_name, self.factors)),
            self.stream.device.name,
        )

    def level(self, factor: int) -> MultigridLevel:
        """Make the levels as they are needed, once each."""
        if factor not in self._levels:
            self._levels[factor] = self.make_level(
                self.stream,
                self.scan,
                self.grid,
                self.osem,
                factor,
                lowest=factor == self.factors[0],
            )
        return self._levels[factor]
