"""Checks that several values share: each raises with the field, what was found and expected."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError

Floats = NDArray[np.float64]


def whole(name: str, value: Any) -> int:
    """Check a whole number of at least one."""
    try:
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{name}: found {value!r}, expected a whole number") from None
    if number < 1:
        raise InputError(f"{name}: found {number}, expected at least 1")
    return number


def finite(name: str, value: Any) -> float:
    """Check a finite number."""
    number = float(value)
    if not math.isfinite(number):
        raise InputError(f"{name}: found {number}, expected a finite number")
    return number


def positive(name: str, value: Any) -> float:
    """Check a finite number above zero."""
    number = float(value)
    if not (math.isfinite(number) and number > 0):
        raise InputError(f"{name}: found {number}, expected a positive number")
    return number


def detector_shape(shape: Any) -> tuple[int, int]:
    """Check (rows, columns)."""
    try:
        rows, columns = shape
    except (TypeError, ValueError):
        raise InputError(f"shape: found {shape!r}, expected (rows, columns)") from None
    return whole("shape", rows), whole("shape", columns)


def same_views(**columns: Floats) -> None:
    """Check that all arrays are of as many views as the first."""
    first, *others = columns
    views = len(columns[first])
    for name in others:
        found = len(columns[name])
        if found != views:
            raise InputError(f"{name}: found {found} views, expected {views} as in {first}")


def selection(index: slice | ArrayLike) -> slice | NDArray[Any]:
    """Turn what selects views, a slice, integers or a mask, into an index that keeps the axis."""
    if isinstance(index, slice):
        return index
    chosen = np.atleast_1d(np.asarray(index))
    return chosen if chosen.size else chosen.astype(np.intp)


def vectors(name: str, value: ArrayLike, each: str) -> Floats:
    """Check and copy finite vectors (x, y, z), one for each of something; read-only."""
    array = np.array(value, dtype=np.float64, order="C")
    if array.ndim != 2 or array.shape[1] != 3 or not len(array):
        raise InputError(f"{name}: found shape {array.shape}, expected ({each}, 3), at least one")
    return _finite_array(name, array, each)


def column(name: str, value: ArrayLike, each: str) -> Floats:
    """Check and copy finite numbers, one for each of something; read-only."""
    array = np.array(value, dtype=np.float64, order="C")
    if array.ndim != 1 or not len(array):
        raise InputError(f"{name}: found shape {array.shape}, expected ({each},), at least one")
    return _finite_array(name, array, each)


def checked_valid_views(valid_views: ArrayLike, views: int) -> NDArray[np.bool_]:
    """Check which views are valid: one value each, at least one of them true.

    Only bool will do: as an index, numbers would choose views 0 and 1.
    """
    array = np.asarray(valid_views)
    if array.dtype != np.bool_ or array.shape != (views,) or not array.any():
        raise InputError(
            f"valid_views: found {array.shape} of {array.dtype}, {array.sum()} in all, "
            f"expected ({views},) of bool with one or more"
        )
    return array


def _finite_array(name: str, array: Floats, each: str) -> Floats:
    bad = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1)
    if bad.any():
        first = int(np.argmax(bad))
        raise InputError(
            f"{name}: found {array[first]} at {first} of the {each}, expected finite numbers"
        )
    array.flags.writeable = False
    return array


def all_but(exclude: Iterable[int], views: int) -> NDArray[np.bool_] | None:
    """Return which views are left if some are excluded.

    Parameters
    ----------
    exclude : iterable of int
        Views, from 0.
    views : int
        Of the scan.

    Returns
    -------
    ndarray of bool, (views,), or None
        None if none is excluded.

    Raises
    ------
    InputError
        If there is no such view, or none is left.
    """
    given = set(exclude)
    if not given:
        return None
    outside = [view for view in sorted(given) if not 0 <= view < views]
    if outside or len(given) == views:
        found = f"view {outside[0]}" if outside else "all views"
        raise InputError(f"exclude: found {found}, expected some of {views} views, from 0")
    valid = np.ones(views, np.bool_)
    valid[list(given)] = False
    return valid
