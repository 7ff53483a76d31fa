"""Volumes by iterative methods: their options, and where their results go."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import Cancelled, InputError
from clra.findings import Finding
from clra.methods.alignment.reprojection import with_margin
from clra.methods.alignment.result import AlignmentResult
from clra.methods.execution.checkpoint import Checkpoint, Saved, identity
from clra.methods.execution.executor import InProcess, WorkerGroup
from clra.methods.reconstruction.imgr import imgr
from clra.methods.reconstruction.imgr_level import MultigridLevel
from clra.methods.reconstruction.imgr_state import ImgrStep
from clra.methods.reconstruction.osem_tr import OrderedSubsets, osem_tr, start_volume
from clra.methods.shared_work.shared_multigrid_level import SharedMultigridLevel
from clra.methods.shared_work.shared_ordered_subsets import shared_osem_tr, shared_start_volume
from clra.methods.shared_work.shared_scan import SharedScan, levels_by
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import PlaneSource, PlaneWriter

METHODS = ("osem-tr", "imgr")


@dataclass(frozen=True, kw_only=True)
class Multigrid(OrderedSubsets):
    """How IMGR goes about it; its lowest level is reconstructed by ordered subsets.

    Parameters
    ----------
    levels : str
        Resolutions of a cycle: "QR-HR-FR", or "ER-QR-HR-FR" for large detectors; "auto" is the
        former.
    cycles : int, optional
        Most cycles; by default one without alignment, else until converged, three at most.
    **others
        As for :class:`OrderedSubsets`; `initial` is no volume.
    """

    levels: str = "auto"
    cycles: int | None = None


Options = OrderedSubsets | Multigrid
_KINDS: dict[str, type[Options]] = {"osem-tr": OrderedSubsets, "imgr": Multigrid}


@dataclass(frozen=True)
class Request:
    """What is to be reconstructed.

    Attributes
    ----------
    scan : Scan
        Radiographs and their geometry.
    grid : VolumeGrid
        Where to.
    motion : Motion or None
        Of the radiographs.
    align : bool
        Whether "imgr" aligns on the way.
    valid_views : ndarray of bool or None, (views,)
        Views to reconstruct from; "imgr" finds out by itself where it aligns.
    options : OrderedSubsets or Multigrid
        Of the method, which they tell.
    """

    scan: Scan
    grid: VolumeGrid
    motion: Motion | None
    align: bool
    valid_views: NDArray[np.bool_] | None
    options: Options


def iterate(
    executor: InProcess | WorkerGroup,
    stream: Stream,
    target: PlaneWriter,
    request: Request,
    checkpoint: Checkpoint | None = None,
) -> tuple[tuple[ImgrStep, ...], AlignmentResult | None]:
    """Reconstruct, and hand the volume on some planes at a time.

    Parameters
    ----------
    executor : InProcess or WorkerGroup
        Who does the work.
    stream : Stream
        Device and memory budget of this process.
    target : PlaneWriter
        Takes the planes.
    request : Request
        What to reconstruct.
    checkpoint : Checkpoint, optional
        Keeps each finished level or pass; may hold some to go on from.

    Returns
    -------
    steps : tuple of ImgrStep
        Of "imgr".
    alignment : AlignmentResult or None
        Where it aligned.

    Raises
    ------
    InputError
        If an option is wrong, or the checkpoint is of another call.
    """
    options = request.options
    saved = None
    if checkpoint is not None:
        saved = checkpoint.begin(
            identity(
                request.scan,
                request.grid,
                {field.name: getattr(options, field.name) for field in fields(options)}
                | {"align": request.align},
                motion=request.motion,
                valid_views=request.valid_views,
            )
        )
    if isinstance(options, Multigrid):
        found = imgr(
            stream,
            request.scan,
            request.grid,
            levels=options.levels,
            cycles=options.cycles,
            align=request.align,
            motion=request.motion,
            valid_views=request.valid_views,
            truth=request.scan.truth,
            osem=options,
            checkpoint=checkpoint,
            saved=saved,
            make_level=levels_by(executor, request.scan, MultigridLevel, SharedMultigridLevel),
        )
        found.volume.write(target)
        return found.steps, found.alignment
    margin = (with_margin(request.grid).shape[0] - request.grid.shape[0]) // 2
    volume = _ordered_subsets(executor, stream, request, checkpoint, saved)
    volume.write(target, slice(margin, margin + request.grid.shape[0]))
    return (), None


def _ordered_subsets(
    executor: InProcess | WorkerGroup,
    stream: Stream,
    request: Request,
    checkpoint: Checkpoint | None,
    saved: Saved | None,
) -> PlaneSource:
    """Raise the likelihood pass by pass, on a grid with a margin."""
    scan, grid, motion = request.scan, request.grid, request.motion
    geometry = scan.geometry if motion is None else scan.geometry.with_motion(motion)
    wide = with_margin(grid)
    options = _widened(request.options, grid, wide)
    if saved is not None and saved.planes is not None:
        options = replace(options, initial=saved.planes)
    passes = 0 if saved is None else int(saved.values["passes"])
    how: dict[str, Any] = {
        "used": np.ones(geometry.shape, np.bool_) if scan.mask is None else scan.mask,
        "valid_views": request.valid_views,
        "done": passes,
    }
    so_far: PlaneSource

    def keep(number: int, volume: PlaneSource) -> None:
        nonlocal passes, so_far
        passes, so_far = number, volume
        if checkpoint is not None:
            kept = f"{number} of {options.passes} passes"
            checkpoint.save(kept, {"passes": number}, {}, volume)

    raising: Callable[[], object]
    if isinstance(executor, InProcess):
        radiographs = Radiographs(stream, scan, 1)
        so_far = volume = start_volume(
            stream, radiographs, geometry, wide, options, valid_views=request.valid_views
        )
        raising = partial(
            osem_tr, stream, radiographs, geometry, volume, options, after_pass=keep, **how
        )
    else:
        shared = SharedScan(executor, scan)
        given = shared.binned(stream, 1)
        parts = shared_start_volume(
            shared, stream, given, geometry, wide, options, valid_views=request.valid_views
        )
        so_far = shared.source(parts)
        raising = partial(
            shared_osem_tr,
            shared,
            stream,
            given,
            geometry,
            parts,
            options,
            after_pass=lambda number, parts: keep(number, shared.source(parts)),
            **how,
        )
    try:
        raising()
    except Cancelled:
        if not passes:
            raise
        told = f"the reconstruction was ended early, after {passes} of {options.passes} passes"
        Finding("cancelled", told).warn()
    return so_far


def options_for(method: str, given: Mapping[str, Any]) -> Options | None:
    """Return the options of a method.

    Parameters
    ----------
    method : str
        As :func:`clra.reconstruct` takes it.
    given : mapping
        By name; the others have their defaults.

    Raises
    ------
    InputError
        If the method has no such option, or not of that value.
    """
    kind = _KINDS.get(method)
    known = () if kind is None else tuple(field.name for field in fields(kind))
    for name in given:
        if name not in known:
            has = ", ".join(known) or "none"
            raise InputError(f"{name}: found an option that {method} does not have, it has {has}")
    return None if kind is None else kind(**given)


def checked_options(method: str, options: Options | None) -> Options | None:
    """Return the options of a method, its defaults if there are none.

    Raises
    ------
    InputError
        If they are those of another method.
    """
    kind = _KINDS.get(method)
    if options is None:
        return None if kind is None else kind()
    if type(options) is not kind:
        expected = "none" if kind is None else kind.__name__
        found = type(options).__name__
        raise InputError(f"options: found {found} with {method}, expected {expected}")
    return options


def _widened(osem: OrderedSubsets, grid: VolumeGrid, wide: VolumeGrid) -> OrderedSubsets:
    """Continue a volume to start from, if one is given, beyond the ends of its grid."""
    if isinstance(osem.initial, str):
        return osem
    if tuple(osem.initial.shape) != grid.shape:
        raise InputError(
            f"initial: found shape {osem.initial.shape}, expected {grid.shape} as in the grid"
        )
    margin = (wide.shape[0] - grid.shape[0]) // 2
    return replace(osem, initial=np.pad(osem.initial, [(margin, margin), (0, 0), (0, 0)], "edge"))
