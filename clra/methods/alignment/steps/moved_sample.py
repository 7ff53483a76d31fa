"""Where the sample stands, as far as magnifications tell: a large drift is not all its movement."""

import numpy as np
from numpy.typing import NDArray

from clra.model.gauge.gauge import sample_points
from clra.model.gauge.modes import apparent_shift, gauge_columns
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion

Floats = NDArray[np.float64]

# Points of the sample: two numbers of a view need few.
_POINTS = 300
_ACROSS = ("translation x", "translation y")


class MovedSample:
    """The place of the sample across the axis, by the magnifications of its views.

    A drift of many pixels is in part what a sample shows that stands beside the axis. Anchored
    without this part, the sample is put there: views that it is nearer magnify it more, by
    hundredths, where at most thousandths are expected, and points at different depths shift by
    parallax, as no shift and magnification of a radiograph do.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan.
    grid : VolumeGrid
        Holds the sample, which is taken to be less than its half width aside.
    """

    def __init__(self, geometry: ConeBeamGeometry, grid: VolumeGrid) -> None:
        self._geometry, self._points = geometry, sample_points(grid, _POINTS)
        columns = gauge_columns(geometry, self._points, _ACROSS)
        self._farthest = 0.5 * grid.voxel_size * min(grid.shape[1:])
        self._per_voxel = grid.voxel_size / self._farthest
        self._design = columns.reshape(3, geometry.views, -1)[2] * self._farthest

    def doubt(self, drift: Floats) -> float:
        """Return by how much magnifications differ if the sample is as far aside as it drifts.

        Parameters
        ----------
        drift : ndarray, (views,)
            Slow shift along u [pixel].
        """
        most = float(np.sqrt(np.mean(np.sum(self._design**2, axis=1))))
        return most * self._per_voxel * float(np.sqrt(np.mean(drift**2)))

    def aside(self, logarithm: Floats, sigma: Floats, spread: float) -> Motion | None:
        """Return the motion that puts the sample on the axis, to go before the one found.

        Parameters
        ----------
        logarithm : ndarray, (views,)
            Of the magnifications found, by each view alone.
        sigma : ndarray, (views,)
            Their standard errors, positive; infinite for views that do not count.
        spread : float
            That is expected of them: a place that explains no more is left.

        Returns
        -------
        Motion or None
            None if the sample is on the axis as far as magnifications tell.
        """
        # A sample that shrinks, or a source that warms up, is no place.
        trend = np.linspace(-1, 1, len(logarithm))
        design = np.column_stack([self._design, trend, np.ones_like(trend)])
        weight = design / sigma[:, None] ** 2
        normal = design.T @ weight + np.eye(design.shape[1])
        place = np.linalg.solve(normal, weight.T @ logarithm)[:2]
        size = float(np.mean((self._design @ place) ** 2))
        if not size > spread**2 or np.hypot(*place) > 1:
            return None
        x, y = place * self._farthest * (1 - spread**2 / size)
        return apparent_shift(self._geometry, self._points, (x, y, 0.0))
