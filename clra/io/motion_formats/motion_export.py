"""Motions for other programs: picks the format by the program's name."""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.atomic import atomic_path
from clra.io.motion_formats.image_transforms import imod_transforms, nabu_translations
from clra.io.motion_formats.motion_csv import write_motion_csv
from clra.io.motion_formats.peer_geometry import cil_arrays, tigre_arrays, with_one_pixel
from clra.io.motion_formats.rtk import write_rtk_geometry
from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion

PROGRAMS = ("astra", "cil", "csv", "imod", "nabu", "rtk", "tigre")
# These describe the geometry, not the images, or depend on the beam.
WITH_SCAN = ("astra", "cil", "nabu", "rtk", "tigre")
# Half the fan below which a beam is as good as parallel [rad].
_PARALLEL = 1e-3


def export_motion(
    path: str | os.PathLike[str],
    to: str,
    motion: Motion,
    *,
    geometry: ConeBeamGeometry | None = None,
    valid_views: NDArray[np.bool_] | None = None,
) -> None:
    """Write a motion for another program; the file appears whole or not at all.

    Parameters
    ----------
    path : path-like
        The file.
    to : {"astra", "cil", "csv", "imod", "nabu", "rtk", "tigre"}
        "astra": the vectors of ``cone_vec`` with the motion in them, (views, 12), as .npy. "rtk":
        the geometry with the motion in it as RTK's XML. "cil", "tigre": the same as named arrays,
        .npz, see :mod:`clra.io.motion_formats.peer_geometry`. "nabu": horizontal and vertical
        translations, "imod": transforms that align the images, both as text, see
        :mod:`clra.io.motion_formats.image_transforms`. "csv": a table.
    motion : Motion
        As aligned. "astra", "cil", "rtk" and "csv" express any rigid motion of the sample; "nabu"
        and "imod" no rotation, "tigre" only those about z.
    geometry : ConeBeamGeometry, optional
        Of the scan, without the motion; all but "csv" and "imod" need it.
    valid_views : ndarray of bool, (views,), optional
        Of the table; others take all views.

    Raises
    ------
    InputError
        If there is no such program, the geometry is missing, or the program cannot express it.
    OutputError
        If the file cannot be written.
    """
    if to not in PROGRAMS:
        raise InputError(f"to: found {to!r}, expected one of {', '.join(PROGRAMS)}")
    if to == "csv":
        write_motion_csv(path, motion, valid_views)
        return
    if to == "imod":
        with atomic_path(path) as temporary:
            np.savetxt(temporary, imod_transforms(motion), fmt="%14.9f")
        return
    if geometry is None:
        raise InputError(f"geometry: found none, expected the scan's to export to {to}")
    moved = geometry.with_motion(motion)
    if to == "rtk":
        write_rtk_geometry(path, with_one_pixel(moved))
        return
    if to == "nabu":
        width = geometry.columns * np.linalg.norm(geometry.u, axis=1) / geometry.source_to_detector
        cone = bool(0.5 * np.median(width) > _PARALLEL)
        with atomic_path(path) as temporary:
            np.savetxt(temporary, nabu_translations(motion, cone=cone), fmt="%.9g")
        return
    arrays: Callable[[ConeBeamGeometry], dict[str, object]] = (
        cil_arrays if to == "cil" else tigre_arrays
    )
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        if to == "astra":
            np.save(file, moved.to_astra())
        else:
            np.savez(file, allow_pickle=False, **arrays(moved))  # type: ignore[arg-type]
