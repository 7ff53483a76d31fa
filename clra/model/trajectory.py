"""Trajectories of the source about the sample."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.validation import finite, positive, whole

Floats = NDArray[np.float64]

PAPER: Mapping[str, Any] = MappingProxyType(
    {
        "z_step": 0.001641,
        "source_to_axis": 4.3627,
        "source_to_detector": 436.27,
        "pixel_size": 0.4544,
        "shape": (928, 512),
    }
)
"""The simulations of the paper, section 2: ``space_filling(3456, **PAPER)`` and
``helix(3456, angle_step=math.radians(0.5), **PAPER)``. The detector's shape is not in the paper;
this one sees the phantom's whole width."""

ROTATIONS, ROWS = ("cw", "ccw"), ("bottom", "top")

# The angle of the paper's space-filling trajectory, "about 15.3 degrees".
_NEAR = math.radians(15.3)
# A circle of more turns than this, or a step of more than one, is one in degrees.
_TURNS = 4


def circular(
    views: int,
    *,
    source_to_axis: float,
    source_to_detector: float,
    pixel_size: float,
    shape: tuple[int, int],
    start: float = 0.0,
    arc: float = 2 * math.pi,
    rotation: str = "cw",
    row0: str = "bottom",
) -> ConeBeamGeometry:
    """Return a circle, or an arc of one.

    With the default words, at angle b the source is at ``source_to_axis (sin b, -cos b, 0)``, u
    points along (cos b, sin b, 0) and v along +z, as in all trajectories here. For frames that the
    command line reads with its defaults, and for NXtomo files, it is ``rotation="ccw"`` and
    ``row0="top"``.

    Parameters
    ----------
    views : int
        Number of views; view i is at ``start + i arc / views``.
    source_to_axis, source_to_detector : float
        Distances [mm].
    pixel_size : float
        Edge of a pixel of the detector itself, not scaled to the axis [mm].
    shape : (int, int)
        Rows and columns of the detector.
    start, arc : float
        First angle and angle covered [rad].
    rotation : {"cw", "ccw"}
        How the sample turns as the angle grows, seen from above (from +z): clockwise, so that b is
        the angle, or counter-clockwise, b = -angle.
    row0 : {"bottom", "top"}
        Where row 0 of a radiograph lies: v points along +z or along -z.

    Raises
    ------
    InputError
        If there is no view, a number is not finite, a distance not positive, a word none of its
        choices, or an angle so large that it must be in degrees.
    """
    views = whole("views", views)
    angles = finite("start", start) + np.arange(views, dtype=np.float64) * (
        _radians("arc", arc, _TURNS) / views
    )
    stage = _Stage(source_to_axis, source_to_detector, pixel_size, shape, rotation, row0)
    return stage.at(angles, np.zeros(views))


def helix(
    views: int,
    *,
    angle_step: float,
    z_step: float,
    source_to_axis: float,
    source_to_detector: float,
    pixel_size: float,
    shape: tuple[int, int],
    start: float = 0.0,
    rotation: str = "cw",
    row0: str = "bottom",
) -> ConeBeamGeometry:
    """Return a helix about the z axis, centred on z = 0.

    Parameters
    ----------
    views : int
        Number of views; view i is at the height ``(i - (views - 1) / 2) z_step``.
    angle_step : float
        Angle from one view to the next [rad].
    z_step : float
        Rise from one view to the next; negative downward [mm].
    source_to_axis, source_to_detector, pixel_size, shape, start, rotation, row0
        As in `circular`.

    Raises
    ------
    InputError
        As `circular` does.
    """
    views = whole("views", views)
    angles = finite("start", start) + np.arange(views, dtype=np.float64) * _radians(
        "angle_step", angle_step
    )
    stage = _Stage(source_to_axis, source_to_detector, pixel_size, shape, rotation, row0)
    return stage.at(angles, _heights(views, z_step))


def double_helix(
    views_per_helix: int,
    *,
    angle_step: float,
    z_step: float,
    source_to_axis: float,
    source_to_detector: float,
    pixel_size: float,
    shape: tuple[int, int],
    second: str = "half-turn",
    start: float = 0.0,
    rotation: str = "cw",
    row0: str = "bottom",
) -> ConeBeamGeometry:
    """Return a helix followed by a second one along which the stage travels back.

    Parameters
    ----------
    views_per_helix : int
        Number of views N of each helix; there are 2 N views.
    angle_step, z_step
        Of the first helix, as in `helix`.
    source_to_axis, source_to_detector, pixel_size, shape, start, rotation, row0
        As in `circular`.
    second : {"half-turn", "return"}
        "half-turn": the first helix turned by half a turn and followed backwards; view N + k is
        at the height of view N - 1 - k and opposite to it. Both helices have the same hand and
        interleave. "return": the rotation goes on while the travel reverses; view N + k is at the
        height of view N - 1 - k and at the angle ``start + (N + k) angle_step``. The second helix
        has the opposite hand.

    Raises
    ------
    InputError
        As `circular` does, and for another `second`.
    """
    views = whole("views_per_helix", views_per_helix)
    angles = np.arange(views, dtype=np.float64) * _radians("angle_step", angle_step)
    if second == "half-turn":
        later = angles[::-1] + math.pi
    elif second == "return":
        later = angles + views * angle_step
    else:
        raise InputError(f"second: found {second!r}, expected 'half-turn' or 'return'")
    z = _heights(views, z_step)
    stage = _Stage(source_to_axis, source_to_detector, pixel_size, shape, rotation, row0)
    return stage.at(
        finite("start", start) + np.concatenate([angles, later]), np.concatenate([z, z[::-1]])
    )


