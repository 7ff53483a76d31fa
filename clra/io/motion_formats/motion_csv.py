"""Motions as a table that spreadsheets and scripts read."""

from __future__ import annotations

import csv
import io
import os
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.atomic import atomic_path
from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion
from clra.model.rigid.rigid_motion import RigidMotion

COLUMNS = ("view", "shift_u_pixel", "shift_v_pixel", "magnification", "valid")
RIGID = (
    *(f"translation_{axis}_mm" for axis in ("u", "v", "beam")),
    *(f"rotation_{axis}_degree" for axis in ("u", "v", "beam")),
)
"""Further columns of a rigid motion, in the order of its table."""


def write_motion_csv(
    path: str | os.PathLike[str], motion: Motion, valid_views: NDArray[np.bool_] | None = None
) -> None:
    """Write a motion as a table; the file appears whole or not at all.

    Parameters
    ----------
    path : path-like
        The file.
    motion : Motion
        A line a view: its number from 0, shift_u towards higher columns and shift_v towards higher
        rows [pixel of the whole detector], magnification about the detector's middle; of a rigid
        motion also its translations along and rotations about u, v and the beam (`RIGID`).
    valid_views : ndarray of bool, (views,), optional
        The last column, 1 or 0; all 1 by default.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    valid = np.ones(motion.views, np.bool_) if valid_views is None else valid_views
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    numbers = np.stack([motion.shift_u, motion.shift_v, motion.magnification], axis=1)
    more = np.empty((motion.views, 0))
    if isinstance(motion, RigidMotion):
        more = np.concatenate([motion.translation, np.degrees(motion.rotation)], axis=1)
    table.writerow([*COLUMNS, *RIGID[: more.shape[1]]])
    for view, (row, good, rest) in enumerate(zip(numbers, valid, more, strict=True)):
        table.writerow([view, *map(repr, row.tolist()), int(good), *map(repr, rest.tolist())])
    with atomic_path(path) as temporary:
        temporary.write_text(text.getvalue(), encoding="ascii")


def is_motion_csv(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a table for :func:`read_motion_csv`, by the names of its columns."""
    if Path(path).suffix.lower() != ".csv":
        return False
    try:
        start = Path(path).read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except OSError:
        return False
    header = next((line for line in start if not line.startswith("#")), "")
    return COLUMNS[1] in header and COLUMNS[2] in header


def read_motion_csv(
    path: str | os.PathLike[str], geometry: ConeBeamGeometry | None = None
) -> tuple[Motion, NDArray[np.bool_]]:
    """Read a motion from a table.

    Parameters
    ----------
    path : path-like
        The first line names the columns: shift_u_pixel and shift_v_pixel; magnification (else 1),
        valid (else 1) and view (else 0, 1, 2 ...), which may be in any order.
    geometry : ConeBeamGeometry, optional
        Of the scan without motion; needed where the table has the columns `RIGID`, which then
        count instead of the shifts.

    Returns
    -------
    motion : Motion
        A :class:`clra.model.rigid.rigid_motion.RigidMotion` where the table has those columns.
    valid_views : ndarray of bool, (views,)

    Raises
    ------
    InputError
        If it is no such table, a view is missing or there twice, or a rigid motion does not fit the
        geometry.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            lines = list(csv.DictReader(line for line in file if not line.startswith("#")))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{os.fspath(path)}: cannot be read as CSV: {reason}") from error
    missing = [name for name in COLUMNS[1:3] if not lines or name not in lines[0]]
    if missing:
        found = "no lines" if not lines else f"columns {', '.join(map(str, lines[0]))}"
        raise InputError.at(path, "header", found, f"{' and '.join(missing)} too")
    columns = {
        "view": _column(path, lines, "view", [str(n) for n in range(len(lines))]),
        **{name: _column(path, lines, name, ["1"] * len(lines)) for name in COLUMNS[1:]},
    }
    order = np.argsort(columns["view"], kind="stable")
    if not np.array_equal(columns["view"][order], np.arange(len(lines))):
        raise InputError.at(path, "view", "views missing or twice", f"0 to {len(lines) - 1}")
    valid = columns["valid"][order] != 0
    if set(RIGID) <= set(lines[0]):
        table = np.stack([_column(path, lines, name, [])[order] for name in RIGID], axis=1)
        if geometry is None or geometry.views != len(lines):
            there = "none" if geometry is None else f"{geometry.views} views of the scan"
            raise InputError.at(path, "view", f"a rigid motion of {len(lines)}, {there}", "as many")
        table[:, 3:] = np.radians(table[:, 3:])
        return RigidMotion.of(geometry, table), valid
    motion = Motion(
        shift_u=columns["shift_u_pixel"][order],
        shift_v=columns["shift_v_pixel"][order],
        magnification=columns["magnification"][order],
    )
    return motion, valid


def _column(
    path: str | os.PathLike[str], lines: list[dict[str, str]], name: str, default: list[str]
) -> NDArray[np.float64]:
    texts = [line.get(name, other) for line, other in zip_longest(lines, default)]
    try:
        values = np.array([float(text) for text in texts])
    except (TypeError, ValueError):
        values = np.array([np.nan])
    if not np.isfinite(values).all():
        raise InputError.at(Path(path), name, "what is no finite number", "a number a line")
    return values
