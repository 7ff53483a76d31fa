"""Helical trajectories: fitted to a scan, and the curves on their detector that exact methods use.

Angles, lines and windows are those of Noo, Pack and Heuscher [1]_. A position on the detector is
written as tangents, t_u along the rows and t_v along z, of the angle to the normal. The helix rises
by ``slope = rise / source_to_axis`` radii a radian; a negative slope mirrors all along z, so that
the formulas hold for both hands.

.. [1] F. Noo, J. Pack, D. Heuscher, "Exact helical reconstruction using native cone-beam
   geometries", Phys. Med. Biol. 48, 3787 (2003).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.model.geometry import ConeBeamGeometry

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Helix:
    """Views along a helix about z, their detector upright and facing the axis.

    View i is at the angle ``start + i angle_step``, b, and the height ``z + i z_step``; its source
    is at ``source_to_axis (sin b, -cos b)``.

    Parameters
    ----------
    views : int
        How many.
    start, angle_step : float
        Angles [rad].
    z, z_step : float
        Heights [mm].
    source_to_axis, source_to_detector : float
        Distances [mm].
    principal : (float, float)
        Column and row of the foot of the perpendicular from the source [pixel].
    pitch_u, pitch_v : float
        From column to column along (cos b, sin b, 0), from row to row along z; signed [mm].
    shape : (int, int)
        Rows and columns of the detector.
    """

    views: int
    start: float
    angle_step: float
    z: float
    z_step: float
    source_to_axis: float
    source_to_detector: float
    principal: tuple[float, float]
    pitch_u: float
    pitch_v: float
    shape: tuple[int, int]

    @property
    def slope(self) -> float:
        """Rise along z in a radian over the distance from source to axis, signed."""
        return self.z_step / (self.angle_step * self.source_to_axis)

    @property
    def pitch(self) -> float:
        """Travel along z in a turn [mm], positive."""
        return 2 * math.pi * abs(self.z_step / self.angle_step)

    @property
    def field_radius(self) -> float:
        """Radius of the circle about the axis that every view sees [mm]; negative for none."""
        edges = self.tangent_u(np.array([-0.5, self.shape[1] - 0.5]))
        return self.source_to_axis * math.sin(math.atan(min(-edges.min(), edges.max())))

    def between(self) -> Helix:
        """Return the views half-way from each view to the next."""
        return replace(
            self,
            views=self.views - 1,
            start=self.start + 0.5 * self.angle_step,
            z=self.z + 0.5 * self.z_step,
        )

    def cropped(self, first: int, last: int) -> Helix:
        """Return the same views with only the rows `first` to `last - 1` of the detector."""
        column, row = self.principal
        return replace(self, principal=(column, row - first), shape=(last - first, self.shape[1]))

    def geometry(self) -> ConeBeamGeometry:
        """Return source and detector of every view."""
        index = np.arange(self.views)
        angle, z = self.start + index * self.angle_step, self.z + index * self.z_step
        zero = np.zeros_like(angle)
        normal = np.stack([-np.sin(angle), np.cos(angle), zero], axis=1)
        u = self.pitch_u * np.stack([np.cos(angle), np.sin(angle), zero], axis=1)
        v = self.pitch_v * np.stack([zero, zero, zero + 1], axis=1)
        source = np.stack([zero, zero, z], axis=1) - self.source_to_axis * normal
        rows, columns = self.shape
        across = (columns - 1) / 2 - self.principal[0]
        up = (rows - 1) / 2 - self.principal[1]
        detector = source + self.source_to_detector * normal + across * u + up * v
        return ConeBeamGeometry(source=source, detector=detector, u=u, v=v, shape=self.shape)

    def tangent_u(self, column: ArrayLike) -> Floats:
        """Tangent t_u at a column."""
        scale = self.pitch_u / self.source_to_detector
        return (np.asarray(column, np.float64) - self.principal[0]) * scale

    def row(self, tangent_v: ArrayLike) -> Floats:
        """Row at the tangent t_v."""
        scale = self.source_to_detector / self.pitch_v
        return self.principal[1] + np.asarray(tangent_v, np.float64) * scale

    def window(self, tangent_u: ArrayLike) -> tuple[Floats, Floats]:
        """Tangents t_v of the two borders of the Tam-Danielsson window.

        A point's projection is between them while the source runs along its pi-interval: they are
        the projections of the turns of the helix next to the source, the one ahead first.
        """
        t = np.asarray(tangent_u, np.float64)
        scale = self.slope * (1 + t * t)
        return scale * (np.pi / 2 - np.arctan(t)), -scale * (np.pi / 2 + np.arctan(t))

    def kappa_line(self, psi: ArrayLike) -> tuple[Floats, Floats]:
        """Filter line of the angle psi [rad]: t_v = first + second * t_u.

        It is the projection of a plane that meets the helix at the source, psi and 2 psi ahead.
        """
        psi = np.asarray(psi, np.float64)
        safe = np.where(np.abs(psi) < 1e-6, 1e-6, psi)
        return self.slope * psi, self.slope * safe / np.tan(safe)

    def fan(self, radius: float) -> float:
        """Half the angle [rad] under which the source sees a circle about the axis."""
        return math.asin(radius / self.source_to_axis)

    def rows_needed(self, radius: float) -> tuple[float, float]:
        """Lowest and highest row that filter lines of a field of view reach.

        These hold the Tam-Danielsson window too, whose highest points are ends of the longest
        lines.
        """
        angle = self.fan(radius)
        offset, steepness = self.kappa_line(np.linspace(-1, 1, 2001) * (np.pi / 2 + angle))
        ends = [offset - steepness * math.tan(angle), offset + steepness * math.tan(angle)]
        rows = self.row(np.concatenate(ends))
        return float(rows.min()), float(rows.max())

    def window_rows(self, radius: float) -> tuple[int, int]:
        """First row of the detector that the window needs, and the row behind the last.

        With what softens its borders, see `PiBackProjector`.
        """
        half_fan = math.tan(self.fan(radius))
        rows = self.row(np.stack(self.window(np.linspace(-half_fan, half_fan, 2001))))
        nearest = (self.source_to_axis - radius) / self.source_to_detector
        soft = 0.5 + 0.5 * abs(self.z_step / (nearest * self.pitch_v))
        first = max(0, math.floor(rows.min() - soft))
        return first, min(self.shape[0], math.ceil(rows.max() + soft) + 1)

    def pi_heights(self, view: int, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Heights at (x, y) whose projection in a view lies on the borders of the window.

        Parameters
        ----------
        view : int
            Number of the view.
        x, y : array_like
            Positions [mm].

        Returns
        -------
        ahead, behind : ndarray
            Heights on the border ahead of the source and on that behind [mm].
        depth : ndarray
            Of the positions as a fraction of the detector's.
        """
        angle = self.start + view * self.angle_step
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        depth = self.source_to_axis - x * math.sin(angle) + y * math.cos(angle)
        ahead, behind = self.window((x * math.cos(angle) + y * math.sin(angle)) / depth)
        z = self.z + view * self.z_step
        return z + depth * ahead, z + depth * behind, depth / self.source_to_detector
