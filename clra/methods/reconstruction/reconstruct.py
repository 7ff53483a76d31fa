"""From a scan to a volume: picks the method and the defaults."""

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.methods.alignment.align import align as align_scan
from clra.methods.alignment.result import AlignmentResult
from clra.methods.correction import corrected
from clra.methods.execution.several_devices import on_devices
from clra.methods.reconstruction import iterative
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.methods.reconstruction.katsevich import Exact, exact_helices, katsevich
from clra.methods.reconstruction.missing_views import without_gaps
from clra.methods.truncation import truncated
from clra.model.angular_coverage import part_of_a_turn
from clra.model.detector_pose import steep_rows
from clra.model.grid import VolumeGrid, default_grid
from clra.model.helix.pi_intervals import heights_between
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.model.validation import believed_views
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
    progress: ProgressCallback | None = None,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
    **options: Any,
) -> NDArray[np.float32]:
    """Reconstruct a volume.

    Parameters
    ----------
    scan : Scan
        Radiographs and their geometry.
    method : {"fbp", "katsevich", "osem-tr", "imgr"}
        Ramp-filtered back-projection, for any trajectory; Katsevich's, which is exact, for helices
        and double helices; ordered subsets for counted photons
        (`osem_tr`); or the paper's Algorithm 3, which solves the lowest
        resolution by these and corrects the higher ones once (`imgr`).
    grid : VolumeGrid, optional
        Where to reconstruct; by default the whole field of view
        (:func:`clra.model.grid.default_grid`).
    motion : Motion, optional
        Of the radiographs, absorbed into the geometry, so that nothing is resampled; but
        "katsevich" needs ideal rows and resamples each radiograph once.
    align : bool
        Estimate the motion first, with the defaults of :func:`clra.align`; "imgr" does so on the
        way.
    device : str or cl.Device, optional
        As `choose_device` takes it, or "all" to share the work out to all
        devices of the best kind; alignment and iterative methods take the first of them.
    alignment : AlignmentResult, optional
        In place of `motion`: views that it rejects are left out.
    valid_views : ndarray of bool, (views,), optional
        Views to reconstruct from; by default all, or those that the alignment did not reject.
        "katsevich" needs every view: what lies between the radiographs beside stands in for the
        others, and for views that the scan lacks.
    progress : callable, optional
        Called with a :class:`clra.progress.Progress` as work goes on.
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used, see `Stream`. The volume that is returned
        comes on top: :func:`reconstruct_into` takes one larger than the memory.
    **options
        Of "osem-tr" and "imgr": the fields of `OrderedSubsets`
        (subsets, passes, update, initial, i0, background); of "imgr" also levels and cycles, as
        :func:`clra.methods.reconstruction.imgr.imgr` takes them.

    Returns
    -------
    ndarray of float32, (nz, ny, nx)
        Attenuation [1/mm].

    Raises
    ------
    InputError
        If the method or an option of it is unknown, no view is valid_views, both `motion` and
        `align` are given, or the scan is one that Katsevich's method cannot treat; says what pitch,
        detector or field of view would do.
    """
    planes = HostPlanes(grid or default_grid(scan.cropped().geometry))
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
        progress=progress,
        max_device_memory=max_device_memory,
        max_host_memory=max_host_memory,
        **options,
    )
    return planes.volume


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
    progress: ProgressCallback | None = None,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
    **options: Any,
) -> None:
    """Reconstruct a volume, and hand it on some planes at a time.

    Parameters
    ----------
    target : PlaneWriter
        Takes the planes, each once; `open_volume` gives one that writes a
        file.
    scan, method, grid, motion, align, device, alignment, valid_views, progress, \
    max_device_memory, max_host_memory, options
        As :func:`reconstruct` takes them.

    Raises
    ------
    InputError
        As :func:`reconstruct` does.
    """
    if method not in METHODS:
        raise InputError(f"method: found {method!r}, expected one of {METHODS}")
    if align + (motion is not None) + (alignment is not None) > 1:
        raise InputError("motion, alignment and align: found more than one, expected one of them")
    if alignment is not None:
        motion = alignment.motion
        valid_views = alignment.valid_views if valid_views is None else valid_views
    if valid_views is not None:
        valid_views = believed_views(valid_views, scan.views)
    iterative.sorted_options(method, options)  # refuses what is wrong before the long work
    motion = None if motion is None else motion.about(*scan.window_offset)
    scan = scan.cropped()
    grid = grid or default_grid(scan.geometry)
    devices = usable_devices(device, progress)
    limits: dict[str, Any] = {
        "max_device_memory": max_device_memory,
        "max_host_memory": max_host_memory,
    }
    stream = Stream(devices[0], report=progress, **limits)
    fitted: Exact | None = None
    if method == "katsevich":
        # What it cannot treat it refuses before the long work.
        whole = without_gaps(scan, valid_views)
        fitted = exact_helices(Radiographs(stream, whole, 1), whole.geometry, grid)
    if align and method != "imgr":
        aligned = align_scan(scan, device=devices[0], progress=progress, **limits)
        motion = aligned.motion
        valid_views = aligned.valid_views
    if fitted is not None:
        _warn_of_gaps(fitted, grid, scan.views if valid_views is None else int(valid_views.sum()))
    notes = []
    if method == "fbp":
        notes = [part_of_a_turn(scan.geometry), steep_rows(scan.geometry)]
    if method != "katsevich":  # that refuses such samples
        notes.append(truncated(Radiographs(stream, scan, 1)))
    for note in filter(None, notes):
        warnings.warn(note, stacklevel=2)
    if method in iterative.METHODS:
        iterative.iterate(stream, target, scan, method, grid, motion, align, valid_views, options)
        return

    def work(stream: Stream, planes: slice, target: PlaneWriter) -> None:
        if fitted is not None:
            ideal = scan if motion is None else corrected(stream, scan, motion)
            whole = without_gaps(ideal, valid_views)
            radiographs = Radiographs(stream, whole, 1)
            part = grid.slab(planes.start, planes.stop)
            katsevich(stream, radiographs, whole.geometry, part, fitted=fitted, target=target)
        else:
            geometry = scan.geometry if motion is None else scan.geometry.with_motion(motion)
            radiographs = Radiographs(stream, scan, 1)
            ramp_fbp(
                stream,
                radiographs,
                geometry,
                grid,
                valid_views=valid_views,
                planes=planes,
                target=target,
            )

    if len(devices) == 1:
        work(stream, slice(0, grid.shape[0]), target)
    else:
        on_devices(devices, work, grid.shape[0], target, progress=progress, **limits)


def _warn_of_gaps(fitted: Exact, grid: VolumeGrid, there: int) -> None:
    """Warn of views that stand in for others, and of heights that no helix holds."""
    helical = fitted[0]
    needed = sum(views.stop - views.start for views, _ in helical)
    if there < needed:
        warnings.warn(
            f"katsevich needs every view: {needed - there} of {needed} that are missing or "
            "rejected are interpolated from their neighbours",
            stacklevel=3,
        )
    between = heights_between([helix for _, helix in helical], grid)
    if between is not None:
        ends = ", ".join(f"{views.start} to {views.stop - 1}" for views, _ in helical)
        warnings.warn(
            f"katsevich: none of {len(helical)} helices (views {ends}) holds the pi-intervals of "
            f"heights {between[0]:.4g} to {between[1]:.4g} mm between them, which are 0; if views "
            "are missing there, use method 'fbp'",
            stacklevel=3,
        )
