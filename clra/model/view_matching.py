"""Views of two scans that look at the sample alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.validation import vectors

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Match:
    """Views of a scan beside those of another.

    Attributes
    ----------
    views : ndarray of int, (n,)
        For each view of the other scan the view of this one that looks most alike.
    distance : ndarray, (n,)
        Root mean square distance, over the points, of where the two see a point [pixel]; infinite
        where one of them does not see it.
    offset_u, offset_v : ndarray, (n,)
        Mean of where this scan's view sees the points less where the other's does [pixel].
    """

    views: NDArray[np.intp]
    distance: Floats
    offset_u: Floats
    offset_v: Floats


def match_views(geometry: ConeBeamGeometry, other: ConeBeamGeometry, points: ArrayLike) -> Match:
    """Find for each view of another scan the one that looks most alike.

    Parameters
    ----------
    geometry, other : ConeBeamGeometry
        Of the two scans, of detectors alike.
    points : array_like, (n, 3)
        Points of the sample [mm]; a few dozen will do.

    Returns
    -------
    Match

    Raises
    ------
    InputError
        If the detectors differ in rows or columns.
    """
    if geometry.shape != other.shape:
        raise InputError(
            f"detector: found {other.rows} x {other.columns} pixels, expected {geometry.rows} x "
            f"{geometry.columns} as in the scan"
        )
    points = vectors("points", points, "points")
    here, there = (
        # A point behind a source is seen nowhere near.
        np.nan_to_num(g.project(points), nan=1e9).reshape(g.views, -1)
        for g in (geometry, other)
    )
    distance, views = cKDTree(here).query(there)
    aside = (here[views] - there).reshape(other.views, -1, 2).mean(axis=1)
    return Match(views, distance / np.sqrt(len(points)), aside[:, 0], aside[:, 1])
