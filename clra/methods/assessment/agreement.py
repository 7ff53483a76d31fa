"""How far to trust an alignment whose truth nobody knows: residuals, half scans, sharpness."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.reprojection import Registered, registration_for, reproject_and_register
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import default_grid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import Volume

# Part of the field of view's radius, and planes of the volume, in which sharpness is measured.
_INSIDE, _PLANES = 0.9, 9


@dataclass(frozen=True)
class Agreement:
    """Numbers of an alignment that need no truth; before is without motion, after with it.

    Attributes
    ----------
    level : int
        Binning factor at which all were measured.
    unexplained_before, unexplained_after : float
        Median over the views of what is left of a radiograph when its re-projection is taken off,
        moved no further: root mean square in the band of registration, as a part of the
        radiograph's own.
    half_u, half_v : float
        Median over the views of how far the shifts that two volumes ask for differ, one of them
        from every second of the valid views, one from those between [pixel of the
        full-resolution detector].
    sharpness : float
        Mean squared gradient of the volume after, relative to before.
    """

    level: int
    unexplained_before: float
    unexplained_after: float
    half_u: float
    half_v: float
    sharpness: float


def agreement(
    stream: Stream,
    scan: Scan,
    motion: Motion,
    level: int,
    valid_views: NDArray[np.bool_] | None = None,
) -> Agreement:
    """Measure how good an alignment is by the radiographs alone.

    Takes two reconstructions of the whole scan at that level, two of half of it, and a
    re-projection of every view from each.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        As measured; at least four views.
    motion : Motion
        Of its views.
    level : int
        Binning factor.
    valid_views : ndarray of bool, (views,), optional
        Views to reconstruct from with the motion, at least two; all by default.
    """
    used = np.ones(scan.views, np.bool_) if valid_views is None else valid_views
    grid = default_grid(scan.geometry).binned(level)
    radiographs = Radiographs(stream, scan, level)
    before, after = (g.binned(level) for g in (scan.geometry, scan.geometry.with_motion(motion)))
    scale = bool(np.any(motion.magnification != 1))

    def registered(
        geometry: ConeBeamGeometry, volume: Volume, name: str, still: bool
    ) -> Registered:
        return reproject_and_register(
            stream,
            radiographs,
            volume,
            geometry,
            registration_for(
                stream, scan, radiographs, first=False, magnification=scale, still=still
            ),
            magnification=np.ones(scan.views),
            detector=scan.geometry.shape,
            stage=f"report: re-projecting {name}",
        )

    unexplained, gradients = [], []
    for name, geometry, chosen in (("before", before, None), ("after", after, used)):
        stage = f"report: volume {name}"
        volume = ramp_fbp(stream, radiographs, geometry, grid, valid_views=chosen, stage=stage)
        found = registered(geometry, volume, name, still=True)
        unexplained.append(float(np.median(found.unexplained)))
        gradients.append(_gradient(volume.to_host()))
    halves = []
    for name, first in (("even views", 0), ("views between", 1)):
        # Of the valid ones: bad ones may well be every second view.
        half = np.flatnonzero(used)[first::2]
        part = Radiographs(stream, Scan(radiographs, after).subset(half), 1)
        stage = f"report: volume of {name}"
        volume = ramp_fbp(stream, part, after.subset(half), grid, stage=stage)
        halves.append(registered(after, volume, f"from {name}", still=False).motion)
    even, odd = halves
    return Agreement(
        level,
        unexplained_before=unexplained[0],
        unexplained_after=unexplained[1],
        half_u=float(np.median(np.abs(even.shift_u - odd.shift_u))),
        half_v=float(np.median(np.abs(even.shift_v - odd.shift_v))),
        sharpness=gradients[1] / gradients[0] if gradients[0] else 1.0,
    )


def _gradient(volume: NDArray[np.float32]) -> float:
    """Mean squared gradient of some planes across the axis, away from the field's border."""
    nz, ny, nx = volume.shape
    y, x = np.ogrid[:ny, :nx]
    inside = np.hypot(y - (ny - 1) / 2, x - (nx - 1) / 2) < 0.5 * _INSIDE * min(nx, ny)
    chosen = np.unique(np.linspace(nz // 4, nz - 1 - nz // 4, _PLANES).round().astype(int))
    slopes = np.gradient(volume[chosen].astype(np.float64), axis=(1, 2))
    return float(np.mean((slopes[0] ** 2 + slopes[1] ** 2)[:, inside]))
