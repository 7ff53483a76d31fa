"""Views that operators are made for and called for: their number, their order, their weights."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry


def check_geometry(geometry: ConeBeamGeometry, expected: tuple[int, int, int]) -> None:
    """Refuse a geometry of other views or another detector.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        To be checked.
    expected : tuple of int
        Views, rows and columns.

    Raises
    ------
    InputError
        If they differ.
    """
    found = (geometry.views, geometry.rows, geometry.columns)
    if found != expected:
        raise InputError(f"geometry: found {found}, expected {expected} as (views, rows, columns)")


def successive(chosen: slice | None, total: int, name: str = "views") -> tuple[int, int]:
    """Return the first of the views, or rows, that are chosen, and one past the last.

    Parameters
    ----------
    chosen : slice or None
        Of `total` views; all if None.
    total : int
        Number of views of the geometry.
    name : str
        For the error.

    Raises
    ------
    InputError
        If these are not one or more successive views.
    """
    start, stop, step = (slice(None) if chosen is None else chosen).indices(total)
    if step != 1 or stop <= start:
        raise InputError(f"{name}: found {chosen}, expected successive ones of {total}")
    return start, stop


def view_weights(view_weight: ArrayLike | None, views: int) -> NDArray[np.float64]:
    """Return weights of views as given, (views,); 1 by default."""
    weights = np.ones(views) if view_weight is None else np.asarray(view_weight, np.float64)
    if weights.shape != (views,) or not np.all(np.isfinite(weights)):
        raise InputError(f"view_weight: found {weights.shape}, expected {views} finite numbers")
    return weights
