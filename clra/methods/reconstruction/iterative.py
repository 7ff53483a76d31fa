"""Volumes by iterative methods: their options, and where their results go."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.methods.alignment.reprojection import with_margin
from clra.methods.reconstruction.imgr import imgr
from clra.methods.reconstruction.osem_tr import OrderedSubsets, osem_tr, start_volume
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.streaming.multigrid import cropped
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import PlaneWriter

METHODS = ("osem-tr", "imgr")


def iterate(
    stream: Stream,
    target: PlaneWriter,
    scan: Scan,
    method: str,
    grid: VolumeGrid,
    motion: Motion | None,
    align: bool,
    valid_views: NDArray[np.bool_] | None,
    options: Mapping[str, Any],
) -> None:
    """Reconstruct, and hand the volume on some planes at a time.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    target : PlaneWriter
        Takes the planes.
    scan : Scan
        Radiographs and their geometry.
    method : {"osem-tr", "imgr"}
        Which.
    grid : VolumeGrid
        Where to reconstruct.
    motion : Motion or None
        Of the radiographs.
    align : bool
        Whether "imgr" aligns on the way.
    valid_views : ndarray of bool or None, (views,)
        Views to reconstruct from; "imgr" finds out by itself where it aligns.
    options : mapping
        As :func:`sorted_options` takes them.

    Raises
    ------
    InputError
        If an option is unknown or wrong.
    """
    osem, cycle = sorted_options(method, options)
    if method == "imgr":
        cycle |= {"align": align, "motion": motion, "valid_views": valid_views}
        found = imgr(stream, scan, grid, osem=osem, **cycle)
        found.volume.write(target)
        return
    geometry = scan.geometry if motion is None else scan.geometry.with_motion(motion)
    radiographs, wide = Radiographs(stream, scan, 1), with_margin(grid)
    osem = _widened(osem, grid, wide)
    volume = start_volume(stream, radiographs, geometry, wide, osem, valid_views=valid_views)
    used = np.ones(geometry.shape, np.bool_) if scan.mask is None else scan.mask
    osem_tr(stream, radiographs, geometry, volume, osem, used=used, valid_views=valid_views)
    cropped(stream, volume, (wide.shape[0] - grid.shape[0]) // 2, grid).write(target)


def sorted_options(
    method: str, options: Mapping[str, Any]
) -> tuple[OrderedSubsets, dict[str, Any]]:
    """Sort the options of a method.

    Parameters
    ----------
    method : str
        As :func:`clra.reconstruct` takes it.
    options : mapping
        By name.

    Returns
    -------
    osem : OrderedSubsets
        How subsets are used.
    cycle : dict
        Of :func:`clra.methods.reconstruction.imgr.imgr`: levels and cycles.

    Raises
    ------
    InputError
        If the method has no such option.
    """
    subsets = tuple(f.name for f in fields(OrderedSubsets)) if method in METHODS else ()
    multigrid = ("levels", "cycles") if method == "imgr" else ()
    for name in options:
        if name not in subsets + multigrid:
            known = ", ".join(subsets + multigrid) or "none"
            raise InputError(f"{name}: found an option that {method} does not have, it has {known}")
    return (
        OrderedSubsets(**{k: v for k, v in options.items() if k in subsets}),
        {k: v for k, v in options.items() if k in multigrid},
    )


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
