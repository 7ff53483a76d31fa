"""Which helices a scan followed."""

import math

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.helix.helix import Helix

Floats = NDArray[np.float64]

# Pixels by which the projection of a point may lie off its place on a fitted helix. A tenth is
# below what alignment resolves; ten times as much shows as a double edge.
TOLERANCE = 0.1

# Largest angle from view to view [rad]. The derivative along the helix is a difference of
# neighbours: at 6 degrees it blurs by a tenth of the distance from the axis, and more is of no use.
LARGEST_STEP = math.radians(6.0)


def fit_helices(geometry: ConeBeamGeometry) -> list[tuple[slice, Helix]]:
    """Fit helices to a scan: one, or several that follow each other as in a double helix.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of all views.

    Returns
    -------
    list of (slice, Helix)
        The views of each helix, and the helix.

    Raises
    ------
    InputError
        If the views are not those of helices about z with an upright detector that faces the axis,
        to a tenth of a pixel.
    """
    x, y, z = geometry.source.T
    angle = np.arctan2(x, -y)
    turned = (np.diff(angle) + np.pi) % (2 * np.pi) - np.pi
    raised = np.diff(z)
    usual = [float(np.median(np.abs(steps))) if len(steps) else 0.0 for steps in (turned, raised)]
    voxel = np.linalg.norm(geometry.v, axis=1) * geometry.source_to_axis
    voxel /= geometry.source_to_detector
    if not usual[0] > 0 or geometry.views * usual[1] < float(np.median(voxel)):
        raise InputError(
            "trajectory: found no rise along the rotation axis, expected a helix; use method 'fbp'"
        )
    if usual[0] > LARGEST_STEP * (1 + 1e-9):  # 60 views a turn, rounded, will do
        raise InputError(
            f"trajectory: found {math.degrees(usual[0]):.4g} degrees from view to view, expected "
            f"a helix of at most {math.degrees(LARGEST_STEP):g}; use method 'fbp'"
        )
    # A helix goes on while both steps keep their sign and about their size.
    steps = np.stack([turned / usual[0], raised / usual[1]], axis=1)
    regular = (np.abs(np.abs(steps) - 1) < 0.5).all(axis=1)
    same = regular[1:] & regular[:-1] & (np.sign(steps[1:]) == np.sign(steps[:-1])).all(axis=1)
    helices, first = [], 0
    while first < geometry.views:
        stop = first + 1
        if stop < geometry.views and regular[first]:
            breaks = np.flatnonzero(~same[first:])
            stop = first + 2 + (int(breaks[0]) if len(breaks) else geometry.views - first - 2)
        views = slice(first, stop)
        helices.append((views, _fit(geometry.subset(views), first)))
        first = stop
    return helices


def _fit(geometry: ConeBeamGeometry, first: int) -> Helix:
    """Fit one helix to views, of which the first has the number `first` in its scan."""
    if geometry.views < 3:
        raise InputError(
            f"trajectory: view {first} continues no helix, expected equal steps in angle and "
            "height; use method 'fbp'"
        )
    x, y, z = geometry.source.T
    index = np.arange(geometry.views)
    angle_step, start = np.polyfit(index, np.unwrap(np.arctan2(x, -y)), 1)
    z_step, low = np.polyfit(index, z, 1)
    angle = start + index * angle_step
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    helix = Helix(
        views=geometry.views,
        start=float(start),
        angle_step=float(angle_step),
        z=float(low),
        z_step=float(z_step),
        source_to_axis=float(np.hypot(x, y).mean()),
        source_to_detector=float(geometry.source_to_detector.mean()),
        principal=(float(geometry.principal[:, 0].mean()), float(geometry.principal[:, 1].mean())),
        pitch_u=float(np.sum(geometry.u[:, :2] * along, axis=1).mean()),
        pitch_v=float(geometry.v[:, 2].mean()),
        shape=geometry.shape,
    )
    if helix.pitch_u == 0 or helix.pitch_v == 0:
        raise InputError(
            "trajectory: found a detector turned on its side, expected columns parallel to z"
        )
    apart = _distance(geometry, helix)
    worst = int(apart.argmax())
    if not apart[worst] <= TOLERANCE:
        raise InputError(
            f"trajectory: view {first + worst} is {apart[worst]:.3g} pixels off the best helix, "
            f"expected at most {TOLERANCE}: a detector that faces the axis and equal steps in "
            "angle and height; use method 'fbp'"
        )
    return helix


def _distance(geometry: ConeBeamGeometry, helix: Helix) -> Floats:
    """Pixels by which each view puts points of the field of view off a helix's views."""
    radius = max(helix.field_radius, 0.1 * helix.source_to_axis)
    rise = 0.5 * helix.shape[0] * abs(helix.pitch_v)
    rise *= helix.source_to_axis / helix.source_to_detector
    places = np.array(
        [(x, y, z) for x in (-radius, radius) for y in (-radius, radius) for z in (-rise, rise)]
    )
    places[:, :2] *= math.sqrt(0.5)
    points = (
        places + np.stack([0 * geometry.source[:, 2]] * 2 + [geometry.source[:, 2]], 1)[:, None]
    )
    pixels = []
    for one in (geometry, helix.geometry()):
        matrices = one.projection_matrices()
        image = points @ matrices[:, :, :3].transpose(0, 2, 1) + matrices[:, None, :, 3]
        pixels.append(image[..., :2] / image[..., 2:])
    return np.asarray(np.abs(pixels[0] - pixels[1]).max(axis=(1, 2)))
