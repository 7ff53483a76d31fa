"""The geometry that NXtomo's fields describe, and the fields that describe a geometry.

This is the one place that knows the signs. With the sample at angle 0 the source stands at
(0, -SOD, 0) and the beam runs along +y; a point X of the sample then lies at T + R(angle) X, R the
turn about +z, counter-clockwise seen from above, T the sample's translation. Seen from the sample
the source turns the other way: b = -angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clra.model.geometry import ConeBeamGeometry

Floats = NDArray[np.float64]

CONVENTIONS = (
    "Lengths in mm. rotation_angle turns the sample counter-clockwise seen from above (from +z). "
    "Columns count to the right as seen from the source, rows from the top down. With the sample "
    "at angle 0: x is along increasing columns, y along the beam from source to detector, z up; "
    "x_translation, y_translation and z_translation move the rotation axis and the sample along "
    "them. source/distance is negative: the source stands upstream of the axis. "
    "clra/cone_vectors, where present, holds the exact geometry of each frame in the sample's "
    "frame: source, detector centre, column step, row step, each (x, y, z)."
)

# Part of a pixel up to which NXtomo's fields are said to express a geometry: no reconstruction can
# tell, and the rounding of angles stays far below it.
_SAME = 1e-5


@dataclass(frozen=True, kw_only=True)
class Fields:
    """What NXtomo tells of the geometry.

    Parameters
    ----------
    angle : ndarray, (views,)
        Turn of the sample, counter-clockwise seen from +z [rad].
    translation : ndarray, (views, 3)
        Shift of the sample along the columns, along the beam, and up [mm].
    source_distance, detector_distance : ndarray, (views,)
        From the axis at zero translation, both positive [mm].
    pixel : (float, float)
        Column and row step [mm].
    """

    angle: Floats
    translation: Floats
    source_distance: Floats
    detector_distance: Floats
    pixel: tuple[float, float]

    def geometry(self, shape: tuple[int, int]) -> ConeBeamGeometry:
        """Return the geometry, its frame fixed to the sample; row 0 is the top.

        Parameters
        ----------
        shape : (int, int)
            Rows and columns of the detector.
        """
        nothing = np.zeros_like(self.angle)
        width, height = self.pixel
        source = np.stack([nothing, -self.source_distance, nothing], axis=1)
        detector = np.stack([nothing, self.detector_distance, nothing], axis=1)
        u = np.stack([nothing + width, nothing, nothing], axis=1)
        v = np.stack([nothing, nothing, nothing - height], axis=1)
        return ConeBeamGeometry(
            source=_turned(source - self.translation, -self.angle),
            detector=_turned(detector - self.translation, -self.angle),
            u=_turned(u, -self.angle),
            v=v,
            shape=shape,
        )


def fields_of(geometry: ConeBeamGeometry) -> tuple[Fields, bool]:
    """Return the fields that describe a geometry, or come close, and whether they are exact.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        With its rows from the top down (:func:`top_down`).
    """
    angle = -np.unwrap(np.arctan2(geometry.u[:, 1], geometry.u[:, 0]))
    source = _turned(geometry.source, angle)
    detector = _turned(geometry.detector, angle)
    # A shift along the beam and the source's distance look alike; the typical distance is no shift.
    source_distance = np.full_like(angle, np.median(-source[:, 1]))
    along = -source[:, 1] - source_distance
    detector_distance = np.full_like(angle, np.median(detector[:, 1] + along))
    across = -0.5 * (source + detector)
    translation = np.stack([across[:, 0], along, across[:, 2]], axis=1)
    translation[np.abs(translation) < 1e-12 * source_distance[:, None]] = 0.0
    fields = Fields(
        angle=angle,
        translation=translation,
        source_distance=source_distance,
        detector_distance=detector_distance,
        pixel=(_median_length(geometry.u), _median_length(geometry.v)),
    )
    again = fields.geometry(geometry.shape)
    rounding = 1e-14 * float(np.max(source_distance))
    tolerance = _SAME * min(fields.pixel) + rounding
    exact = all(
        np.allclose(getattr(again, name), getattr(geometry, name), rtol=0, atol=atol)
        for name, atol in (
            ("source", tolerance),
            ("detector", tolerance),
            ("u", tolerance / max(geometry.shape)),
            ("v", tolerance / max(geometry.shape)),
        )
    )
    return fields, exact


def top_down(geometry: ConeBeamGeometry) -> tuple[ConeBeamGeometry, bool]:
    """Return the geometry with its rows from the top down, and whether they had to be reversed."""
    if not np.all(geometry.v[:, 2] > 0):
        return geometry, False
    reversed_rows = ConeBeamGeometry(
        source=geometry.source,
        detector=geometry.detector,
        u=geometry.u,
        v=-geometry.v,
        shape=geometry.shape,
    )
    return reversed_rows, True


def far_source_distance(shape: tuple[int, int], column_step: float) -> float:
    """Return the source distance that stands for a parallel beam [mm].

    A point of the sample lies at most half a detector's width before or behind the axis, so that
    its ray ends at most ``columns * max(rows, columns) * column_step / (4 distance)`` pixels beside
    the parallel one: 1/8000 of the detector's width here, the same in every view. A source ten
    times as far would do more harm: devices count in float32, and place a ray to within 6e-8 of the
    distance of its source.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the detector.
    column_step : float
        Width of a pixel [mm].
    """
    return 2000.0 * max(shape) * column_step


def _turned(vectors: Floats, angle: Floats) -> Floats:
    """Vectors (n, 3) turned about z by an angle each."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1)


def _median_length(vectors: Floats) -> float:
    return float(np.median(np.linalg.norm(vectors, axis=1)))
