"""Find out how each radiograph moved: the choice of method, options and what they go with."""

import os
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

from clra.errors import Cancelled, InputError
from clra.findings import Finding, collected
from clra.methods.alignment.coarse_to_fine import CoarseToFine
from clra.methods.alignment.level import Level
from clra.methods.alignment.options import Solver
from clra.methods.alignment.reference_scan import align_to_reference
from clra.methods.alignment.region import region_of
from clra.methods.alignment.result import AlignmentInterrupted, AlignmentResult
from clra.methods.alignment.rigid.held_out_errors import with_standard_errors
from clra.methods.alignment.rigid.rigid_alignment import FREE, RigidAlignment
from clra.methods.alignment.rigid.rigid_level import RigidLevel
from clra.methods.alignment.rigid.rigid_start import RigidStart
from clra.methods.alignment.steps.odd_harmonics import are_open, with_odd_harmonics
from clra.methods.assessment.assess import assess
from clra.methods.assessment.radiograph_checks import refuse_counts
from clra.methods.diagnostics import evidence
from clra.methods.execution.checkpoint import Checkpoint, cancelled, checkpoint_of, identity
from clra.methods.execution.choice import check_for_cluster, executing
from clra.methods.preparation import prepared, with_detector_of
from clra.methods.reconstruction.imgr import imgr
from clra.methods.reconstruction.imgr_level import MultigridLevel
from clra.methods.reconstruction.imgr_state import ReconstructionInterrupted
from clra.methods.shared_work.shared_level import SharedLevel
from clra.methods.shared_work.shared_multigrid_level import SharedMultigridLevel
from clra.methods.shared_work.shared_rigid_level import SharedRigidLevel
from clra.methods.shared_work.shared_scan import levels_by, reading_by
from clra.model.corrections.correction_options import CorrectionOptions
from clra.model.grid import VolumeGrid, default_grid
from clra.model.motion import Motion
from clra.model.rigid.rigid_motion import RigidMotion
from clra.model.scan import Scan
from clra.model.schedule import parse_schedule
from clra.ops.runtime.devices import usable_devices
from clra.ops.runtime.versions import versions
from clra.ops.streaming.memory import DeviceMemoryError
from clra.ops.streaming.radiographs import Reading
from clra.ops.streaming.stream import Stream
from clra.progress import ProgressCallback

