"""Geometries out and in: RTK's XML.

RTK's axes are (x, z, -y) of ours: it turns about its y. It describes the physical detector and
knows neither pixels nor which row of the image comes first.
"""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.atomic import atomic_path
from clra.model.geometry import ConeBeamGeometry

Floats = NDArray[np.float64]

_ROOT = "RTKThreeDCircularGeometry"
# RTK's own limit on the cosine between the rows and columns of a detector.
_SKEW = 1e-6
# Our numbers of one view, by the name that RTK's file has for each.
_NAMES = (
    "SourceToIsocenterDistance",
    "SourceToDetectorDistance",
    "GantryAngle",
    "OutOfPlaneAngle",
    "InPlaneAngle",
    "SourceOffsetX",
    "SourceOffsetY",
    "ProjectionOffsetX",
    "ProjectionOffsetY",
)


def write_rtk_geometry(path: str | os.PathLike[str], geometry: ConeBeamGeometry) -> None:
    """Write a geometry as RTK's XML; the file appears whole or not at all.

    RTK wants rows that count along its own column axis, which is +z of ours for an upright
    detector. Where ours count the other way (row 0 at the top), turn the radiographs upside down
    for RTK.

    Parameters
    ----------
    path : path-like
        The file.
    geometry : ConeBeamGeometry
        Its detectors must be rectangular: u perpendicular to v.

    Raises
    ------
    InputError
        If a detector is skewed: RTK cannot express it.
    OutputError
        If the file cannot be written.
    """
    numbers = _rtk_numbers(geometry)
    root = ElementTree.Element(_ROOT, version="3")
    for values, matrix in zip(numbers, _rtk_matrices(numbers), strict=True):
        projection = ElementTree.SubElement(root, "Projection")
        for name, value in zip(_NAMES, values, strict=True):
            ElementTree.SubElement(projection, name).text = f"{value:.17g}"
        rows = ["\n      " + " ".join(f"{entry:.17g}" for entry in row) for row in matrix]
        ElementTree.SubElement(projection, "Matrix").text = "".join(rows) + "\n    "
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    with atomic_path(path) as temporary:
        temporary.write_text(
            f'<?xml version="1.0"?>\n<!DOCTYPE RTKGEOMETRY>\n{text}\n', encoding="ascii"
        )


