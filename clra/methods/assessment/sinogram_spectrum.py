"""The Fourier sinogram criterion for the centre of rotation: energy where no sample has any.

The spectrum of a sinogram over a whole turn fills two wedges: what lies within r of the axis has
angular frequencies n up to 2 pi r |nu| at a frequency nu along the detector. Half a turn mirrored
about a wrong column is no sinogram, and leaks out of them [1]_. All views have their say.

References
----------
.. [1] N. T. Vo, M. Drakopoulos, R. C. Atwood, C. Reinhard, "Reliable method for calculating the
   center of rotation in parallel-beam tomography", Opt. Express 22, 19078 (2014).
"""

import math

import numpy as np
from numpy.typing import NDArray

from clra.model.sampling.angular_coverage import beside_views

Floats = NDArray[np.float64]

# Most columns and angles of the resampled sinogram.
_COLUMNS, _ANGLES = 512, 720
# Angular frequencies beyond the wedge that its own sides leak to.
_BESIDE = 3.0


def energy_outside(lines: Floats, angle: Floats, fan: Floats, missing: Floats) -> float:
    """Return which part of the energy of a sinogram lies where no sample has any.

    Parameters
    ----------
    lines : ndarray, (views, columns)
        Line integrals at the height of the source.
    angle : ndarray, (views,)
        Of the sources [rad]; evenly spaced but for what is missing.
    fan : ndarray, (columns,)
        Angle of each column's ray from the way to the axis [rad], rising or falling.
    missing : ndarray, (holes, 2)
        Where there are no views, as of :func:`clra.model.sampling.angular_coverage.holes`.

    Returns
    -------
    float
        0 to 1. Rays are sorted by direction and distance from the axis, up to the nearer side of
        the detector; those that are measured twice are averaged.
    """
    views, columns = lines.shape
    order = np.argsort(angle)
    step = float(np.median(np.diff(angle[order])))
    count, turn = min(columns, _COLUMNS), min(round(2 * math.pi / step), _ANGLES)
    place = (np.arange(count) - (count - 1) / 2) / (count / 2)
    gamma = np.arcsin(place * math.sin(min(abs(fan[0]), abs(fan[-1]))))
    start = float(missing.sum(axis=1).max()) if len(missing) else 0.0
    direction = (start + 2 * math.pi * np.arange(turn) / turn)[:, None]
    rising = fan if fan[-1] > fan[0] else fan[::-1]
    column_of = np.arange(columns) if rising is fan else np.arange(columns)[::-1]

    def taken(source: Floats, ray: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Interpolated rays of sources and angles in the fan, and whether they were measured."""
        inside = beside_views(source, missing, step)
        at = np.interp(source, angle[order], np.arange(views), period=2 * math.pi)
        column = np.broadcast_to(np.interp(ray, rising, column_of), source.shape)
        left = np.clip(np.floor(column).astype(int), 0, columns - 2)
        f, lower = column - left, np.floor(at).astype(int) % views
        found = np.zeros(source.shape)
        for view, weight in ((lower, 1 - at % 1), ((lower + 1) % views, at % 1)):
            line = order[view]
            found += weight * ((1 - f) * lines[line, left] + f * lines[line, left + 1])
        return found, inside

    one, has_one = taken(direction - gamma, gamma)
    other, has_other = taken(direction + math.pi + gamma, -gamma)
    # Rays that were not measured are the mean of the nearest.
    neither = ~(has_one | has_other)
    sinogram = (one * (has_one | neither) + other * (has_other | neither)) / (
        (has_one | neither) + 1.0 * (has_other | neither)
    )
    window = np.sin(math.pi * (np.arange(count) + 0.5) / count) ** 2
    energy = np.abs(np.fft.fft2(sinogram * window)) ** 2
    n = np.abs(np.fft.fftfreq(turn, 1 / turn))[:, None]
    outside = n > math.pi * count * np.abs(np.fft.fftfreq(count)) + _BESIDE
    return float(energy[outside].sum() / max(float(energy.sum()), np.finfo(float).tiny))
