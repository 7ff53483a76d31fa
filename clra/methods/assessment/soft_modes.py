"""Modes of a motion that the data hardly determine, by a motion that is put in on purpose.

A motion of a known size along each mode is added to the one that was found, and views are held out
once more. What registration with their predictions finds of it tells how far the data determine the
mode: all of it for a shift that changes from view to view, hardly any for a movement of the sample.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.methods.assessment.standard_errors import below_four_cycles
from clra.model.gauge.modes import GAUGE_MODES, gauge_columns
from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion

Floats = NDArray[np.float64]

# Size of what is put in along each mode [pixel of the level]: together they blur by less than one.
_SIZE = 0.15
# Half cycles of the slow modes, as cosines along the scan; others for each, so that what one
# displaces of another does not count.
_COSINES = {"slow shift u": (4, 7), "slow shift v": (3, 6), "slow magnification": (2, 5)}
# Part of a mode that has to be seen for its uncertainty to be known. Movements of the sample are
# seen by 0 to 0.1 on a circle and 0 to 0.3 on helices, an offset of the axis by 0.99 on a full and
# 0.15 on half a turn.
_LEAST = 0.2
# Part that has to be seen for the data to determine it.
_HARDLY = 0.5


@dataclass(frozen=True)
class SoftMode:
    """A mode of a motion, and how well the data determine it; sizes are RMS over the views [pixel].

    Magnifications count as the displacement at half of the detector's half diagonal.

    Attributes
    ----------
    name : str
        A movement of the sample as a whole ("translation x" to "stretch z"), "axis offset" (a shift
        along u that all views share), or a motion below four cycles a scan ("slow shift u", "slow
        shift v", "slow magnification").
    amplitude : float
        Of what the alignment found. What it found of a movement of the sample is taken out of the
        motion, unless its gauge is free.
    seen : float
        Part of an error along it that held-out views show: 1 is well determined, 0 not at all.
    sigma : float
        Uncertainty: what held-out views show, relative to `seen`; infinite where that is below 0.2.
    """

    name: str
    amplitude: float
    seen: float
    sigma: float

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON; an uncertainty that is not known is None there."""
        sigma = self.sigma if math.isfinite(self.sigma) else None
        return {**asdict(self), "sigma": sigma}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> SoftMode:
        """Return what :meth:`as_dict` wrote."""
        sigma = values["sigma"]
        return cls(**{**values, "sigma": math.inf if sigma is None else sigma})

    @property
    def hardly_determined(self) -> bool:
        """Whether less than half of an error along it shows."""
        return self.seen < _HARDLY


class Modes:
    """Shapes of the modes over some views.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of these views, at full resolution.
    points : ndarray, (n, 3)
        Of the sample [mm].
    magnification : bool
        Whether it is estimated.
    """

    def __init__(self, geometry: ConeBeamGeometry, points: Floats, *, magnification: bool) -> None:
        views = self._views = geometry.views
        self._weight = np.array([1.0, 1.0, 0.25 * np.hypot(*geometry.shape)])
        self._magnification = magnification
        shapes = {}
        gauge = gauge_columns(geometry, points).reshape(3, views, -1)
        for index, name in enumerate(GAUGE_MODES):
            shapes[name] = gauge[:, :, index].T.copy()
        shapes["axis offset"] = np.tile([1.0, 0.0, 0.0], (views, 1))
        place = np.pi * (np.arange(views) + 0.5) / views
        for axis, (name, cosines) in enumerate(_COSINES.items()):
            shapes[name] = np.zeros((views, 3))
            shapes[name][:, axis] = sum(np.cos(k * place) for k in cosines)
        if not magnification:
            for name in ("scale", "slow magnification"):
                del shapes[name]
            for shape in shapes.values():
                shape[:, 2] = 0.0
        self._shapes = {}
        for name, shape in shapes.items():
            size = np.sqrt(np.mean(np.sum((shape * self._weight) ** 2, axis=1)))
            if size > 0:
                self._shapes[name] = shape / size

    def added(self, pixel: float) -> Floats:
        """Return what is put in: shift_u, shift_v [pixel] and log(magnification), (views, 3).

        Parameters
        ----------
        pixel : float
            Of the level, in pixels of the full-resolution detector.
        """
        return np.asarray(_SIZE * pixel * np.sum(list(self._shapes.values()), axis=0))

    def found(
        self,
        motion: Motion,
        gauge: Mapping[str, float],
        left: Floats,
        put_in: Floats,
        answer: Floats,
        answered: NDArray[np.bool_],
    ) -> tuple[SoftMode, ...]:
        """Return the modes.

        Parameters
        ----------
        motion : Motion
            Of these views, as found.
        gauge : mapping of str to float
            RMS of what was found of each movement of the sample [pixel].
        left : ndarray, (views, 3)
            What held-out views find to be left of it.
        put_in, answer : ndarray, (views, 3)
            What was added, and by how much more is found to be left then.
        answered : ndarray of bool, (views,)
            Views of `answer` that were held out.
        """
        values = np.stack([motion.shift_u, motion.shift_v, np.log(motion.magnification)], axis=1)
        modes = []
        for name, shape in self._shapes.items():
            given = self._along(put_in[answered], shape[answered])
            seen = -self._along(answer[answered], shape[answered]) / given if given else 0.0
            seen = float(np.clip(seen, 0.0, 1.0))
            if name in _COSINES:
                axis = list(_COSINES).index(name)
                amplitude, shown = (
                    self._weight[axis]
                    * float(np.sqrt(np.mean(below_four_cycles(table[:, axis]) ** 2)))
                    for table in (values, left)
                )
            else:
                shown = abs(self._along(left, shape))
                amplitude = gauge.get(name, abs(self._along(values, shape)))
            sigma = float(shown) / seen if seen >= _LEAST else math.inf
            modes.append(
                SoftMode(name, round(float(amplitude), 5), round(seen, 3), round(sigma, 5))
            )
        return tuple(modes)

    def _along(self, table: Floats, shape: Floats) -> float:
        """Size of a table's part along a shape [pixel]."""
        weighted = shape * self._weight
        square = np.sum(weighted**2)
        return float(np.sum(weighted * (table * self._weight)) / square) if square else 0.0