def read_rtk_geometry(
    path: str | os.PathLike[str],
    *,
    shape: tuple[int, int],
    pixel_size: float | tuple[float, float],
    top_down: bool = False,
) -> ConeBeamGeometry:
    """Read a geometry from RTK's XML.

    Parameters
    ----------
    path : path-like
        The file.
    shape : (int, int)
        Rows and columns of the detector, which RTK keeps with the images.
    pixel_size : float or (float, float)
        Of the detector; (row, column) steps where they differ [mm].
    top_down : bool
        Row 0 is the top of the radiographs; RTK's own stacks begin at the bottom.

    Returns
    -------
    ConeBeamGeometry
        The detector is centred on RTK's origin of the projections.

    Raises
    ------
    InputError
        If it is no such file, or asks for what a flat detector cannot be.
    """
    try:
        root = ElementTree.fromstring(Path(path).read_bytes())
    except (OSError, ElementTree.ParseError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{os.fspath(path)}: cannot be read as RTK's XML: {reason}") from error
    projections = root.findall("Projection")
    if root.tag != _ROOT or not projections:
        found = f"<{root.tag}> with {len(projections)} projections"
        raise InputError.at(path, "root", found, f"<{_ROOT}> with at least one")
    curved = root.find(".//RadiusCylindricalDetector")
    if curved is not None and float(curved.text or 0) != 0:
        raise InputError.at(path, "RadiusCylindricalDetector", curved.text, "0: a flat detector")
    numbers = np.array([[_value(path, root, p, name) for name in _NAMES] for p in projections])
    return _from_rtk_numbers(numbers, shape, pixel_size, -1.0 if top_down else 1.0)


def _value(
    path: str | os.PathLike[str],
    root: ElementTree.Element,
    projection: ElementTree.Element,
    name: str,
) -> float:
    """Read one number of a projection, or the one for all, or 0."""
    element = projection.find(name)
    if element is None:
        element = root.find(name)
    if element is None:
        return 0.0
    try:
        return float(element.text or "")
    except ValueError:
        raise InputError.at(path, name, repr(element.text), "a number") from None


def _rtk_numbers(geometry: ConeBeamGeometry) -> Floats:
    """Return RTK's nine numbers of each view, (views, 9) [mm, degree]."""
    row, column = (_unit(_to_rtk(vectors)) for vectors in (geometry.u, geometry.v))
    skew = np.abs(_dot(row, column))
    if skew.max() > _SKEW:
        view = int(np.argmax(skew))
        raise InputError(
            f"geometry: found u and v {np.rad2deg(np.arccos(skew[view])):.6f} degrees apart in "
            f"view {view}, expected 90: RTK knows only rectangular detectors"
        )
    source, detector = _to_rtk(geometry.source), _to_rtk(geometry.detector)
    normal = np.cross(row, column)
    # RTK's normal points at the source; a detector whose rows count the other way is the same
    # detector.
    upside = np.sign(_dot(normal, source - detector))[:, None]
    column, normal = column * upside, normal * upside
    gantry = np.arctan2(normal[:, 0], normal[:, 2])
    out_of_plane = -np.arcsin(np.clip(normal[:, 1], -1.0, 1.0))
    in_plane = np.arctan2(row[:, 1], column[:, 1])
    return np.stack(
        [
            _dot(normal, source),
            _dot(normal, source - detector),
            np.rad2deg(gantry) % 360.0,
            np.rad2deg(out_of_plane),
            np.rad2deg(in_plane),
            _dot(row, source),
            _dot(column, source),
            _dot(row, detector),
            _dot(column, detector),
        ],
        axis=1,
    )


def _from_rtk_numbers(
    numbers: Floats, shape: tuple[int, int], pixel_size: float | tuple[float, float], down: float
) -> ConeBeamGeometry:
    """Return the geometry of RTK's nine numbers of each view."""
    row_step, column_step = np.broadcast_to(np.asarray(pixel_size, np.float64), (2,))
    isocentre, length = numbers[:, 0:1], numbers[:, 1:2]
    frames = _rtk_frames(*np.deg2rad(numbers[:, 2:5]).T)
    row, column, normal = frames[:, 0], frames[:, 1], frames[:, 2]
    source = numbers[:, 5:6] * row + numbers[:, 6:7] * column + isocentre * normal
    detector = numbers[:, 7:8] * row + numbers[:, 8:9] * column + (isocentre - length) * normal
    return ConeBeamGeometry(
        source=_from_rtk(source),
        detector=_from_rtk(detector),
        u=_from_rtk(row) * column_step,
        v=_from_rtk(column) * row_step * down,
        shape=shape,
    )


def _rtk_frames(gantry: Floats, out_of_plane: Floats, in_plane: Floats) -> Floats:
    """Return row, column and normal direction of each detector, (views, 3, 3).

    They are the rows of the rotations Rz(-in_plane) Rx(-out_of_plane) Ry(-gantry).
    """
    (cg, sg), (co, so), (ci, si) = (
        (np.cos(a), np.sin(a)) for a in (gantry, out_of_plane, in_plane)
    )
    across = np.stack([cg, 0 * cg, -sg], axis=1)
    up = np.stack([so * sg, co, so * cg], axis=1)
    normal = np.stack([co * sg, -so, co * cg], axis=1)
    ci, si = ci[:, None], si[:, None]
    return np.stack([ci * across + si * up, -si * across + ci * up, normal], axis=1)


def _rtk_matrices(numbers: Floats) -> Floats:
    """Return the matrices from points to mm on the detector that RTK compares with the numbers."""
    frames = _rtk_frames(*np.deg2rad(numbers[:, 2:5]).T)
    matrices = np.zeros((len(numbers), 3, 4))
    for k, (sid, sdd, _, _, _, sx, sy, px, py) in enumerate(numbers):
        shift = np.array([[1, 0, sx - px], [0, 1, sy - py], [0, 0, 1]])
        onto = np.array([[-sdd, 0, 0, 0], [0, -sdd, 0, 0], [0, 0, 1, -sid]])
        aside = np.eye(4)
        aside[:2, 3] = -sx, -sy
        turn = np.eye(4)
        turn[:3, :3] = frames[k]
        matrices[k] = shift @ onto @ aside @ turn
    return matrices


def _to_rtk(vectors: Floats) -> Floats:
    x, y, z = vectors.T
    return np.stack([x, z, -y], axis=1)


def _from_rtk(vectors: Floats) -> Floats:
    x, y, z = vectors.T
    return np.stack([x, -z, y], axis=1)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.sum(a * b, axis=1))