METHODS = ("ra", "imgr", "reference")
ESTIMATES = ("shift", "shift+scale", "source", *FREE)
GAUGES = ("anchored", "free")
# Valid views below which none can be held out.
_ENOUGH_TO_JUDGE = 4


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
    progress: ProgressCallback | None = None,
    gauge: str = "anchored",
    solver: Solver | None = None,
    checkpoint: str | os.PathLike[str] | Checkpoint | None = None,
    resume: bool = False,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
    corrections: CorrectionOptions | None = None,
    quality: bool = True,
    cluster: Any = None,
) -> AlignmentResult:
    """Estimate how each radiograph moved.

    Parameters
    ----------
    scan : Scan
        At least two views.
    method : {"ra", "imgr", "reference"}
        Re-projection alignment before reconstruction; or within one by multigrid iteration
        (`imgr`, Algorithm 3), which returns the volume as well; or the slow
        drift against a reference scan alone, without any reconstruction.
    schedule : str
        Levels and iterations, coarse to fine: "1QR-1HR", "2QR-2HR", "4FR", or "auto": at a
        detector of 384 pixels and more "6ER-3QR", else "4ER" and a quarter of the resolution
        until converged (at most 20 iterations), then half until converged (at most 3; on smaller
        detectors 6).
        Where the motion is large, or the views are an arc of a parallel beam, "auto" begins with
        shifts by sums over the radiographs ("PA" in the history), and on other arcs with the column
        of the axis, if the rays that are measured twice tell one; ``Solver(prealign=False)``
        leaves both out.
        For "imgr" the levels of a cycle: "QR-HR-FR" ("auto") or "ER-QR-HR-FR".
    estimate : {"shift+scale", "shift", "source", "rigid", "shift+roll", "shift+scale+roll"}
        Whether the magnification of each view is estimated or taken as 1; or whether it is the
        source that moved, in all three directions: this explains the parallax by which what is
        near the source shifts farther than what is far from it, too. "rigid" estimates three
        translations and three rotations of the sample in each view, after the shifts; the others
        estimate its roll about the beam beside shifts. The motion is then a
        :class:`clra.model.rigid.rigid_motion.RigidMotion`, and `sigma` has six columns.
    grid : VolumeGrid, optional
        Full-resolution grid that holds the sample; by default the whole field of view.
    device : str or cl.Device, optional
        As :func:`clra.ops.runtime.devices.choose_device` takes it, or "all" to share the work out
        to all devices of the best kind.
    reference : Scan, optional
        Some views of the scan again, from the same places, taken so quickly that nothing moved.
        What drifted slowly against them is where re-projection alignment starts.
    motion : Motion, optional
        Where to start; by default no motion. What it has of the gauge stays. After a rigid one the
        result is rigid, whatever is estimated.
    truth : Motion, optional
        To report errors against; by default the scan's own, if it is a simulated one.
    progress : callable, optional
        Called with a :class:`clra.progress.Progress` as work goes on.
    gauge : {"anchored", "free"}
        What becomes of the part of the motion that a movement of the sample as a whole (three
        translations, two tilts, a stretch along z) would explain as well. The data hardly see it,
        and what the iteration finds of it comes from how a cone beam reconstructs the ends of a
        scan: it would go on and stretch the sample. "anchored" takes it out in each iteration.
    solver : Solver, optional
        Parts of the iteration, to switch some off.
    checkpoint : path-like, optional
        Folder that keeps each finished iteration, so that an interruption of any kind loses none;
        removed at success. A :class:`Checkpoint` is left to who made it.
    resume : bool
        Go on from what the checkpoint holds.
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used.
    corrections : CorrectionOptions, optional
        Defects of the radiographs to look for and correct first; by default the defaults of these.
    quality : bool
        Whether to judge the result by views that are held out: a verdict, and standard errors that
        count what is left. A motion that predicts them no better than the start is not returned.
    cluster : distributed.Client or str, optional
        Workers that reconstruct, project and register for "ra" and "imgr": a client of Dask, or
        "local:N", "slurm:N", the address of a scheduler or its file. The scan has to be in a file.
        What is left for the device here is small.

    Returns
    -------
    AlignmentResult
        Of the iterations that were finished, with a warning, if `progress` raised ``Cancelled``.

    Raises
    ------
    InputError
        If an option is none of its choices, the scan has less than two views, or the checkpoint is
        of another scan or of other options.
    Cancelled
        If `progress` raised it before anything was finished.
    AlignmentInterrupted
        On Ctrl-C after at least one iteration; carries the result so far.

    References
    ----------
    .. [1] "Multi-resolution radiograph alignment for motion correction in X-ray micro-tomography",
       Algorithms 1, 2 and 3.
    """
    _check(scan, method, estimate, gauge)
    if estimate == "source" and isinstance(motion, RigidMotion):
        raise InputError("motion: found a rigid one with estimate='source', expected shifts")
    check_for_cluster(cluster, scan, method, ("ra", "imgr"))
    keeping, own = checkpoint_of(checkpoint, resume)
    stages = parse_schedule(schedule, scan.cropped().geometry.shape) if method == "ra" else ()
    for name, given in (("motion", motion), ("truth", truth)):
        if given is not None and given.views != scan.views:
            raise InputError(f"{name}: found {given.views} views, expected {scan.views}")
    if (method == "reference" and reference is None) or (reference and motion):
        found = "both" if motion else "none with method='reference'"
        raise InputError(f"reference, motion: found {found}, expected one of them")
    devices = usable_devices(device, progress)
    limits = {"max_device_memory": max_device_memory, "max_host_memory": max_host_memory}
    stream = Stream(devices[0], report=progress, **limits)
    anchor = gauge == "anchored" and method != "reference"
    begun: RigidStart | None = None

    def told(result: AlignmentResult) -> AlignmentResult:
        """Add what is known of any run, for the whole detector."""
        offset_u, offset_v = scan.window_offset
        found = result.motion if begun is None else begun.followed_by(result.motion)
        return replace(
            result,
            motion=found.about(-offset_u, -offset_v),
            warnings=tuple(findings),
            method=method,
            estimate=estimate,
            versions=versions(stream.device),
            scan=scan.name,
            checksum=scan.checksum(),
            about={
                "unobservable": "taken out" if anchor else "left in",
                "corrections": "" if scan.corrections is None else str(scan.corrections),
            },
        )

    scale = estimate in ("shift+scale", "source", "shift+scale+roll")
    refuse_counts(scan)
    with collected() as findings, ExitStack() as work:
        scan = prepared(scan, corrections, progress=progress)
        # What the mask leaves of the detector is aligned as a detector of its own.
        part = scan.cropped()
        motion = None if motion is None else motion.about(*scan.window_offset)
        truth = scan.truth if truth is None else truth
        truth = None if truth is None else truth.about(*scan.window_offset)
        own_grid = grid is None
        grid = grid or default_grid(part.geometry)
        if isinstance(motion, RigidMotion):
            begun = RigidStart.of(part, motion)
            part, motion, truth = begun.scan, None, None
        if reference is not None:
            if reference.geometry.shape == scan.geometry.shape:
                reference = with_detector_of(scan, reference).cropped()
            drift = align_to_reference(stream, part, reference, scale=scale, truth=truth)
            if method == "reference":
                return told(drift)
            motion = drift.motion
        start = motion or Motion.identity(scan.views)
        start = start.caused_by("source" if estimate == "source" else "detector")
        solver = solver or Solver()
        scale = scale and solver.estimator == "gauss-newton"
        saved = None
        if keeping is not None:
            options = {"method": method, "schedule": schedule, "estimate": estimate}
            options |= {"gauge": gauge, "solver": repr(solver)}
            saved = keeping.begin(identity(part, grid, options, motion=start))
        executor = work.enter_context(
            executing(stream, devices, cluster, keeping, progress, limits)
        )
        reading = reading_by(executor, stream)
        try:
            if method == "imgr":
                aligned = _by_imgr(
                    stream,
                    part,
                    grid,
                    levels=schedule,
                    align=True,
                    scale=scale,
                    anchor=anchor,
                    motion=start,
                    truth=truth,
                    checkpoint=keeping,
                    saved=saved,
                    make_level=levels_by(executor, part, MultigridLevel, SharedMultigridLevel),
                )
            else:
                region = region_of(stream, part, grid, own=own_grid)
                run = CoarseToFine(
                    stream,
                    part,
                    region,
                    schedule,
                    scale,
                    anchor,
                    solver,
                    start,
                    truth,
                    keeping,
                    levels_by(executor, part, Level, SharedLevel),
                )
                run.align(stages, saved)
                aligned = run.result()
                fit = solver.harmonics and not cancelled(findings)
                if fit and are_open(part, region, aligned):
                    aligned = with_odd_harmonics(stream, part, region, aligned, reading)
                if estimate in FREE and not cancelled(findings):
                    rigid = RigidAlignment(
                        stream,
                        part,
                        region,
                        solver,
                        estimate,
                        aligned,
                        anchor,
                        keeping,
                        run.state(),
                        levels_by(executor, part, RigidLevel, SharedRigidLevel),
                    )
                    aligned = rigid.align(saved)
        except AlignmentInterrupted as stopped:
            raise AlignmentInterrupted(told(stopped.result)) from None
        if quality and not cancelled(findings):
            aligned, told_of = _judged(stream, part, aligned, start, scale, reading)
            for finding in told_of:
                finding.record()
        result = told(aligned)
    if own and keeping is not None and not cancelled(result.warnings):
        keeping.clear()
    return result


