"""From a scan to a volume: picks the method and the defaults."""

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.findings import Finding, collected
from clra.methods.alignment.align import align as align_scan
from clra.methods.alignment.result import AlignmentResult
from clra.methods.execution.checkpoint import Checkpoint, cancelled, checkpoint_of
from clra.methods.execution.choice import check_for_cluster, executing
from clra.methods.execution.executor import reconstruct_planes
from clra.methods.preparation import prepared, used_views
from clra.methods.reconstruction import iterative
from clra.methods.reconstruction.imgr_state import ImgrStep
from clra.methods.reconstruction.iterative import Options
from clra.methods.reconstruction.katsevich import Exact, exact_helices
from clra.methods.reconstruction.missing_views import without_gaps
from clra.methods.reconstruction.scan_checks import warn_of_method, warn_of_scan
from clra.methods.reconstruction.some_planes import SomePlanes
from clra.model.binning import binned_motion, binned_scan
from clra.model.corrections.correction_options import CorrectionOptions
from clra.model.grid import Region, VolumeGrid, volume_grid
from clra.model.helix.pi_intervals import heights_between
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.model.validation import checked_valid_views
from clra.ops.filtering.ramp import WINDOWS
from clra.ops.runtime.devices import usable_devices
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import HostPlanes, PlaneWriter
from clra.progress import ProgressCallback

METHODS = ("fbp", "katsevich", *iterative.METHODS)


def reconstruct(
    scan: Scan,
    method: str = "fbp",
    grid: VolumeGrid | None = None,
    motion: Motion | None = None,
    align: bool = False,
    device: Any = None,
    *,
    alignment: AlignmentResult | None = None,
    valid_views: NDArray[np.bool_] | None = None,
    options: Options | None = None,
    progress: ProgressCallback | None = None,
    checkpoint: str | os.PathLike[str] | Checkpoint | None = None,
    resume: bool = False,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
    corrections: CorrectionOptions | None = None,
    binning: int = 1,
    roi: Region | None = None,
    voxel_size: float | None = None,
    window: str = "ram-lak",
    cluster: Any = None,
) -> NDArray[np.float32]:
    """Reconstruct a volume.

    Parameters
    ----------
    scan : Scan
        Radiographs and their geometry.
    method : {"fbp", "katsevich", "osem-tr", "imgr"}
        Ramp-filtered back-projection, for any trajectory; Katsevich's, which is exact, for helices
        and double helices; ordered subsets for counted photons (`osem_tr`); or the paper's
        Algorithm 3, which solves the lowest resolution by these and corrects the higher ones once.
    grid : VolumeGrid, optional
        Where to reconstruct; by default :func:`clra.model.grid.default_grid`.
    motion : Motion, optional
        Of the radiographs, absorbed into the geometry, so that nothing is resampled; but
        "katsevich" needs ideal rows and resamples each radiograph once.
    align : bool
        Estimate the motion first, with the defaults of :func:`clra.align`; "imgr" does so on the
        way.
    device : str or cl.Device, optional
        As `choose_device` takes it, or "all" to share the work out to all devices of the best kind.
    alignment : AlignmentResult, optional
        In place of `motion`: views that it rejects are left out.
    valid_views : ndarray of bool, (views,), optional
        Views to reconstruct from; by default all, or those that the alignment did not reject.
        "katsevich" needs every view: what lies between the radiographs beside stands in for the
        others, and for views that the scan lacks.
    options : OrderedSubsets or Multigrid, optional
        Of "osem-tr" and of "imgr".
    progress : callable, optional
        Called with a :class:`clra.progress.Progress` as work goes on. If it raises ``Cancelled``,
        the iterative methods return what their finished passes or levels gave, with a warning.
    checkpoint : path-like, optional
        Folder that keeps each finished pass of "osem-tr", level of "imgr" and iteration of an
        alignment; removed at success. A :class:`Checkpoint` is left to who made it.
    resume : bool
        Go on from what the checkpoint holds.
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used. The volume that is returned comes on top: :func:`reconstruct_into`
        takes one larger than the memory.
    corrections : CorrectionOptions, optional
        Defects of the radiographs to look for and correct first; by default the defaults of these.
    binning : int
        Average radiographs over this many rows and columns first, but align the whole ones.
    roi, voxel_size
        Of the grid if none is given, as :func:`clra.model.grid.volume_grid` takes them.
    window : {"ram-lak", "shepp-logan", "hann"}
        Of the ramp filter of "fbp": the latter two trade resolution for less noise.
    cluster : distributed.Client or str, optional
        Workers to share the work out to: a client of Dask, or "local:N", "slurm:N", the address of
        a scheduler or its file. The scan has to be in a file.

    Returns
    -------
    ndarray of float32, (nz, ny, nx)
        Attenuation [1/mm].

    Raises
    ------
    InputError
        If the method is unknown, the options are another's, no view is valid, two of `motion`,
        `alignment` and `align` are given, the checkpoint is of another call, or the scan is one
        that Katsevich's method cannot treat; says what pitch, detector or field of view would do.
    Cancelled
        If `progress` raised it before anything was finished.
    """
    seen = scan.cropped().geometry.binned(binning)
    planes = HostPlanes(grid or volume_grid(seen, roi=roi, voxel_size=voxel_size))
    reconstruct_into(
        planes,
        scan,
        method,
        planes.grid,
        motion,
        align,
        device,
        alignment=alignment,
        valid_views=valid_views,
        options=options,
        progress=progress,
        checkpoint=checkpoint,
        resume=resume,
        max_device_memory=max_device_memory,
        max_host_memory=max_host_memory,
        corrections=corrections,
        binning=binning,
        window=window,
        cluster=cluster,
    )
    return planes.volume


