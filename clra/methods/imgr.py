"""Multigrid iterative reconstruction (IMGR), with re-projection alignment inside.

Algorithm 3 of the paper. The lowest resolution is reconstructed by ordered subsets; at each higher
one the prolongated volume is projected once, and corrected by what the measured radiographs hold
beyond the simulated ones: what is left there is fine detail, which filtered back-projection inverts
well. The same simulated radiographs serve to register the measured ones, so that alignment costs
nothing but the registration.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from clra.methods.fbp import ramp_fbp
from clra.methods.multigrid import (
    MultigridResult,
    Progressed,
    ReconstructionInterrupted,
    Step,
)
from clra.methods.osem_tr import VOLUMES, OrderedSubsets, osem_tr, start_volume
from clra.methods.outliers import from_neighbours, odd_radiographs, outliers
from clra.methods.reprojection import (
    Registered,
    binned_mask,
    in_full_pixels,
    register,
    registration_for,
    reprojected,
    with_margin,
)
from clra.methods.residuals import between, residuals
from clra.methods.results import AlignmentResult, Iteration
from clra.model.gauge import Gauge, sample_points
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.model.schedule import converged, level_name, parse_levels
from clra.model.visibility import sampled
from clra.ops.memory import Store
from clra.ops.multigrid import add_update, cropped, prolongate, restrict
from clra.ops.registration import ESTIMATE_FIELDS
from clra.ops.streaming import Radiographs, Stream, Volume

Floats = NDArray[np.float64]

# Cycles after which it ends in any case; without alignment a second one changes little.
_CYCLES, _CYCLES_UNALIGNED = 3, 1
# A cycle whose misfit at full resolution is no smaller than this part of the last one's is in vain.
_FALLS = 0.98
# At the levels that are corrected, the device holds the volume and its correction.
_VOLUMES = 2


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
    believed: NDArray[np.bool_] | None = None,
    truth: Motion | None = None,
    osem: OrderedSubsets | None = None,
    progressed: Progressed | None = None,
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
        Of a cycle: "QR-HR-FR", or "ER-QR-HR-FR" for large panels; "auto" is the former.
    cycles : int, optional
        Most cycles; by default one without alignment, else until converged, three at most.
    align : bool
        Whether to register the radiographs, once a level.
    scale, anchor : bool
        Whether to estimate magnifications, and to take out of the motion in each step what a
        movement of the sample would explain, see :func:`clra.align`.
    motion : Motion, optional
        Where to start; by default no motion.
    believed : ndarray of bool, (views,), optional
        Views to reconstruct from, all by default; where it aligns it finds out by itself.
    truth : Motion, optional
        To report errors against.
    osem : OrderedSubsets, optional
        How the lowest level is reconstructed.
    progressed : Progressed, optional
        Where an interrupted run stopped: it goes on to the last bit as if it had not.

    Returns
    -------
    MultigridResult

    Raises
    ------
    ValueError
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
        raise ValueError("initial: found a volume, expected 'fbp' or 'uniform' for imgr")
    if align and scan.views < 2:
        raise ValueError(f"{scan.name}: found {scan.views} view, expected at least 2 to align")
    cycles = cycles or (_CYCLES if align else _CYCLES_UNALIGNED)
    start = motion or Motion.identity(scan.views)
    run = _Run(stream, scan, with_margin(grid), factors, align, scale, anchor, osem, truth, start)
    weak = np.zeros(scan.views, np.bool_) if believed is None else ~believed
    run.done = progressed or Progressed(None, start, weak)
    try:
        run.cycles(cycles)
        first = (run.grid.shape[0] - grid.shape[0]) // 2
        assert run.done.volume is not None
        volume = cropped(stream, run.done.volume, first, grid)
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
    levels: Sequence[int]
    align: bool
    scale: bool
    anchor: bool
    osem: OrderedSubsets
    truth: Motion | None
    start: Motion
    done: Progressed = field(init=False)
    registered: Registered | None = field(init=False, default=None)
    found: Motion = field(init=False)  # by the last registration, with its gauge

    def __post_init__(self) -> None:
        points = sample_points(self.grid)
        self.gauge = Gauge(self.scan.geometry, points, magnification=self.scale)
        self.shift_gauge = Gauge(self.scan.geometry, points, magnification=False)
        self._radiographs: dict[int, Radiographs] = {}

    def cycles(self, most: int) -> None:
        """Algorithm 3, steps 3 to 25."""
        while not self.done.ended:
            cycle, position = divmod(len(self.done.steps), len(self.levels))
            title = f"cycle {cycle + 1}, {level_name(self.levels[position])}"
            done = self._level(self.levels[position], cycle + 1, title)
            # 22, 25: until converged
            last = position + 1 == len(self.levels)
            ended = last and (cycle + 1 == most or self._converged(done))
            self.done = replace(done, ended=ended)

    def _level(self, level: int, cycle: int, title: str) -> Progressed:
        """One resolution of a cycle: steps 4 to 9, 10 to 15, or 16 to 21."""
        started = time.perf_counter()
        radiographs, before = self._measured(level), self.done.motion
        # 2, 23, 11, 17: the volume so far at this resolution
        geometry = self._geometry(before, level)
        volume = self._so_far(radiographs, geometry)
        # 5, 12, 18: simulated radiographs; 6, 13, 19: register them with the measured ones
        simulated, misfit, found = self._simulate(radiographs, volume, geometry, title)
        # 7, 14, 20: transform, by absorbing the motion in the geometry
        motion, weak = (before, self.done.weak) if found is None else self._moved(found)
        geometry = self._geometry(motion, level)
        # 15, 21: calculate the update, back-project and filter
        lack = residuals(
            self.stream,
            radiographs,
            simulated,
            self._used(level),
            moved=between(before, motion, self.scan.geometry.shape, level) if self.align else None,
        )
        update = ramp_fbp(
            self.stream,
            lack,
            geometry,
            volume.grid,
            believed=~weak,
            stage=f"{title}: correcting",
            volumes=self._volumes(level),
        )
        del simulated, lack
        add_update(self.stream, volume, update, sampled(geometry, volume.grid))
        del update
        if level == self.levels[0]:
            # 9: OSEM-TR
            osem_tr(
                self.stream,
                radiographs,
                geometry,
                volume,
                self.osem,
                used=self._used(level),
                believed=~weak,
                stage=f"{title}: OSEM-TR",
            )
        step = Step(cycle, level_name(level), misfit, time.perf_counter() - started)
        self.stream.report(f"{title}: misfit {misfit:.4g} before", 1, 1)
        return Progressed(
            volume,
            motion,
            weak,
            (*self.done.steps, step),
            self.done.history if found is None else self._history(step, motion, found),
        )

    def _so_far(self, radiographs: Radiographs, geometry: ConeBeamGeometry) -> Volume:
        """Bring what there is to the resolution of the radiographs."""
        level, volume = radiographs.level, self.done.volume
        volumes = self._volumes(level)
        if volume is None:  # 1, 2
            if self.align:
                odd = odd_radiographs(self.stream, radiographs)
                self.done = replace(self.done, weak=odd)
            grid = self._grid(level)
            return start_volume(
                self.stream, radiographs, geometry, grid, self.osem, believed=~self.done.weak
            )
        if level != self.levels[0]:  # 11, 17
            return prolongate(self.stream, volume, self._grid(level), volumes=volumes)
        for _ in range(level.bit_length() - 1):  # 23
            volume = restrict(self.stream, volume, volumes=volumes)
        return volume

    def _simulate(
        self, radiographs: Radiographs, volume: Volume, geometry: ConeBeamGeometry, title: str
    ) -> tuple[Store, float, Registered | None]:
        """Project the volume, once; compare and, if asked, register chunk by chunk."""
        stream, level = self.stream, radiographs.level
        simulated = Store(radiographs.shape, stream.room)
        statistics = self.osem.statistics(stream, self._used(level), level)
        registration = registration_for(
            stream,
            self.scan,
            radiographs,
            first=not self.done.history,
            magnification=self.scale,
        ) if self.align else None  # fmt: skip
        table = np.empty((geometry.views, len(ESTIMATE_FIELDS)))
        magnification = self.done.motion.magnification
        stage = f"{title}: simulating"
        for views, measured, made in reprojected(stream, radiographs, volume, geometry, stage):
            statistics.deviance(stream.queue, made, measured)
            simulated.write(views.start, stream.download(made))
            if registration is not None:
                known = magnification[views]
                table[views] = register(stream, registration, measured, made, known)
        misfit = statistics.misfit(stream.queue, geometry.views)
        rows, columns = self.scan.geometry.shape
        lost = (rows % level, columns % level)
        return simulated, misfit, in_full_pixels(table, level, lost) if self.align else None

    def _moved(self, found: Registered) -> tuple[Motion, NDArray[np.bool_]]:
        """Append what was found to the motion; also which views are not believed."""
        self.registered, weak = found, outliers(found.correlation)
        self.found = from_neighbours(self.done.motion.then(found.motion), weak)
        gauge, start = self.shift_gauge, self.start
        motion = gauge.anchored(self.found, start) if self.anchor else self.found
        return motion.normalised(), weak

    def _history(self, step: Step, motion: Motion, found: Registered) -> tuple[Iteration, ...]:
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
            **errors,
        )
        return (*self.done.history, iteration)

    def _converged(self, done: Progressed) -> bool:
        """Tell whether another cycle is worth nothing."""
        before, after = self.done.motion, done.motion
        count = len(self.levels)
        if len(done.steps) > count and (
            done.steps[-1].misfit > _FALLS * done.steps[-1 - count].misfit
        ):
            return True
        return self.align and converged(
            after.shift_u - before.shift_u, after.shift_v - before.shift_v
        )

    def alignment(self) -> AlignmentResult | None:
        """Return what was found of the motion, if anything was registered."""
        weak = self.done.weak
        if self.registered is None:
            return None
        return AlignmentResult(
            motion=self.done.motion,
            history=list(self.done.history),
            confidence=np.clip(np.where(weak, 0.0, self.registered.correlation), 0.0, 1.0),
            sigma=self.registered.sigma,
            gauge=dict(self.gauge.fit(self.found).rms_by_mode),
            flagged=tuple(int(view) for view in np.flatnonzero(weak)),
            schedule="-".join(map(level_name, self.levels)),
            device=self.stream.device.name.strip(),
        )

    def _measured(self, level: int) -> Radiographs:
        """1: down-sample the measured radiographs, once a level."""
        if level not in self._radiographs:
            self._radiographs[level] = Radiographs(self.stream, self.scan, level)
        return self._radiographs[level]

    def _geometry(self, motion: Motion, level: int) -> ConeBeamGeometry:
        """Motions are in full-resolution pixels: absorb first, then bin."""
        return self.scan.geometry.with_motion(motion).binned(level)

    def _grid(self, level: int) -> VolumeGrid:
        return self.grid.binned(level) if level > 1 else self.grid

    def _volumes(self, level: int) -> int:
        """Volumes that the device holds at a time."""
        return VOLUMES if level == self.levels[0] else _VOLUMES

    def _used(self, level: int) -> NDArray[np.bool_]:
        """Pixels of the binned panel that count."""
        mask = self.scan.mask
        return binned_mask(
            np.ones(self.scan.geometry.shape, np.bool_) if mask is None else mask, level
        )
