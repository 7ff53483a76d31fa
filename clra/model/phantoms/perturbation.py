"""Motions for simulations: random jitter and smooth drift."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.model.motion import Motion
from clra.model.validation import whole

Floats = NDArray[np.float64]

# Cycles over the scan of the sinusoids of a smooth motion. They are no whole numbers, so that the
# motion ends elsewhere than it began, as a drift does.
_CYCLES = np.array([0.9, 1.7, 2.6, 4.1, 6.0])


def random_motion(
    views: int,
    *,
    seed: int,
    shift: tuple[float, float] = (-10.0, 8.0),
    magnification: float = 0.0,
) -> Motion:
    """Return independent, uniformly distributed motions: a stage that does not repeat.

    Parameters
    ----------
    views : int
        Number of views.
    seed : int
        Of the random numbers.
    shift : (float, float)
        Lowest and highest shift, in u and in v [pixel]; the paper's range if not given.
    magnification : float
        Largest departure of the magnification from 1.
    """
    views = whole("views", views)
    random = np.random.default_rng(seed)
    u, v, m = random.random((3, views))
    return _motion(u, v, m, shift, magnification)


def smooth_motion(
    views: int,
    *,
    seed: int,
    shift: tuple[float, float] = (-10.0, 8.0),
    magnification: float = 0.0,
) -> Motion:
    """Return slow drifts: sums of a few sinusoids over the scan, scaled to fill the range.

    Their periods go from the whole scan down to a sixth of it.

    Parameters
    ----------
    views, seed, shift, magnification
        As in `random_motion`.
    """
    views = whole("views", views)
    random = np.random.default_rng(seed)
    time = (np.arange(views) + 0.5) / views
    waves = np.empty((3, views))
    for wave in waves:
        phase = 2 * np.pi * random.random(len(_CYCLES))
        height = random.uniform(0.5, 1.0, len(_CYCLES)) / np.sqrt(_CYCLES)
        wave[:] = height @ np.sin(2 * np.pi * np.multiply.outer(_CYCLES, time) + phase[:, None])
        span = np.ptp(wave)
        wave[:] = (wave - wave.min()) / span if span > 0 else 0.5
    u, v, m = waves
    return _motion(u, v, m, shift, magnification)


def _motion(
    u: Floats, v: Floats, m: Floats, shift: tuple[float, float], magnification: float
) -> Motion:
    """Map numbers within 0 and 1 to the ranges."""
    low, high = shift
    if not low <= high:
        raise InputError(f"shift: found {shift}, expected (lowest, highest) in pixels")
    if not 0 <= magnification < 1:
        raise InputError(f"magnification: found {magnification}, expected within 0 and 1")
    return Motion(
        shift_u=low + (high - low) * u,
        shift_v=low + (high - low) * v,
        magnification=1 + magnification * (2 * m - 1),
    )
