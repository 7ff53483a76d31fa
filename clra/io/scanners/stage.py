"""The geometry of a turning stage between a source and a detector, from what vendors tell.

Vendors give numbers of the radiograph as it is stored: whether its row 0 is the top, whether its
columns count to the right or to the left as seen from the source, where the perpendicular from the
source and where the axis fall. This is the one place that turns them into vectors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.io.nxtomo.geometry_fields import far_source_distance
from clra.model.geometry import ConeBeamGeometry

Floats = NDArray[np.float64]


def stage_geometry(
    degrees: ArrayLike,
    *,
    source_to_axis: float,
    source_to_detector: float,
    pixel: tuple[float, float],
    shape: tuple[int, int],
    rotation: str = "ccw",
    columns: str = "right",
    rows: str = "top",
    principal: tuple[float, float] = (0.0, 0.0),
    axis: float | None = None,
    heights: ArrayLike | None = None,
    tilt: float = 0.0,
    roll: float = 0.0,
    parallel: bool = False,
) -> ConeBeamGeometry:
    """Return the geometry of the radiographs as they are stored.

    Parameters
    ----------
    degrees : array_like, (views,)
        Turn of the sample [degree].
    source_to_axis, source_to_detector : float
        Distances [mm]; not used for a parallel beam.
    pixel : (float, float)
        Width and height of a pixel of the detector [mm].
    shape : (int, int)
        Rows and columns.
    rotation : {"ccw", "cw"}
        How the sample turns as the angle grows, seen from above.
    columns : {"right", "left"}
        Where columns count to, seen from the source.
    rows : {"top", "bottom"}
        Where row 0 is.
    principal : (float, float)
        Column and row at which the perpendicular from the source meets the detector, from its
        middle [pixel].
    axis : float, optional
        Column at which the axis is seen, from the detector's middle [pixel]; in the principal
        column if not given.
    heights : array_like, (views,), optional
        How far the sample is raised [mm].
    tilt, roll : float
        Turns of the axis about the horizontal across the beam (right-handed about the direction to
        the right seen from the source), and after that about the beam [degree].
    parallel : bool
        The beam is parallel: a far source, and the detector at the axis.
    """
    turn = np.deg2rad(np.asarray(degrees, np.float64)) * (1 if rotation == "ccw" else -1)
    if parallel:
        source_to_axis = source_to_detector = far_source_distance(shape, pixel[0])
    u = np.array([pixel[0] if columns == "right" else -pixel[0], 0.0, 0.0])
    v = np.array([0.0, 0.0, -pixel[1] if rows == "top" else pixel[1]])
    off_axis = 0.0 if axis is None else axis - principal[0]
    source = np.array([0.0, -source_to_axis, 0.0]) - off_axis * u * (
        source_to_axis / source_to_detector
    )
    foot = source + np.array([0.0, source_to_detector, 0.0])
    detector = foot - principal[0] * u - principal[1] * v
    raised = np.zeros((len(turn), 3))
    if heights is not None:
        raised[:, 2] = np.asarray(heights, np.float64)
    axes = _leaning(np.deg2rad(tilt), np.deg2rad(roll))

    def seen_by_sample(vector: Floats, moved: Floats | float) -> Floats:
        x, y, z = ((vector - moved) @ axes + np.zeros((len(turn), 3))).T
        c, s = np.cos(turn), np.sin(turn)
        return np.stack([c * x + s * y, c * y - s * x, z], axis=1)

    return ConeBeamGeometry(
        source=seen_by_sample(source, raised),
        detector=seen_by_sample(detector, raised),
        u=seen_by_sample(u, 0.0),
        v=seen_by_sample(v, 0.0),
        shape=shape,
    )


def _leaning(tilt: float, roll: float) -> Floats:
    """Matrix whose columns are the stage's axes: turned about y (the beam), then about x."""
    about_x = np.array(
        [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
    )
    about_y = np.array(
        [[np.cos(roll), 0, np.sin(roll)], [0, 1, 0], [-np.sin(roll), 0, np.cos(roll)]]
    )
    return np.asarray(about_x @ about_y)
