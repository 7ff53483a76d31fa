"""The coordinate systems of a CTSimU scenario in each frame: source, detector and stage.

Source: the CTSimU file format 1.x (BAM; ctsimu-toolbox, Apache-2.0, is the oracle of the tests).
A part has a centre and the axes u, w and v = w x u. In each frame the stage is turned about its w;
then deviations follow in their order: translations along an axis, or rotations about an axis
through a pivot (by default the part's centre), right-handed. Axes x, y, z are the world's, u, v, w
the part's own at that moment. Amounts and components of centres may drift: values are spread evenly
over the scan and interpolated.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.key_value_text import MOST, read_text

Floats = NDArray[np.float64]

_UNITS = {
    "nm": 1e-6, "um": 1e-3, "mm": 1.0, "cm": 10.0, "dm": 100.0, "m": 1000.0,
    "deg": pi / 180, "rad": 1.0,
}  # fmt: skip
_WORLD = dict(zip("xyz", np.eye(3), strict=True))


@dataclass(frozen=True)
class Json:
    """A part of a JSON file that knows where it stands, for messages."""

    path: Path
    value: Any
    where: str = ""

    @classmethod
    def read(cls, path: Path) -> Json:
        """Read a file.

        Raises
        ------
        InputError
            If it is no JSON object.
        """
        try:
            value = json.loads(read_text(path))
        except json.JSONDecodeError as error:
            raise InputError(f"{path}: cannot be read as JSON: {error}") from error
        if not isinstance(value, dict):
            raise InputError.at(path, "content", type(value).__name__, "a JSON object")
        return cls(path, value)

    def get(self, *keys: str) -> Json | None:
        """Return what is below some keys, or None where there is nothing or null."""
        value, where = self.value, self.where
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
            where = f"{where}.{key}" if where else key
        return None if value is None else Json(self.path, value, where)

    def need(self, *keys: str) -> Json:
        """Return what is below some keys.

        Raises
        ------
        InputError
            If there is nothing.
        """
        found = self.get(*keys)
        if found is None:
            where = ".".join(filter(None, [self.where, *keys]))
            raise InputError.at(self.path, where, "nothing", "a value")
        return found

    def items(self) -> list[Json]:
        """Return the items of a list; one that is no list is the only item."""
        values = self.value if isinstance(self.value, list) else [self.value]
        return [Json(self.path, v, f"{self.where}[{k}]") for k, v in enumerate(values)]

    def number(self, unit: str | None = None) -> float:
        """Return a number, or that of a value with its unit, in mm or rad.

        Parameters
        ----------
        unit : str, optional
            Of numbers without one.

        Raises
        ------
        InputError
            If it is none, or of another unit.
        """
        value = self.value
        if isinstance(value, dict):
            unit, value = value.get("unit") or unit, value.get("value")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError.at(self.path, self.where, repr(value), "a number")
        if not math.isfinite(value):
            raise InputError.at(self.path, self.where, value, "a finite number")
        return float(value) * self.factor(unit)

    def whole(self) -> int:
        """Return a whole number above 0, of views or pixels.

        Raises
        ------
        InputError
            If it is none.
        """
        value = self.number()
        if not 1 <= value <= MOST or value != int(value):
            expected = f"a whole number of 1 to {MOST}"
            raise InputError.at(self.path, self.where, f"{value:g}", expected)
        return int(value)

    def factor(self, unit: str | None) -> float:
        """Return the factor from a unit to mm or rad."""
        if unit in (None, "px", ""):
            return 1.0
        if unit not in _UNITS:
            raise InputError.at(self.path, self.where, f"unit {unit!r}", ", ".join(_UNITS))
        return _UNITS[unit]

    def unit(self, default: str) -> str:
        """Return the unit of a value."""
        told = self.value.get("unit") if isinstance(self.value, dict) else None
        return str(told or default)


@dataclass
class Pose:
    """Centre (3,) and axes u, v, w (rows of (3, 3)) of a part in a frame."""

    centre: Floats
    axes: Floats

    def rotate(self, axis: Floats, angle: float, pivot: Floats) -> None:
        """Turn about an axis through a point."""
        turn = _rotation(axis, angle)
        self.centre = pivot + turn @ (self.centre - pivot)
        self.axes = self.axes @ turn.T


def part_poses(part: Json, turns: Sequence[float], *, known_only: bool) -> list[Pose]:
    """Return where a part stands in each frame.

    Parameters
    ----------
    part : Json
        ``geometry.stage`` and the like.
    turns : sequence of float
        Rotation about its w in each frame [rad].
    known_only : bool
        Leave out deviations and drifts that are not known to the reconstruction.

    Raises
    ------
    InputError
        If something is missing or of a form that is not read.
    """
    u, w = (_vector(part.need(name)) for name in ("vector_u", "vector_w"))
    u, w = u / np.linalg.norm(u), w / np.linalg.norm(w)
    deviations = part.get("deviations")
    listed = deviations.items() if deviations is not None else []
    centre = part.need("center" if part.get("center") is not None else "centre")
    poses = []
    for frame, turn in enumerate(turns):
        progress = frame / (len(turns) - 1) if len(turns) > 1 else 0.0
        pose = Pose(_vector(centre), np.array([u, np.cross(w, u), w]))
        pose.rotate(pose.axes[2], turn, pose.centre)
        for deviation in listed:
            known = deviation.get("known_to_reconstruction")
            if not (known_only and known is not None and known.value is False):
                _deviate(pose, deviation, progress, known_only)
        pose.centre = pose.centre + np.array(
            [_drift(centre.need(axis), "mm", progress, known_only) for axis in "xyz"]
        )
        poses.append(pose)
    return poses


def _deviate(pose: Pose, deviation: Json, progress: float, known_only: bool) -> None:
    """Apply one deviation."""
    kind = deviation.need("type").value
    native = {"translation": "mm", "rotation": "rad"}.get(kind)
    if native is None:
        where = f"{deviation.where}.type"
        raise InputError.at(deviation.path, where, repr(kind), "translation or rotation")
    amount = deviation.need("amount")
    size = amount.number(native) + _drift(amount, native, progress, known_only)
    axis = _direction(pose, deviation.need("axis"))
    if kind == "translation":
        pose.centre = pose.centre + size * axis
        return
    pivot = deviation.get("pivot")
    pose.rotate(axis, size, pose.centre if pivot is None else _point(pose, pivot))


def _direction(pose: Pose, axis: Json) -> Floats:
    """Return the unit vector of a named axis, or of one in components."""
    own = dict(zip("uvw", pose.axes, strict=True))
    if isinstance(axis.value, str):
        named = {**_WORLD, **own}.get(axis.value)
        if named is None:
            raise InputError.at(axis.path, axis.where, repr(axis.value), "x, y, z, u, v or w")
        return np.asarray(named)
    vector = _point(Pose(np.zeros(3), pose.axes), axis)
    return vector / np.linalg.norm(vector)


def _point(pose: Pose, components: Json) -> Floats:
    """Point of the world, given there or in a part's own coordinates."""
    if components.get("x") is not None:
        return _vector(components)
    own = [components.need(axis).number("mm") for axis in "uvw"]
    return np.asarray(pose.centre + np.array(own) @ pose.axes)


def _vector(components: Json) -> Floats:
    """Read x, y and z, as they are without drifts [mm]."""
    return np.array([components.need(axis).number("mm") for axis in "xyz"])


def _drift(amount: Json, native: str, progress: float, known_only: bool) -> float:
    """Sum of the drifts of an amount at a part of the scan."""
    drifts = amount.get("drifts", "value") or amount.get("drifts")
    total = 0.0
    for drift in drifts.items() if drifts is not None else []:
        known = drift.get("known_to_reconstruction")
        if known_only and known is not None and known.value is False:
            continue
        if drift.get("value") is None:
            raise InputError.at(drift.path, drift.where, "no value", "numbers; files are not read")
        values = [item.number() for item in drift.need("value").items()]
        factor = drift.factor(drift.unit(amount.unit(native)))
        place = progress * (len(values) - 1)
        total += factor * float(np.interp(place, np.arange(len(values)), values))
    return total


def _rotation(axis: Floats, angle: float) -> Floats:
    """Matrix that turns about a unit vector, right-handed."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew)
