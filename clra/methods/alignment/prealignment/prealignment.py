"""Pre-alignment: large motions, and the slow modes that an arc of a parallel beam leaves open.

Re-projection alignment needs a first volume that resembles the sample, and on an arc its slow modes
end where filtered back-projection errs least rather than at the truth. Sums over the radiographs
tell both without a volume. They are not exact in a cone beam, to half a pixel at a half fan of 9
degrees: there they are where the iteration starts, and only if the motion is large.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.prealignment.mass_centres import CentreShifts, centre_shifts
from clra.methods.alignment.prealignment.projection_sums import (
    ProjectionSums,
    projection_sums,
)
from clra.methods.alignment.prealignment.row_profiles import ProfileShifts, profile_shifts
from clra.methods.alignment.rejected_views import Rejections
from clra.methods.alignment.result import PREALIGNED, Iteration
from clra.methods.alignment.steps.slow_modes import slow_part
from clra.model.gauge.gauge import Gauge
from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion
from clra.model.sampling.angular_coverage import covered, fan_angle
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]

# Angle that the detector spans from the source below which a beam counts as parallel [rad].
_PARALLEL = math.radians(0.1)
# Robust standard deviation of the shifts, in heights or widths of the detector, from which on the
# motion is large. Circles align by themselves up to twice that, helices do not.
_LARGE = 0.08
# Part of the rows' sums' squared mismatch that may be left: of a parallel beam, and of a cone.
# Large motions of a cone that were found left up to 0.08, profiles of helices that fitted each
# other where they should not 0.11 and more.
_UNEXPLAINED, _UNEXPLAINED_OF_CONE = 0.25, 0.1
# Root mean square of an error, by halves of the sample, up to which slow modes or each view's shift
# count as known [pixel]; and what is lost of the mass, times the sample's half width [pixel].
_KNOWN, _LOST = 0.03, 0.1
# Robust standard deviations by which a view's mass may differ from the others', and what may differ
# in any case, a part of it.
_OUTLYING, _SLIGHT = 5.0, 1e-3
# Where slow modes are known, a shift that is registered this far aside is wrong [pixel]: single
# ones err by 0.02, and those of views that are cut off by 2. And by how much the slow modes are
# damped: a few views in a row may well be unknown.
_ASIDE, _FAR, _DAMPING = 0.5, 3.0, 0.01
# Most columns of radiographs whose sums are to be exact.
_COLUMNS = 512
# Rows per height of the axis may differ by this part, and columns of its image by this part of the
# rows.
_UPRIGHT = 0.01


@dataclass(frozen=True)
class Prealignment:
    """Shifts that sums over the radiographs tell.

    Attributes
    ----------
    motion : Motion
        In pixels of the full-resolution detector.
    known : ndarray of bool, (3, views)
        Views whose slow modes in u, v and magnification are told better than by re-projections.
    exact : ndarray of bool, (2,)
        Whether all of u and v is, in these views.
    correlation : float
        Part of the mismatch of the rows' sums that is explained.
    residual : float
        Root mean square of what is left of them, for a pixel [attenuation].
    """

    motion: Motion
    known: NDArray[np.bool_]
    exact: NDArray[np.bool_]
    correlation: float
    residual: float

    @property
    def vouched(self) -> NDArray[np.bool_]:
        """Views whose mass and profile are those of the others: they show this sample."""
        return np.asarray(self.known[:2].all(axis=0))

    def entry(self, seconds: float, **errors: Any) -> Iteration:
        """Return it as it appears in a history."""
        shifts = np.stack([self.motion.shift_u, self.motion.shift_v])
        quality = np.array([self.correlation]), np.array([self.residual])
        return Iteration.of(PREALIGNED, 1, shifts, *quality, seconds, **errors)

    def held(self, motion: Motion, valid_views: NDArray[np.bool_], *, scale: bool) -> Motion:
        """Return a motion that goes on from this one.

        Parameters
        ----------
        motion : Motion
            By registration.
        valid_views : ndarray of bool, (views,)
            Others are aside of the pre-alignment by what lies between their neighbours.
        scale : bool
            Whether magnifications are estimated.

        Returns
        -------
        Motion
            With all that is known: its shifts, or their slow modes.
        """
        columns, views = [], np.arange(motion.views)
        for axis, (found, told) in enumerate(
            zip(_lengths(motion), _lengths(self.motion), strict=True)
        ):
            known, beside = self.known[axis], found - told
            if axis < 2 and valid_views.any():
                beside = np.interp(views, views[valid_views], beside[valid_views])
            if known.any():
                beside = beside - slow_part(beside, known.astype(float), _DAMPING)
                if axis < 2:
                    limit = np.where(known, 0.0 if self.exact[axis] else _ASIDE, _FAR)
                    beside[np.abs(beside) > limit] = 0.0
            columns.append(told + beside)
        return Motion(
            shift_u=columns[0],
            shift_v=columns[1],
            magnification=np.exp(columns[2]) if scale else motion.magnification,
            cause=motion.cause,
        ).normalised()


def _lengths(motion: Motion) -> tuple[Floats, Floats, Floats]:
    return motion.shift_u, motion.shift_v, np.log(motion.magnification)


def is_open(schedule: str, start: Motion) -> bool:
    """Whether nothing is known of the motion, and the way to find it is left to us."""
    still = all((column == column[0]).all() for column in start.columns())
    return schedule == "auto" and still and start.cause == "detector"


def prealigned(
    stream: Stream,
    geometry: ConeBeamGeometry,
    binned: Callable[[int], Radiographs],
    coarsest: int,
    rejections: Rejections,
    gauge: Gauge,
) -> Prealignment | None:
    """Find shifts by sums over the radiographs, where they are of use.

    Parameters
    ----------
    stream : Stream
        Memory budget, and whom to tell how far it is.
    geometry : ConeBeamGeometry
        Of the scan at full resolution.
    binned : callable
        Returns its radiographs for a binning factor; all are read.
    coarsest : int
        Binning of the first iteration.
    rejections : Rejections
        What rejects views: they get what lies between their neighbours'.
    gauge : Gauge
        What counts as no motion. It stays in what is found: the sample's centre of mass is on the
        axis, where all views show it.

    Returns
    -------
    Prealignment or None
        None if the sample is cut off by the detector's left or right border in half of the views
        or more, the detector's columns are not along the axis, or the motion is neither large nor
        on an arc of a parallel beam.
    """
    radiographs = binned(_level(geometry, coarsest))
    valid_views = ~rejections.first(stream, radiographs)
    axis = _axis(geometry.binned(radiographs.level))
    if axis is None or valid_views.sum() < 2:
        return None
    sums = projection_sums(stream, radiographs, valid_views)
    if sums is None:
        return None
    sums = sums.of(valid_views)
    column, row, slope = (values[valid_views] for values in axis)
    axis = column, row, slope
    direction = geometry.source[valid_views, :2]
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    source = np.column_stack([direction, row / radiographs.shape[1]])
    found = _matched(sums, axis, source)
    if found is not None:
        # A view that lacks a little of the sample was taken for whole.
        sums = replace(sums, whole=sums.whole & ~_far(found[0].loss, sums.whole))
        found = _matched(sums, axis, source)
    if found is None:
        return None
    along_u, along_v = found
    unexplained = along_v.after**2 / max(along_v.before**2, np.finfo(float).tiny)
    parallel = tells_slow_modes(geometry)
    if unexplained > (_UNEXPLAINED if parallel else _UNEXPLAINED_OF_CONE):
        return None
    views, good = np.arange(geometry.views), np.flatnonzero(valid_views)
    shift_u, shift_v = (
        radiographs.level * np.interp(views, good, shift)
        for shift in (along_u.shift, along_v.shift)
    )
    motion = Motion(shift_u=shift_u, shift_v=shift_v)
    known, exact = np.zeros((3, geometry.views), np.bool_), np.zeros(2, np.bool_)
    if parallel:
        told, exact = _accuracy(along_u, along_v, sums, radiographs.level)
        known[:, good] = told[[0, 1, 1], None] & sums.whole
        stretch = np.interp(views, good, along_v.stretch)
        motion = replace(motion, magnification=1 + stretch)
    rest = gauge.anchored(motion)
    sides = zip((rest.shift_u, rest.shift_v), reversed(geometry.shape), strict=True)
    moved = max(_robust_deviation(shift) / size for shift, size in sides)
    if moved < _LARGE and not known.any():
        return None
    residual = along_v.after / (2 * sums.half_width + 1)
    return Prealignment(motion, known, exact, 1 - unexplained, residual)


def _robust_deviation(values: Floats) -> float:
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def tells_slow_modes(geometry: ConeBeamGeometry) -> bool:
    """Whether sums over the radiographs are exact, and re-projections have slow modes at all."""
    angle = fan_angle(geometry) * max(1.0, geometry.rows / geometry.columns)
    return angle < _PARALLEL and covered(geometry) < 2 * math.pi


def _level(geometry: ConeBeamGeometry, coarsest: int) -> int:
    """Binning of radiographs to sum: the coarsest will do but where sums are exact."""
    level, exact = 1, tells_slow_modes(geometry)
    while level < coarsest and (not exact or geometry.columns > _COLUMNS * level):
        level *= 2
    return level


def _axis(geometry: ConeBeamGeometry) -> tuple[Floats, Floats, Floats] | None:
    """Column of the axis, row of its origin and slope of the column along x and y; if upright."""
    matrices = geometry.projection_matrices()
    origin, depth = matrices[:, :, 3], matrices[:, 2, 3]
    column, row = origin[:, 0] / depth, origin[:, 1] / depth
    slope = matrices[:, 0, :] - column[:, None] * matrices[:, 2, :]
    rising = (matrices[:, 1, 2] - row * matrices[:, 2, 2]) / depth
    slope = slope / depth[:, None]
    rate = float(np.median(np.abs(rising)))
    uneven = np.abs(np.abs(rising) - rate).max() > _UPRIGHT * rate
    if uneven or np.ptp(np.sign(rising)) > 0 or np.abs(slope[:, 2]).max() > _UPRIGHT * rate:
        return None
    return column, row, slope[:, :2]


def _matched(
    sums: ProjectionSums, axis: tuple[Floats, Floats, Floats], source: Floats
) -> tuple[CentreShifts, ProfileShifts] | None:
    """Shifts along u and v, if there is a view to tell them."""
    if not sums.whole.any():
        return None
    column, row, slope = axis
    along_v = profile_shifts(sums.mass, row, sums.whole)
    along_u = centre_shifts(sums, column, slope, row + along_v.shift, source)
    return None if along_u is None else (along_u, along_v)


def _far(loss: Floats, whole: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether more of the mass is lost, or won, than in most views that are whole."""
    beside = np.abs(loss - np.median(loss[whole]))
    return np.asarray(beside > max(_OUTLYING * 1.4826 * float(np.median(beside[whole])), _SLIGHT))


def _accuracy(
    along_u: CentreShifts, along_v: ProfileShifts, sums: ProjectionSums, level: int
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether slow modes, and each view's shift, are known in u and v.

    Halves of the sample tell by how far they disagree.
    """
    weight = sums.whole.astype(float)

    def size(values: Floats) -> float:
        return level * float(np.sqrt(np.average(values**2, weights=weight)))

    differences = [along.difference for along in (along_u, along_v)]
    slow = np.array([0.5 * size(slow_part(values, weight)) for values in differences])
    each = np.array([0.5 * size(values) for values in differences])
    lost = sums.half_width * size(slow_part(along_u.loss, weight))
    complete = np.array([lost < _LOST, True])
    known = complete & (slow < _KNOWN)
    return known, known & (each < _KNOWN)
