"""Volumes by iterative methods: their options, and where their results go."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import Cancelled, InputError
from clra.findings import Finding
from clra.methods.alignment.reprojection import with_margin
from clra.methods.alignment.result import AlignmentResult
from clra.methods.execution.checkpoint import Checkpoint, Saved, identity
from clra.methods.reconstruction.imgr import imgr
from clra.methods.reconstruction.imgr_state import ImgrStep
from clra.methods.reconstruction.osem_tr import OrderedSubsets, osem_tr, start_volume
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.streaming.multigrid import cropped
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import PlaneWriter, Volume

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
    stream: Stream,
    target: PlaneWriter,
    request: Request,
    checkpoint: Checkpoint | None = None,
) -> tuple[tuple[ImgrStep, ...], AlignmentResult | None]:
    """Reconstruct, and hand the volume on some planes at a time.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
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
        )
        found.volume.write(target)
        return found.steps, found.alignment
    _ordered_subsets(stream, request, checkpoint, saved).write(target)
    return (), None


def _ordered_subsets(
    stream: Stream, request: Request, checkpoint: Checkpoint | None, saved: Saved | None
) -> Volume:
    """Raise the likelihood pass by pass, on a grid with a margin."""
    scan, grid, motion = request.scan, request.grid, request.motion
    geometry = scan.geometry if motion is None else scan.geometry.with_motion(motion)
    radiographs, wide = Radiographs(stream, scan, 1), with_margin(grid)
    done = 0 if saved is None else int(saved.values["passes"])
    options = _widened(request.options, grid, wide)
    if saved is not None and saved.planes is not None:
        options = replace(options, initial=saved.planes)
    volume = start_volume(
        stream, radiographs, geometry, wide, options, valid_views=request.valid_views
    )
    passes = done

    def keep(number: int) -> None:
        nonlocal passes
        passes = number
        if checkpoint is not None:
            kept = f"{number} of {options.passes} passes"
            checkpoint.save(kept, {"passes": number}, {}, volume)

    try:
        osem_tr(
            stream,
            radiographs,
            geometry,
            volume,
            options,
            used=np.ones(geometry.shape, np.bool_) if scan.mask is None else scan.mask,
            valid_views=request.valid_views,
            done=done,
            after_pass=keep,
        )
    except Cancelled:
        if not passes:
            raise
        told = f"the reconstruction was ended early, after {passes} of {options.passes} passes"
        Finding("cancelled", told).warn()
    return cropped(stream, volume, (wide.shape[0] - grid.shape[0]) // 2, grid)


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
