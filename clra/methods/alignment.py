"""Re-projection alignment: Algorithms 1 and 2 of the paper.

Reconstruct from the radiographs as they are, project the volume forward, register each measured
radiograph with its simulated twin, correct, repeat; first at a quarter of the resolution, then at
half. The correction is absorbed into the geometry: no radiograph is resampled, and the simulated
ones come out in the frame of the measured ones, so that what registration finds is what is left.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.methods.acceleration import MotionSteps
from clra.methods.imgr import imgr
from clra.methods.level import Level
from clra.methods.limits import false_shifts, far_motion, lost_features, warned
from clra.methods.multigrid import ReconstructionInterrupted
from clra.methods.outliers import from_neighbours, odd_radiographs, outliers
from clra.methods.reference import align_to_reference
from clra.methods.reprojection import Registered, with_margin
from clra.methods.results import AlignmentInterrupted, AlignmentResult, Iteration
from clra.methods.solver import Solver
from clra.model.gauge import Gauge, sample_points
from clra.model.grid import VolumeGrid, default_grid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.model.schedule import Stage, converged, level_name, parse_schedule, update_size
from clra.ops.streaming import Report, Stream

Floats = NDArray[np.float64]

METHODS = ("ra", "imgr", "reference")
ESTIMATES = ("shift", "shift+scale", "source")
GAUGES = ("anchored", "free")


def align(
    scan: Scan,
    method: str = "ra",
    schedule: str = "auto",
    estimate: str = "shift+scale",
    grid: VolumeGrid | None = None,
    device: Any = None,
    *,
    reference: Scan | None = None,
    motion: Motion | None = None,
    truth: Motion | None = None,
    progress: Report | None = None,
    gauge: str = "anchored",
    solver: Solver | None = None,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
) -> AlignmentResult:
    """Estimate how each radiograph moved.

    Parameters
    ----------
    scan : Scan
        At least two views.
    method : {"ra", "imgr", "reference"}
        Re-projection alignment before reconstruction; or within one by multigrid iteration
        (:func:`clra.methods.imgr.imgr`, Algorithm 3), which returns the volume as well; or the slow
        drift against a reference scan alone, without any reconstruction.
    schedule : str
        Levels and iterations, coarse to fine: "1QR-1HR", "2QR-2HR", "4FR", or "auto": at a
        panel of 384 pixels and more "6ER-3QR", else a quarter of the resolution until converged (at
        most 6 iterations), then half until converged (at most 3, often one). For "imgr" the levels
        of a cycle: "QR-HR-FR" ("auto") or "ER-QR-HR-FR".
    estimate : {"shift+scale", "shift", "source"}
        Whether the magnification of each view is estimated or taken as 1; or whether it is the
        source that moved, in all three directions: this explains the parallax by which what is
        near the source shifts farther than what is far from it, too.
    grid : VolumeGrid, optional
        Full-resolution grid that holds the sample; by default the whole field of view.
    device : str or cl.Device, optional
        As :func:`clra.ops.devices.choose_device` takes it.
    reference : Scan, optional
        Some views of the scan again, from the same places, taken so quickly that nothing moved.
        What drifted slowly against them is where re-projection alignment starts.
    motion : Motion, optional
        Where to start; by default no motion. What it has of the gauge stays.
    truth : Motion, optional
        To report errors against; by default the scan's own, if it is a simulated one.
    progress : callable, optional
        Called with a :class:`clra.ops.streaming.Progress` as work goes on.
    gauge : {"anchored", "free"}
        What becomes of the part of the motion that a movement of the sample as a whole (three
        translations, two tilts, a stretch along z) would explain as well. The data hardly see it,
        and what the iteration finds of it comes from how a cone beam reconstructs the ends of a
        scan: it would go on and stretch the sample. "anchored" takes it out in each iteration.
    solver : Solver, optional
        Parts of the iteration, to switch some off.
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used.

    Returns
    -------
    AlignmentResult

    Raises
    ------
    ValueError
        If an option is none of its choices or the scan has less than two views.
    AlignmentInterrupted
        On Ctrl-C after at least one iteration; carries the result so far.

    References
    ----------
    .. [1] "Multi-resolution radiograph alignment for motion correction in X-ray micro-tomography",
       Algorithms 1, 2 and 3.
    """
    _check(scan, method, estimate, gauge)
    if (method == "reference" and reference is None) or (reference and motion):
        found = "both" if motion else "none with method='reference'"
        raise ValueError(f"reference, motion: found {found}, expected one of them")
    # What the mask leaves of the panel is aligned as a panel of its own.
    whole, scan = scan, scan.cropped()
    aside = whole.window_aside
    stages = parse_schedule(schedule, scan.geometry.shape) if method == "ra" else ()
    stream = Stream(
        device,
        max_device_memory=max_device_memory,
        max_host_memory=max_host_memory,
        report=progress,
    )
    truth = scan.truth if truth is None else truth.about(*aside)
    motion = None if motion is None else motion.about(*aside)
    if reference is not None:
        if reference.geometry.shape == whole.geometry.shape:
            reference = replace(reference, mask=whole.mask).cropped()
        drift = align_to_reference(stream, scan, reference, scale=estimate != "shift", truth=truth)
        if method == "reference":
            return _on_panel(drift, whole)
        motion = drift.motion
    grid = grid or default_grid(scan.geometry)
    solver, anchor = solver or Solver(), gauge == "anchored"
    scale = estimate != "shift" and solver.estimator == "gauss-newton"
    start = motion or Motion.identity(scan.views)
    start = start.caused_by("source" if estimate == "source" else "panel")
    try:
        if method == "imgr":
            solved = _by_imgr(
                stream,
                scan,
                grid,
                levels=schedule,
                align=True,
                scale=scale,
                anchor=anchor,
                motion=start,
                truth=truth,
            )
            return _on_panel(solved, whole)
        run = _Run(stream, scan, with_margin(grid), schedule, scale, anchor, solver, start)
        run.truth = truth
        run.align(stages)
    except AlignmentInterrupted as stopped:
        raise AlignmentInterrupted(_on_panel(stopped.result, whole)) from None
    return _on_panel(run.result(), whole)


def _on_panel(result: AlignmentResult, scan: Scan) -> AlignmentResult:
    """Return a result for what the mask leaves as one for the whole panel."""
    aside_u, aside_v = scan.window_aside
    return replace(result, motion=result.motion.about(-aside_u, -aside_v))


def _by_imgr(stream: Stream, scan: Scan, grid: VolumeGrid, **options: Any) -> AlignmentResult:
    """Algorithm 3."""
    try:
        found = imgr(stream, scan, grid, **options)
    except ReconstructionInterrupted as stopped:
        assert stopped.alignment is not None  # each level registers
        raise AlignmentInterrupted(stopped.alignment) from None
    assert found.alignment is not None
    return replace(found.alignment, volume=found.volume.to_host())


def _check(scan: Scan, method: str, estimate: str, gauge: str) -> None:
    if method not in METHODS:
        raise ValueError(f"method: found {method!r}, expected one of {METHODS}")
    if estimate not in ESTIMATES:
        raise ValueError(f"estimate: found {estimate!r}, expected one of {ESTIMATES}")
    if gauge not in GAUGES:
        raise ValueError(f"gauge: found {gauge!r}, expected one of {GAUGES}")
    if scan.views < 2:
        raise ValueError(f"{scan.name}: found {scan.views} view, expected at least 2 to align")


@dataclass
class _Run:
    """The state that the levels of one alignment hand on."""

    stream: Stream
    scan: Scan
    grid: VolumeGrid
    schedule: str
    scale: bool
    anchor: bool
    solver: Solver
    start: Motion
    several: bool = field(init=False)  # iterations in the schedule
    motion: Motion = field(init=False)
    truth: Motion | None = field(init=False, default=None)
    history: list[Iteration] = field(init=False, default_factory=list)
    registered: Registered = field(init=False)
    found: Motion = field(init=False)  # by the last iteration, with its gauge
    last: tuple[int, Floats] = field(init=False)  # its level, and updates of views believed
    fresh: bool = field(init=False)  # nothing was known of the motion before it
    weak: NDArray[np.bool_] = field(init=False)

    def __post_init__(self) -> None:
        self.motion = self.start
        shape = self.scan.geometry.shape
        self.steps = MotionSteps(self.solver.acceleration(), shape, self.scale)
        points = sample_points(self.grid)
        self.gauge = Gauge(self.scan.geometry, points, magnification=self.scale)
        # Taken out of the shifts alone: to fit them a little better, the joint fit would take
        # magnifications of several per cent.
        self.shift_gauge = Gauge(self.scan.geometry, points, magnification=False)

    def align(self, stages: Sequence[Stage]) -> None:
        """Go through the levels; what an interruption leaves is kept."""
        self.several = sum(stage.limit for stage in stages) > 1
        try:
            for stage in stages:
                self.align_level(stage)
        except KeyboardInterrupt:
            if not self.history:
                raise
            raise AlignmentInterrupted(self.result()) from None

    def align_level(self, stage: Stage) -> None:
        """Algorithm 2, steps 1 to 6 (and 7 to 13 at the next level)."""
        name = level_name(stage.level)
        # 1, 7: down-sample the measured radiographs
        level = Level(self.stream, self.scan, self.grid, self.solver, stage.level)
        if not self.history:
            self.weak = odd_radiographs(self.stream, level.radiographs)
        self.steps.restart()
        previous = None
        for iteration in range(1, (stage.iterations or stage.limit) + 1):
            started = time.perf_counter()
            of = f"{name} {iteration}/{stage.iterations or f'at most {stage.limit}'}"
            found = self._iterate(level, title=of)
            wrong = outliers(found.correlation) & ~self.weak
            if not self.history and wrong.any():
                # They were in the first volume: again without, or what they did to the others stays
                # in the modes that data hardly see, a tenth of all that is left of random motion.
                self.weak, level.bias = self.weak | wrong, None
                found = self._iterate(level, title=of)
            step, note = self._move(found, stage.level)
            update = np.abs(step)
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
            # 6, 13: until converged, whatever becomes of views that are not believed
            update_u, update_v = update[:, ~self.weak]
            if stage.iterations is None and converged(update_u, update_v, previous):
                break
            # A first step finds too little, see `_move`: the second may well find as much.
            previous = None if self.fresh else update_size(update_u, update_v)[0]
        if len({entry.level for entry in self.history}) == 1:
            note = warned(lost_features(self.scan, found.correlation, stage.level))
            notes = filter(None, (self.history[-1].note, note))
            self.history[-1] = replace(self.history[-1], note="\n".join(notes))

    def _iterate(self, level: Level, *, title: str) -> Registered:
        """Algorithm 1, steps 2 to 4."""
        first = not self.history
        shifts_only = first and self._shifts_first
        return level.residual_motion(
            self.motion,
            self.motion.magnification / self.start.magnification,
            believed=~self.weak,
            first=first,
            magnification=self.scale and not shifts_only,
            measure=not shifts_only,
            title=title,
        )

    def _move(self, found: Registered, level: int) -> tuple[Floats, str]:
        """Algorithm 1, step 5: append what was found.

        Returns the plain step in u and v, and what was warned of.
        """
        self.registered = found
        self.weak = outliers(found.correlation)
        self.found = from_neighbours(self.motion.then(found.motion), self.weak).normalised()
        there = self.shift_gauge.anchored(self.found, self.start) if self.anchor else self.found
        step = self.steps.step(self.motion, there)
        believed = np.abs(step[:, ~self.weak])
        if self.history:
            note = warned(false_shifts(*self.last, level, believed))
            self.fresh = bool(note)
        else:
            note = warned(far_motion(found.motion, level))
            self.fresh = True
        if self.fresh:
            # What the steps so far tell of slow modes is as wrong as where they led.
            self.steps.forget()
        self.last = level, believed
        # A first step's reconstruction was blurred, and what it registered is not all that later
        # ones do: nothing to extrapolate from.
        self.motion = self.steps.next(self.motion, there, plain=self.fresh)
        return step, note

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
        """Return what the iterations so far gave."""
        return AlignmentResult.of(
            self.motion,
            self.history,
            self.registered,
            self.weak,
            self.gauge.fit(self.found),
            self.schedule,
            self.stream.device.name,
        )
