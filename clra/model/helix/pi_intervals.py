"""What a helix can reconstruct exactly: field of view, and heights whose pi-interval it holds.

The pi-interval of a point is the part of the helix between the ends of the one chord of less than a
turn through the point. Exact reconstruction needs its views, and all of the filter lines in them.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.model.grid import VolumeGrid
from clra.model.helix.helix import Helix

Floats = NDArray[np.float64]

# Outermost rows between which the derivative, half-way from row to row, is known.
_EDGE = 0.5

# Rows of the Tam-Danielsson window, between its borders in the middle column, below which these are
# softened into each other: at 2 rows means are wrong by a per cent.
_LEAST_ROWS = 3.0


def field_of_view(helices: Sequence[Helix], grid: VolumeGrid) -> float:
    """Radius of the circle about the axis that helices reconstruct exactly.

    Parameters
    ----------
    helices : sequence of Helix
        Of the scan.
    grid : VolumeGrid
        Of the volume wanted. Where the detector is too short for the whole field of view, the
        sample has to lie inside the circle that fits into this grid.

    Returns
    -------
    float
        [mm]

    Raises
    ------
    InputError
        If a detector does not see the axis, is shorter than the Tam-Danielsson window, or has too
        few rows in it; says what rows, pitch or field of view would do.
    """
    return min(_field_of_view(helix, grid) for helix in helices)


def _field_of_view(helix: Helix, grid: VolumeGrid) -> float:
    seen = helix.field_radius
    if not seen > 0:
        raise InputError(
            "detector: it does not see the rotation axis, expected a field of view about the axis"
        )
    borders = helix.row(np.stack(helix.window(0.0)))
    window = float(np.ptp(borders))
    if window < _LEAST_ROWS:
        raise InputError(
            f"trajectory: a pitch of {helix.pitch:.4g} mm makes a Tam-Danielsson window of "
            f"{window:.2g} rows, expected a pitch of at least "
            f"{helix.pitch * _LEAST_ROWS / window:.4g} mm; or use method 'fbp'"
        )
    x, y, _ = grid.coordinates()
    wanted = max(abs(axis[end]) for axis in (x, y) for end in (0, -1)) + 0.5 * grid.voxel_size
    for radius in (seen, min(seen, wanted)):
        if _fits(helix, radius):
            return radius
    low, high = helix.rows_needed(radius)
    advice = [f"rows {math.floor(low - _EDGE)} to {math.ceil(high + _EDGE)}"]
    first, last = _EDGE, helix.shape[0] - 1 - _EDGE
    middle = helix.principal[1]
    room = min((last - middle) / (high - middle), (middle - first) / (middle - low))
    if room > 0:
        advice.append(f"a pitch of at most {helix.pitch * room:.4g} mm (found {helix.pitch:.4g})")
    possible = [r for r in np.linspace(0.01, 1, 100) * radius if _fits(helix, float(r))]
    if possible:
        advice.append(
            f"a field of view of at most {2 * possible[-1]:.4g} mm (found {2 * radius:.4g})"
        )
    raise InputError(
        f"detector: rows 0 to {helix.shape[0] - 1} are less than the Tam-Danielsson window, "
        f"expected {' or '.join(advice)}; or use method 'fbp'"
    )


def _fits(helix: Helix, radius: float) -> bool:
    low, high = helix.rows_needed(radius)
    return low >= _EDGE and high <= helix.shape[0] - 1 - _EDGE


def pi_reach(helix: Helix, view: int, radius: float) -> tuple[float, float]:
    """Lowest and highest point about the axis in a view's Tam-Danielsson window [mm].

    Parameters
    ----------
    helix : Helix
        Of the view.
    view : int
        Its number.
    radius : float
        Of the circle about the axis [mm].
    """
    # Along a ray of the fan the window grows with the distance: the ends are on the circle.
    angle = np.linspace(0, 2 * np.pi, 181)
    low, high = _window(helix, view, radius * np.cos(angle), radius * np.sin(angle))
    slack = 0.01 * float(high.max() - low.min())
    return float(low.min()) - slack, float(high.max()) + slack


def pi_spans(helix: Helix, grid: VolumeGrid, radius: float) -> NDArray[np.float32]:
    """Heights whose pi-interval a helix holds.

    Parameters
    ----------
    helix : Helix
        As filtered, of views half-way between those measured.
    grid : VolumeGrid
        Of the volume.
    radius : float
        Of the field of view [mm].

    Returns
    -------
    ndarray of float32, (ny, nx, 2)
        First and last height as a number of voxels from the grid's first plane, at each (x, y);
        the last is below the first where there are none.
    """
    x, y, z = grid.coordinates()
    spans = np.empty((len(y), len(x), 2), np.float32)
    for j, at in enumerate(y):
        # Between the windows of the first and of the last view: they have yet to come to a point,
        # or have left it.
        start = _window(helix, 0, x, np.full_like(x, at))
        stop = _window(helix, helix.views - 1, x, np.full_like(x, at))
        low, high = (start[1], stop[0]) if helix.z_step > 0 else (stop[1], start[0])
        outside = np.hypot(x, at) > radius
        spans[j, :, 0] = np.where(outside, np.inf, (low - z[0]) / grid.voxel_size)
        spans[j, :, 1] = np.where(outside, -np.inf, (high - z[0]) / grid.voxel_size)
    return spans


def heights_between(helices: Sequence[Helix], grid: VolumeGrid) -> tuple[float, float] | None:
    """Heights of a grid that lie between helices, where none of them holds a pi-interval.

    Parameters
    ----------
    helices : sequence of Helix
        Of the scan.
    grid : VolumeGrid
        Of the volume.

    Returns
    -------
    (float, float) or None
        Lowest and highest such height on the axis [mm].
    """
    size, z = grid.voxel_size, grid.coordinates()[2]
    axis = VolumeGrid(shape=(1, 1, 1), voxel_size=size, centre=(0.0, 0.0, float(z[0])))
    spans = [pi_spans(helix.between(), axis, size)[0, 0].astype(float) for helix in helices]
    held = np.array([span for span in spans if span[0] <= span[1]]).reshape(-1, 2)
    if not len(held):
        return None
    planes = np.arange(len(z))[:, None]
    inside = ((planes >= held[:, 0]) & (planes <= held[:, 1])).any(axis=1)
    missing = z[~inside & (planes[:, 0] > held.min()) & (planes[:, 0] < held.max())]
    return (float(missing[0]), float(missing[-1])) if len(missing) else None


def _window(helix: Helix, view: int, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Lowest and highest z at (x, y) in the window of a view, with its soft borders [mm]."""
    ahead, behind, depth = helix.pi_heights(view, x, y)
    half_width = 0.5 * (abs(helix.pitch_v) * depth + abs(helix.z_step))
    return np.minimum(ahead, behind) - half_width, np.maximum(ahead, behind) + half_width
