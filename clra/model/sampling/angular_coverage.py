"""Scans whose views are not spread evenly over the turn, or cover a part of it only."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from clra.model.geometry import ConeBeamGeometry

Floats = NDArray[np.float64]

# Part of the detector's height, as seen at the axis, by which sources may rise and still be a
# circle.
_FLAT = 0.05
# Views stand evenly if no two differ more than this in the angle that they stand for.
_EVEN = 1.05
# A gap in the angles this many times as wide as nearly all others, and at least so wide [rad], is
# where there are no views: those beside it do not stand for it.
_HOLE, _NEARLY_ALL, _LEAST = 3.0, 0.99, math.radians(10.0)
# Views over which the angle that each stands for is averaged, at most: turns that do not repeat
# exactly would else give one view the weight of its neighbours in another turn.
_AVERAGED = 9
# Half the fan below which a beam is as good as parallel [rad].
_PARALLEL = math.radians(0.5)


def angle_weights(geometry: ConeBeamGeometry) -> Floats:
    """Weights of the views of a circle by the part of the turn that each stands for.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of any trajectory, views in any order.

    Returns
    -------
    ndarray, (views,)
        Mean 1; all 1 where the trajectory is no circle or its views stand evenly, be it on a part
        of the turn only.
    """
    weights = np.ones(geometry.views)
    if geometry.views < 2 or not is_circle(geometry):
        return weights
    order, gaps, step = _gaps(geometry)
    gaps = np.where(_hole(gaps, step), step, gaps)
    stands_for = 0.5 * (gaps + np.roll(gaps, 1))
    reach = min(_AVERAGED, 1 + 2 * (geometry.views // 32)) // 2
    averaged = np.mean([np.roll(stands_for, k) for k in range(-reach, reach + 1)], axis=0)
    if averaged.max() <= _EVEN * averaged.min():
        return weights
    weights[order] = averaged / averaged.mean()
    return weights


def covered(geometry: ConeBeamGeometry) -> float:
    """Return what part of the turn has views, at whatever height [rad]; a whole one is 2 pi.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of any trajectory.
    """
    _, gaps, step = _gaps(geometry)
    return 2 * math.pi - float(np.sum(gaps[_hole(gaps, step)] - step))


def fan_angle(geometry: ConeBeamGeometry) -> float:
    """Return the angle that the columns of a detector span [rad], the median of the views."""
    width = geometry.columns * np.linalg.norm(geometry.u, axis=1) / geometry.source_to_detector
    return 2 * math.atan(0.5 * float(np.median(width)))


def part_of_a_turn(geometry: ConeBeamGeometry) -> str:
    """Return a warning if the views of an arc do not measure all rays.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of any trajectory.

    Returns
    -------
    str
        Empty if all is well: no circle, a whole one, or at least half of one and the fan.
    """
    angle = covered(geometry)
    if geometry.views < 2 or angle == 2 * math.pi or not is_circle(geometry):
        return ""
    half_fan = 0.5 * fan_angle(geometry)
    needed = math.pi + (2 * half_fan if half_fan > _PARALLEL else 0.0)
    if angle > needed - 2 * angle / geometry.views:
        return ""
    return (
        f"views cover {math.degrees(angle):.0f} degrees of the circle, expected at least "
        f"{math.degrees(needed):.0f} to measure all rays: intensities by method 'fbp' may be off, "
        "less by method 'osem-tr' or 'imgr'"
    )


def holes(geometry: ConeBeamGeometry) -> Floats:
    """Return where a turn has no views.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of any trajectory.

    Returns
    -------
    ndarray, (holes, 2)
        Angle at which each begins, half a step past the last view, and its width [rad]; at angle b
        the source is at (sin b, -cos b).
    """
    order, gaps, step = _gaps(geometry)
    here = np.flatnonzero(_hole(gaps, step))
    starts = _angles(geometry)[order[here]] + 0.5 * step
    return np.stack([starts, gaps[here] - step], axis=1)


def beside_views(angle: Floats, missing: Floats, step: float) -> NDArray[np.bool_]:
    """Whether there are views at angles, or one within a step.

    Parameters
    ----------
    angle : ndarray
        Of the source [rad].
    missing : ndarray, (holes, 2)
        As of :func:`holes`.
    step : float
        Between views [rad].

    Returns
    -------
    ndarray of bool, as `angle`
    """
    inside = np.ones(angle.shape, np.bool_)
    for start, width in missing:
        beyond = (angle - start) % (2 * math.pi)
        inside &= (beyond <= step) | (beyond >= width - step)
    return inside


def is_whole_circle(geometry: ConeBeamGeometry) -> bool:
    """Whether the sources stand all around a circle."""
    return geometry.views > 1 and is_circle(geometry) and covered(geometry) == 2 * math.pi


def is_circle(geometry: ConeBeamGeometry) -> bool:
    """Whether the sources stand on a circle or an arc, rather than on a helix."""
    height = geometry.rows * np.linalg.norm(geometry.v, axis=1)
    at_axis = np.abs(geometry.source_to_axis / geometry.source_to_detector) * height
    return bool(np.ptp(geometry.source[:, 2]) <= _FLAT * np.median(at_axis))


def _gaps(geometry: ConeBeamGeometry) -> tuple[NDArray[np.intp], Floats, float]:
    """Sort views by angle; also the gap from each to the next, and how wide gaps are."""
    angle = _angles(geometry)
    order = np.argsort(angle, kind="stable")
    gaps = np.diff(angle[order], append=angle[order[0]] + 2 * np.pi)
    return order, gaps, float(np.quantile(gaps, _NEARLY_ALL, method="lower"))


def _angles(geometry: ConeBeamGeometry) -> Floats:
    return np.arctan2(geometry.source[:, 0], -geometry.source[:, 1]) % (2 * np.pi)


def _hole(gaps: Floats, step: float) -> NDArray[np.bool_]:
    return np.asarray(gaps > max(_HOLE * step, _LEAST))
