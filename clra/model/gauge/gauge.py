"""The gauge of a scan: apparent motion that a movement of the sample would explain as well.

In a cone beam these modes are soft, not null: data hardly see them. Errors of an estimated motion
are therefore given raw and without them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError
from clra.model.gauge.modes import GAUGE_MODES, gauge_columns, mode_field
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.validation import whole

Floats = NDArray[np.float64]

# Smallest singular value, as a part of the largest, of what several clouds of points share. On the
# paper's two scans, with four clouds and smooth motion of 18 pixels' range, less than 0.1 pixel rms
# of any one cloud's gauge stays, at half and twice this too. Far below, differences between clouds
# are taken for modes and bend the motion by 3 pixels.
_COMMON = 0.05

# Part of a movement's displacement that shifts have to imitate for it to count as gauge. Helices: a
# translation 0.7 to 1, a tilt or stretch of a sample many detectors high 0.5 to 0.9. A circle,
# whose views see all of the sample: a tilt or stretch below 0.1, and there the data see it well.
_IMITATED = 0.25
# The same for a tilt or stretch to be taken out of an alignment: the data see much of one that is
# imitated less, and taken out by force it holds other motions off them. With 0.25 a helix ended at
# 0.035, 0.025 pixel (u, v), half a fan at 0.050, 0.076; with this, which few tilts reach, at 0.010,
# 0.008 and 0.012, 0.011. With stretches left in, the paper's smooth motions end at 0.10 in v.
_ANCHORED = 0.65

# Robust standard deviations beyond which a view's shift does not count when the gauge is taken out:
# a uniform jitter stays within 1.4, a normal one of 3456 views within 4.
_OUTLYING = 5.0


def sample_points(grid: VolumeGrid, count: int = 1500, seed: int = 0) -> Floats:
    """Return points spread evenly in the cylinder that a grid holds.

    Parameters
    ----------
    grid : VolumeGrid
        Its axis is the cylinder's; nz and the smaller of nx and ny are its size.
    count, seed : int
        Number of points, and seed of the random numbers.

    Returns
    -------
    ndarray, (count, 3)
        Positions (x, y, z) [mm].
    """
    random = np.random.default_rng(seed)
    count = whole("count", count)
    nz, ny, nx = grid.shape
    radius = min(nx, ny) / 2 * np.sqrt(random.random(count))
    angle = 2 * np.pi * random.random(count)
    z = nz * (random.random(count) - 0.5)
    cylinder = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return np.asarray(cylinder * grid.voxel_size + grid.centre)


@dataclass(frozen=True, eq=False)
class GaugeFit:
    """A motion split into its gauge and the rest.

    Attributes
    ----------
    coefficients : dict
        Movement of the sample along each mode, from the joint fit: mm, rad, or a part of 1. Modes
        that look alike in a scan, as scale and stretch do on a circle, share it arbitrarily.
    part, remainder : ndarray, (views, 3)
        (du, dv, dm) that the modes explain together, and what is left. Of a motion without
        magnification the third column of `part` is zero.
    rms_by_mode : dict
        Root mean square over the views of the motion's part along each mode taken alone [pixel].
    """

    coefficients: dict[str, float]
    part: Floats
    remainder: Floats
    rms_by_mode: dict[str, float]


class Gauge:
    """The gauge modes of one scan, computed once.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan, at full resolution.
    points : array_like, (n, 3)
        Points of the sample, as of `sample_points` [mm].
    magnification : bool
        Whether magnification is estimated. If so, it is part of the fit, weighted as the
        displacement in pixels at half the detector's half diagonal, and scale is a mode; if not,
        both are left out.
    """

    def __init__(
        self, geometry: ConeBeamGeometry, points: ArrayLike, *, magnification: bool = True
    ) -> None:
        self.views = geometry.views
        self.modes = _modes(magnification)
        self._weight = _weight(geometry, magnification)
        columns = gauge_columns(geometry, points, self.modes).reshape(3, self.views, -1)
        # A movement that shifts of the radiographs hardly imitate is no gauge of this scan, and its
        # column, scaled up, would be noise.
        shown = np.sqrt(np.mean(np.sum(columns[:2] ** 2, axis=0), axis=0))
        part = shown / self._sizes(geometry, np.asarray(points))
        imitated, anchored = part >= _IMITATED, part >= _ANCHORED
        anchored[:3] = imitated[:3]  # translations
        if magnification:
            scale = self.modes.index("scale")
            imitated[scale] = anchored[scale] = True
        self._design = _rows(columns * imitated, self._weight)
        self._anchored = _rows(columns * anchored, self._weight)

    def _sizes(self, geometry: ConeBeamGeometry, points: Floats) -> Floats:
        """RMS displacement of the points on the detector for a unit of each mode [pixel]."""
        pixel = np.linalg.norm(geometry.u, axis=1) * geometry.source_to_axis
        per_mm = float(np.median(geometry.source_to_detector / pixel))
        fields = (mode_field(mode, points) for mode in self.modes)
        return np.array([per_mm * np.sqrt(np.mean(np.sum(f**2, axis=1))) for f in fields])

    def fit(self, motion: Motion) -> GaugeFit:
        """Split a motion, or the difference of two, into its gauge and the rest.

        Parameters
        ----------
        motion : Motion
            Of the same views.

        Returns
        -------
        GaugeFit
            Least squares on the columns of `gauge_columns`.

        Raises
        ------
        InputError
            If the motion is of another number of views.
        """
        if motion.views != self.views:
            raise InputError(f"motion: found {motion.views} views, expected {self.views}")
        design, weight = self._design, self._weight
        table = _table(motion)
        target = _rows(table.T, weight)
        coefficients = _least_squares(design, target, 1e-9)
        part = np.zeros_like(table)
        fitted = (design @ coefficients).reshape(-1, self.views).T
        part[:, weight > 0] = fitted / weight[weight > 0]
        size = np.linalg.norm(design, axis=0)
        alone = np.abs(design.T @ target) / np.where(size > 0, size, 1.0) / np.sqrt(self.views)
        return GaugeFit(
            coefficients=dict(zip(self.modes, coefficients.tolist(), strict=True)),
            part=part,
            remainder=table - part,
            rms_by_mode=dict(zip(self.modes, alone.tolist(), strict=True)),
        )

    def anchored(self, motion: Motion, start: Motion | None = None) -> Motion:
        """Return the motion without its gauge, but for tilts and stretches that the data see.

        Parameters
        ----------
        motion : Motion
            Of the same views. The few that moved much farther than the others, or were registered
            wrongly, do not tell how the sample moved.
        start : Motion, optional
            Whose gauge stays: it is taken out of what came to this alone.
        """
        start = start or Motion.identity(self.views)
        came = Motion(
            shift_u=motion.shift_u - start.shift_u,
            shift_v=motion.shift_v - start.shift_v,
            magnification=motion.magnification / start.magnification,
        )
        rest = self._remainder(came, np.ones(self.views, np.bool_))
        far = _far(rest[:, 0]) | _far(rest[:, 1])
        if far.any():
            rest = self._remainder(came, ~far)
        return Motion(
            shift_u=start.shift_u + rest[:, 0],
            shift_v=start.shift_v + rest[:, 1],
            magnification=start.magnification * (1 + rest[:, 2]),
            cause=motion.cause,
        )

    def _remainder(self, motion: Motion, chosen: NDArray[np.bool_]) -> Floats:
        """Return what anchoring leaves of a motion, (views, 3), with modes fitted to some views."""
        table, used = _table(motion), self._weight > 0
        target = _rows(table.T, self._weight)
        rows = np.tile(chosen, np.count_nonzero(used))
        coefficients = _least_squares(self._anchored[rows], target[rows], 1e-9)
        part = (self._anchored @ coefficients).reshape(-1, self.views).T
        table[:, used] -= part / self._weight[used]
        return table

    def error(self, estimate: Motion, truth: Motion) -> MotionDifference:
        """Compare an estimated motion with the true one, raw and gauge-free.

        Parameters
        ----------
        estimate, truth : Motion
            Of the same views.

        Raises
        ------
        InputError
            If they are not.
        """
        if estimate.views != truth.views:
            raise InputError(f"estimate: found {estimate.views} views, expected {truth.views}")
        difference = Motion(
            shift_u=estimate.shift_u - truth.shift_u,
            shift_v=estimate.shift_v - truth.shift_v,
            magnification=1 + (estimate.magnification - truth.magnification),
        )
        free = np.abs(self.fit(difference).remainder)
        raw = np.abs(_table(difference))
        return MotionDifference(
            *raw.mean(axis=0).tolist(),
            *raw.std(axis=0).tolist(),
            *free.mean(axis=0).tolist(),
        )


def _modes(magnification: bool) -> tuple[str, ...]:
    """Scale belongs to the gauge only where magnification is estimated."""
    return GAUGE_MODES if magnification else tuple(mode for mode in GAUGE_MODES if mode != "scale")


def _weight(geometry: ConeBeamGeometry, magnification: bool) -> Floats:
    """Pixels for a unit of du, dv and dm; zero for what is not fitted."""
    return np.array([1.0, 1.0, 0.25 * np.hypot(*geometry.shape) if magnification else 0.0])


def _rows(table: Floats, weight: Floats) -> Floats:
    """Fitted rows of (du, dv, dm) tables, (3, views, ...), in pixels and stacked."""
    used = weight > 0
    scale = weight[used].reshape(-1, *[1] * (table.ndim - 1))
    return (table[used] * scale).reshape(-1, *table.shape[2:])


def _least_squares(design: Floats, target: Floats, cutoff: float) -> Floats:
    """Coefficients of the columns, whose units differ; none along directions below `cutoff`."""
    size = np.linalg.norm(design, axis=0)
    size[size == 0] = 1.0
    return np.asarray(np.linalg.lstsq(design / size, target, rcond=cutoff)[0] / size)


def _far(values: Floats) -> NDArray[np.bool_]:
    """Whether numbers about zero lie farther out than five robust standard deviations."""
    return np.asarray(np.abs(values) > _OUTLYING * 1.4826 * np.median(np.abs(values)))


def _table(motion: Motion) -> Floats:
    """(du, dv, dm) of each view, (views, 3)."""
    return np.stack([motion.shift_u, motion.shift_v, motion.magnification - 1], axis=1)


@dataclass(frozen=True)
class MotionDifference:
    """How far an estimated motion is from the truth.

    Attributes
    ----------
    mae_u, mae_v, mae_m : float
        Mean absolute error of the shifts [pixel] and of the magnification.
    std_u, std_v, std_m : float
        Standard deviation of the absolute error: the error bars of the paper's figure 3.
    gauge_free_u, gauge_free_v, gauge_free_m : float
        Mean absolute error without what the gauge explains.
    """

    mae_u: float
    mae_v: float
    mae_m: float
    std_u: float
    std_v: float
    std_m: float
    gauge_free_u: float
    gauge_free_v: float
    gauge_free_m: float

    def means(self) -> dict[str, float]:
        """Return the mean absolute errors alone, by name."""
        names = ("mae_u", "mae_v", "mae_m", "gauge_free_u", "gauge_free_v", "gauge_free_m")
        return {name: getattr(self, name) for name in names}


def without_gauge(
    motion: Motion,
    geometry: ConeBeamGeometry,
    clouds: Sequence[ArrayLike],
    magnification: bool = True,
    *,
    span: float | None = None,
) -> Motion:
    """Return a simulated motion without what movements of the sample would explain.

    A truth that keeps its gauge puts a floor under the raw error of any estimate. What a movement
    looks like depends on the sample, so the modes of several clouds of points are taken out
    together. They are taken out of the shifts only, which leaves less than the joint fit would: to
    fit large shifts a little better that one takes magnifications of several per cent.

    Parameters
    ----------
    motion : Motion
        Of the same views as the geometry.
    geometry : ConeBeamGeometry
        Of the scan, at full resolution.
    clouds : sequence of array_like, (n, 3)
        Points of the sample: of its cylinder, of its surfaces [mm].
    magnification : bool
        Whether magnification will be estimated; if so, its geometric mean becomes 1.
    span : float, optional
        Scale the shifts so that the larger of their two ranges is this [pixel]. One factor serves
        both, else the gauge would come back.

    Raises
    ------
    InputError
        If the motion is of another number of views.
    """
    if motion.views != geometry.views:
        raise InputError(f"motion: found {motion.views} views, expected {geometry.views}")
    modes, weight = _modes(False), _weight(geometry, False)
    columns = np.concatenate([gauge_columns(geometry, points, modes) for points in clouds], axis=1)
    design = _rows(columns.reshape(3, motion.views, -1), weight)
    shifts = _rows(_table(motion).T, weight)
    shifts -= design @ _least_squares(design, shifts, _COMMON)
    u, v = shifts.reshape(2, motion.views)
    factor = 1.0 if span is None else span / max(np.ptp(u), np.ptp(v))
    freed = Motion(
        shift_u=factor * u,
        shift_v=factor * v,
        magnification=motion.magnification,
        cause=motion.cause,
    )
    return freed.normalised() if magnification else freed