@dataclass(frozen=True)
class Reconstruction:
    """What is known of a volume beside its voxels.

    Attributes
    ----------
    warnings : tuple of Finding
        What was found on the way.
    steps : tuple of ImgrStep
        Of "imgr".
    alignment : AlignmentResult or None
        That it was reconstructed with.
    """

    warnings: tuple[Finding, ...]
    steps: tuple[ImgrStep, ...] = ()
    alignment: AlignmentResult | None = None


def reconstruct_into(
    target: PlaneWriter,
    scan: Scan,
    method: str = "fbp",
    grid: VolumeGrid | None = None,
    motion: Motion | None = None,
    align: bool = False,
    device: Any = None,
    *,
    alignment: AlignmentResult | None = None,
    valid_views: NDArray[np.bool_] | None = None,
    options: Options | None = None,
    progress: ProgressCallback | None = None,
    checkpoint: str | os.PathLike[str] | Checkpoint | None = None,
    resume: bool = False,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
    corrections: CorrectionOptions | None = None,
    binning: int = 1,
    roi: Region | None = None,
    voxel_size: float | None = None,
    window: str = "ram-lak",
    cluster: Any = None,
) -> Reconstruction:
    """Reconstruct a volume, and hand it on some planes at a time.

    Parameters
    ----------
    target : PlaneWriter
        Takes the planes, each once; `open_volume` gives one that writes a file.
    scan, method, grid, motion, align, device, alignment, valid_views, options, progress, \
    checkpoint, resume, max_device_memory, max_host_memory, corrections, binning, roi, voxel_size, \
    window, cluster
        As :func:`reconstruct` takes them.

    Returns
    -------
    Reconstruction

    Raises
    ------
    InputError
        As :func:`reconstruct` does.
    """
    if method not in METHODS:
        raise InputError(f"method: found {method!r}, expected one of {METHODS}")
    if window not in WINDOWS or (window != "ram-lak" and method != "fbp"):
        raise InputError(f"window: found {window!r}, expected one of {WINDOWS} with method 'fbp'")
    if binning > 1 and align and method == "imgr":
        raise InputError(f"binning: found {binning} where imgr aligns, expected 1; align before")
    if align + (motion is not None) + (alignment is not None) > 1:
        raise InputError("motion, alignment and align: found more than one, expected one of them")
    if alignment is not None:
        motion = alignment.motion
        valid_views = alignment.valid_views if valid_views is None else valid_views
    if valid_views is not None:
        valid_views = checked_valid_views(valid_views, scan.views)
    check_for_cluster(cluster, scan, method, METHODS)
    options = iterative.checked_options(method, options)
    keeping, own = checkpoint_of(checkpoint, resume)
    if keeping is not None and keeping.resume and options is None and not align:
        raise InputError(f"resume: found it with {method} alone, which keeps nothing on its way")
    with collected() as findings:
        devices = usable_devices(device, progress)
        scan = prepared(scan, corrections, progress=progress)
        valid_views = used_views(scan, valid_views)
        motion = None if motion is None else motion.about(*scan.window_offset)
        scan = scan.cropped()
        small = binned_scan(scan, binning)
        grid = grid or volume_grid(small.geometry, roi=roi, voxel_size=voxel_size)
        limits: dict[str, Any] = {
            "max_device_memory": max_device_memory,
            "max_host_memory": max_host_memory,
        }
        stream = Stream(devices[0], report=progress, **limits)
        fitted: Exact | None = None
        if method == "katsevich":
            # What it cannot treat it refuses before the long work.
            whole = without_gaps(small, valid_views)
            fitted = exact_helices(Radiographs(stream, whole, 1), whole.geometry, grid)
        if align and method != "imgr":
            begun = None if keeping is None else keeping.part("alignment")
            if keeping is not None and begun is not None:
                if options is None and keeping.resume and not begun.resume:
                    raise InputError.at(begun.folder, "checkpoint", "none", "one to go on from")
                keeping.resume = keeping.there if begun.resume else keeping.resume
            alignment = align_scan(
                scan,
                device=device,
                progress=progress,
                checkpoint=begun,
                cluster=cluster,
                **limits,
            )
            motion, valid_views = alignment.motion, alignment.valid_views
        if motion is not None:
            motion = binned_motion(motion, binning, scan.geometry.shape)
        scan = small
        warn_of_method(stream, scan, method)
        if alignment is None and not align:
            warn_of_scan(stream, scan, motion)
        if fitted is not None:
            there = scan.views if valid_views is None else int(valid_views.sum())
            _warn_of_gaps(fitted, grid, there)
        steps: tuple[ImgrStep, ...] = ()
        with executing(stream, devices, cluster, keeping, progress, limits) as executor:
            if options is not None:
                request = iterative.Request(scan, grid, motion, align, valid_views, options)
                steps, found = iterative.iterate(executor, stream, target, request, keeping)
                alignment = found or alignment
            else:
                work = SomePlanes(scan, grid, motion, valid_views, fitted, window)
                reconstruct_planes(executor, work, grid.shape, target, stage="back-projecting")
    if own and keeping is not None and not cancelled(findings):
        keeping.clear()
    return Reconstruction(tuple(findings), steps, alignment)


def _warn_of_gaps(fitted: Exact, grid: VolumeGrid, there: int) -> None:
    """Warn of views that stand in for others, and of heights that no helix holds."""
    helical = fitted[0]
    needed = sum(views.stop - views.start for views, _ in helical)
    if there < needed:
        Finding(
            "missing-views",
            f"katsevich needs every view: {needed - there} of {needed} that are missing or "
            "rejected are interpolated from their neighbours",
        ).warn()
    between = heights_between([helix for _, helix in helical], grid)
    if between is not None:
        ends = ", ".join(f"{views.start} to {views.stop - 1}" for views, _ in helical)
        Finding(
            "missing-heights",
            f"katsevich: none of {len(helical)} helices (views {ends}) holds the pi-intervals of "
            f"heights {between[0]:.4g} to {between[1]:.4g} mm between them, which are 0; if views "
            "are missing there, use method 'fbp'",
        ).warn()
