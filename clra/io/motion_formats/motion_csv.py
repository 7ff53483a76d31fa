"""Motions as a table that spreadsheets and scripts read."""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.atomic import atomic_path
from clra.model.motion import Motion

COLUMNS = ("view", "shift_u_pixel", "shift_v_pixel", "magnification", "valid")


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
        rows [pixel of the whole detector], magnification about the detector's middle.
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
    table.writerow(COLUMNS)
    numbers = zip(motion.shift_u, motion.shift_v, motion.magnification, valid, strict=True)
    for view, (u, v, m, good) in enumerate(numbers):
        table.writerow([view, repr(float(u)), repr(float(v)), repr(float(m)), int(good)])
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


def read_motion_csv(path: str | os.PathLike[str]) -> tuple[Motion, NDArray[np.bool_]]:
    """Read a motion from a table.

    Parameters
    ----------
    path : path-like
        The first line names the columns: shift_u_pixel and shift_v_pixel; magnification (else 1),
        valid (else 1) and view (else 0, 1, 2 ...), which may be in any order.

    Returns
    -------
    motion : Motion
    valid_views : ndarray of bool, (views,)

    Raises
    ------
    InputError
        If it is no such table, or a view is missing or there twice.
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
    motion = Motion(
        shift_u=columns["shift_u_pixel"][order],
        shift_v=columns["shift_v_pixel"][order],
        magnification=columns["magnification"][order],
    )
    return motion, columns["valid"][order] != 0


def _column(
    path: str | os.PathLike[str], lines: list[dict[str, str]], name: str, default: list[str]
) -> NDArray[np.float64]:
    texts = [line.get(name, other) for line, other in zip(lines, default, strict=True)]
    try:
        values = np.array([float(text) for text in texts])
    except (TypeError, ValueError):
        values = np.array([np.nan])
    if not np.isfinite(values).all():
        raise InputError.at(Path(path), name, "what is no finite number", "a number a line")
    return values