def space_filling(
    views: int,
    *,
    z_step: float,
    source_to_axis: float,
    source_to_detector: float,
    pixel_size: float,
    shape: tuple[int, int],
    angle_step: float | None = None,
    start: float = 0.0,
    rotation: str = "cw",
    row0: str = "bottom",
) -> ConeBeamGeometry:
    """Return a space-filling trajectory: a helix of so large an angle step that it is a lattice.

    Parameters
    ----------
    views, z_step, source_to_axis, source_to_detector, pixel_size, shape, start, rotation, row0
        As in `helix`.
    angle_step : float, optional
        Angle from one view to the next [rad]; if not given, `lattice_angle`.

    Raises
    ------
    InputError
        As `circular` does, and for a `z_step` of 0 without an `angle_step`.
    """
    if angle_step is None:
        angle_step = lattice_angle(source_to_axis, z_step)
    return helix(
        views,
        angle_step=angle_step,
        z_step=z_step,
        source_to_axis=source_to_axis,
        source_to_detector=source_to_detector,
        pixel_size=pixel_size,
        shape=shape,
        start=start,
        rotation=rotation,
        row0=row0,
    )


def lattice_angle(source_to_axis: float, z_step: float, near: float = _NEAR) -> float:
    """Return the angle step for which the source positions are spread most evenly.

    On the unrolled cylinder the positions are the lattice spanned by (R angle, z_step) and
    (2 pi R, 0). The angle is the local maximiser, nearest to `near`, of the shortest distance
    min_n |(R wrap(n angle), n z_step)|. Every local maximum lies between the square and the
    hexagonal lattice (0.93 to 1 of the latter's distance), so the nearest one is good; a rounded
    angle need not be. For `PAPER` that is 15.264 degrees with 0.930; 15.300 has 0.45.

    Parameters
    ----------
    source_to_axis : float
        Radius R [mm].
    z_step : float
        Rise from one view to the next [mm].
    near : float
        Angle to start from, between 0 and pi [rad].

    Raises
    ------
    InputError
        If there is no rise, or `near` is not between 0 and pi.
    """
    rise = abs(finite("z_step", z_step)) / positive("source_to_axis", source_to_axis)
    if rise == 0:
        raise InputError("z_step: found 0, expected a rise: give angle_step for a circle")
    if not 0 < near < math.pi:
        raise InputError(f"near: found {near}, expected an angle between 0 and pi")
    hexagonal = math.sqrt(4 * math.pi * rise / math.sqrt(3))
    # No neighbour farther along z than the hexagonal distance can be the nearest.
    steps = np.arange(1, math.ceil(hexagonal / rise) + 1)

    def shortest(angles: Floats) -> Floats:
        turns = np.multiply.outer(angles, steps / (2 * math.pi))
        around = 2 * math.pi * (turns - np.rint(turns))
        return np.asarray(np.hypot(around, steps * rise).min(axis=1))

    # Fine enough that the outermost neighbour moves by a small part of the distance sought.
    pace = min(0.02 * hexagonal / len(steps), 0.01)
    reach = 64
    while True:
        angles = near + np.arange(-reach, reach + 1, dtype=np.float64) * pace
        distance = shortest(angles)
        inner = distance[1:-1]
        peaks = 1 + np.flatnonzero((inner >= distance[:-2]) & (inner > distance[2:]))
        # Until the window holds a peak; it cannot outgrow a turn, as pi is always an extremum.
        if len(peaks):
            break
        reach *= 2
    low, _, high = angles[peaks[np.abs(angles[peaks] - near).argmin()] + np.array([-1, 0, 1])]
    for _ in range(60):
        third = (high - low) / 3
        left, right = shortest(np.array([low + third, high - third]))
        low, high = (low + third, high) if left < right else (low, high - third)
    return float(0.5 * (low + high))


def _heights(views: int, z_step: float) -> Floats:
    return (np.arange(views, dtype=np.float64) - (views - 1) / 2) * finite("z_step", z_step)


def _radians(name: str, angle: float, turns: float = 1) -> float:
    """Return an angle [rad], unless it is more than so many turns."""
    found = finite(name, angle)
    if abs(found) > 2 * math.pi * turns * (1 + 1e-9):
        raise InputError(
            f"{name}: found {found:g}, expected at most {2 * math.pi * turns:.4g} radians; "
            f"{found:g} degrees are math.radians({found:g})"
        )
    return found


@dataclass(frozen=True)
class _Stage:
    """An ideal stage, and how its frames are counted."""

    source_to_axis: float
    source_to_detector: float
    pixel_size: float
    shape: tuple[int, int]
    rotation: str
    row0: str

    def at(self, angles: Floats, z: Floats) -> ConeBeamGeometry:
        """Geometry at each angle and height."""
        for name, word, words in (
            ("rotation", self.rotation, ROTATIONS),
            ("row0", self.row0, ROWS),
        ):
            if word not in words:
                raise InputError(f"{name}: found {word!r}, expected one of {words}")
        radius = positive("source_to_axis", self.source_to_axis)
        beyond = positive("source_to_detector", self.source_to_detector) - radius
        pixel = positive("pixel_size", self.pixel_size)
        b = angles if self.rotation == "cw" else -angles
        up = 1.0 if self.row0 == "bottom" else -1.0
        cos, sin, zero = np.cos(b), np.sin(b), np.zeros_like(b)
        return ConeBeamGeometry(
            source=np.stack([radius * sin, -radius * cos, z], axis=1),
            detector=np.stack([-beyond * sin, beyond * cos, z], axis=1),
            u=pixel * np.stack([cos, sin, zero], axis=1),
            v=pixel * np.stack([zero, zero, zero + up], axis=1),
            shape=self.shape,
        )