def _judged(
    stream: Stream,
    scan: Scan,
    aligned: AlignmentResult,
    start: Motion,
    scale: bool,
    reading: Reading,
) -> tuple[AlignmentResult, list[Finding]]:
    """Add a verdict and findings, unless the call is ended or there is not enough to judge by."""
    try:
        if aligned.valid_views.sum() >= _ENOUGH_TO_JUDGE:
            judged = assess(stream, scan, aligned, start, scale=scale, reading=reading)
            aligned = with_standard_errors(stream, scan, aligned, judged, scale=scale)
        return evidence(stream, scan, aligned)
    except (Cancelled, DeviceMemoryError):
        return aligned, []  # which is finished
    except KeyboardInterrupt:
        raise AlignmentInterrupted(aligned) from None


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
        raise InputError(f"method: found {method!r}, expected one of {METHODS}")
    if estimate not in ESTIMATES:
        raise InputError(f"estimate: found {estimate!r}, expected one of {ESTIMATES}")
    if estimate in FREE and method != "ra":
        raise InputError(f"estimate: found {estimate!r} with method {method!r}, expected 'ra'")
    if gauge not in GAUGES:
        raise InputError(f"gauge: found {gauge!r}, expected one of {GAUGES}")
    if scan.views < 2:
        raise InputError(f"{scan.name}: found {scan.views} view, expected at least 2 to align")
