"""Re-projection: simulate each radiograph from the volume and register the measured one with it."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pyopencl.array import Array

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.model.schedule import level_name
from clra.ops.registration.gauss_newton import ESTIMATE_FIELDS, SMALLEST, Registration
from clra.ops.registration.phase_correlation import PhaseCorrelation
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.slab_projector import SlabProjector
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import Volume

Floats = NDArray[np.float64]

# Planes beyond each end of the grid, as a part of its height: views at the ends of a scan look
# past it, and what they see there has to be in the re-projection too.
_MARGIN = 0.15
# Expected standard deviation of log(magnification), see `Registration`. The paper's scans stay
# within 1e-3, but pulled so hard slow drifts come out a tenth too small. Small images, whose
# systematic errors of 0.01 pixel are 1e-3 of their size, have to be held: those with a diagonal
# below this many pixels by the square of what they lack.
SPREAD = 3e-3
_LONG = 110
# Sigmas of the band-pass in pixels of the level, low and high, first iteration and later: the first
# reconstruction is blurred by the motion itself, and its fine detail is not the sample's. Ramp-FBP
# is shaded where it lacks rays, and shading displaces what the band lets through: re-projections of
# the paper's scans are off by 0.25 pixel in v and 1.5e-3 in magnification with a high sigma of 16,
# 0.04 and 6e-4 with 8, 0.025 and 2e-4 with 4, no better with 3. Small images, see `_LONG`, hold too
# few edges for that: with 4 a real scan of 135 x 160 ends at 0.47 pixel in u instead of 0.33.
_FIRST_BAND, _BAND, _SMALL_BAND = (2.0, 8.0), (1.0, 4.0), (1.0, 8.0)

# An estimate that knows the shift only: magnification, gain and correlation 1, sigmas unknown.
_SHIFT_ALONE = np.array([0, 0, 1, 1, 0, 1, 0, np.nan, np.nan, np.nan])
REACH = 16.0
"""Farthest shift that is searched [pixel of the level]."""
_STILL = 1e-6  # no shift at all


@dataclass(frozen=True)
class Registered:
    """What registration found, a value a view; lengths in pixels of the full-resolution detector.

    Attributes
    ----------
    motion : Motion
        How the measured radiographs are moved against the simulated ones.
    correlation : ndarray, (views,)
        Normalised correlation of the two in the band used, after registration; at most 1.
    residual : ndarray, (views,)
        RMS of what is left of the measured radiograph in that band [attenuation].
    sigma : ndarray, (views, 3)
        Standard errors of shift_u and shift_v [pixel] and of the magnification.
    """

    motion: Motion
    correlation: Floats
    residual: Floats
    sigma: Floats

    @property
    def unexplained(self) -> Floats:
        """Part of each measured radiograph that its simulated counterpart is not, (views,)."""
        return np.sqrt(1 - np.clip(self.correlation, 0, 1) ** 2)


def with_margin(grid: VolumeGrid) -> VolumeGrid:
    """Return a grid with planes added at both ends, for what views at the ends of a scan see."""
    return grid.padded(round(_MARGIN * grid.shape[0]))


def registration_for(
    stream: Stream,
    scan: Scan,
    radiographs: Radiographs,
    *,
    first: bool,
    magnification: bool,
    spread: float = SPREAD,
    still: bool = False,
) -> Registration:
    """Return the estimator for radiographs of a level.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        At full resolution, with its mask.
    radiographs : Radiographs
        Of the level.
    first : bool
        Whether the volume is blurred by motion not known yet.
    magnification : bool
        Whether to estimate it.
    spread : float
        Its expected spread, as for `Registration`.
    still : bool
        Compare the radiographs where they are: gain, offset and sharpness alone are fitted.

    Raises
    ------
    InputError
        If radiographs of the level are too small to be registered.
    """
    views, rows, columns = radiographs.shape
    if min(rows, columns) < SMALLEST:
        raise InputError(
            f"{scan.name}: detector: found {scan.geometry.rows} x {scan.geometry.columns} pixels, "
            f"{rows} x {columns} at {level_name(radiographs.level)}, expected at least {SMALLEST} "
            "rows and columns there to register; start at a finer level, such as with schedule 4FR"
        )
    low_pass, high_pass = band_of((rows, columns), first=first)
    mask = scan.registration_mask
    chunks = stream.chunks(views, radiographs.view_bytes)
    return Registration(
        stream.context,
        (rows, columns),
        views=max(chunk.stop - chunk.start for chunk in chunks),
        low_pass=low_pass,
        high_pass=high_pass,
        mask=None if mask is None else binned_mask(mask, radiographs.level),
        magnification=magnification and not still,
        spread=spread_of(spread, (rows, columns)),
        coarse=not still,
        max_shift=_STILL if still else REACH,
        allocator=stream.memory,
        # It keeps a pair's images in a dozen forms; the filters' share is free by now.
        scratch_limit=3 * stream.scratch_limit,
    )


def band_of(shape: tuple[int, int], *, first: bool = False) -> tuple[float, float]:
    """Sigmas of the band-pass for images of (rows, columns), low and high [pixel]."""
    return _FIRST_BAND if first else _BAND if _size(shape) == 1 else _SMALL_BAND


def is_large(shape: tuple[int, int]) -> bool:
    """Whether images of (rows, columns) tell magnifications as far as they are expected."""
    return _size(shape) == 1


def spread_of(spread: float, shape: tuple[int, int]) -> float:
    """Spread that magnifications of images of (rows, columns) are held to, see `SPREAD`."""
    return spread * _size(shape) ** 2


def _size(shape: tuple[int, int]) -> float:
    """Diagonal as a part of what is long enough, at most 1."""
    return min(1.0, float(np.hypot(*shape)) / _LONG)


def binned_mask(mask: NDArray[np.bool_], level: int) -> NDArray[np.bool_]:
    """Bin a mask: a pixel may be used if all its parts may."""
    rows, columns = (n // level for n in mask.shape)
    blocks = mask[: rows * level, : columns * level].reshape(rows, level, columns, level)
    return np.asarray(blocks.all(axis=(1, 3)))


def used_pixels(scan: Scan, level: int) -> NDArray[np.bool_]:
    """Return the pixels of the binned detector that count in reconstructions."""
    full = np.ones(scan.geometry.shape, np.bool_) if scan.mask is None else scan.mask
    return binned_mask(full, level)


def reprojected(
    stream: Stream, radiographs: Radiographs, volume: Volume, geometry: ConeBeamGeometry, stage: str
) -> Iterator[tuple[slice, Array, Array]]:
    """Yield the measured radiographs and their simulated counterparts, a chunk of views at a time.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    radiographs : Radiographs
        Measured line integrals at the resolution of `geometry`.
    volume : Volume
        Reconstruction.
    geometry : ConeBeamGeometry
        Of the radiographs, with the motion known so far absorbed.
    stage : str
        What progress reports call this.

    Yields
    ------
    views : slice
        Of the scan.
    measured, simulated : cl.array.Array
        float32 (n, rows, columns), valid until the next chunk.
    """
    project = SlabProjector(stream, volume, geometry)
    views = geometry.views
    chunks = stream.chunks(views, radiographs.view_bytes)
    stream.report(stage, 0, views)
    for chunk, simulated in project.in_chunks(stream, chunks):
        stream.report(stage, chunk.start, views)
        measured = radiographs.on_device(stream, chunk)
        yield chunk, measured, simulated
        stream.queue.finish()
        del measured, simulated
    stream.report(stage, views, views)


def register(
    stream: Stream,
    registration: Registration | PhaseCorrelation,
    measured: Array,
    simulated: Array,
    magnification: Floats,
) -> Floats:
    """Register pairs of radiographs.

    Parameters
    ----------
    stream : Stream
        Device.
    registration : Registration or PhaseCorrelation
        Estimator for radiographs of this size.
    measured, simulated : cl.array.Array
        float32 (n, rows, columns), line integrals.
    magnification : ndarray, (n,)
        That the simulation was made with; the registration may expect it to be close to 1.

    Returns
    -------
    ndarray, (n, fields)
        A row a pair, see ``ESTIMATE_FIELDS``; of a phase correlation all but the shifts say
        nothing.
    """
    if isinstance(registration, PhaseCorrelation):
        shifts = stream.empty((len(magnification), 2))
        registration(stream.queue, shifts, measured, simulated).wait()
        table = np.tile(_SHIFT_ALONE, (len(magnification), 1))
        table[:, :2] = stream.download(shifts)
        return table
    estimates = stream.empty((len(magnification), len(ESTIMATE_FIELDS)))
    known = stream.upload(np.log(magnification).astype(np.float32))
    registration(stream.queue, estimates, measured, simulated, known).wait()
    return stream.download(estimates).astype(np.float64)


def reproject_and_register(
    stream: Stream,
    radiographs: Radiographs,
    volume: Volume,
    geometry: ConeBeamGeometry,
    registration: Registration | PhaseCorrelation,
    *,
    magnification: Floats,
    detector: tuple[int, int],
    stage: str = "registering",
) -> Registered:
    """Run steps 3 and 4 of Algorithm 1.

    Parameters
    ----------
    stream, radiographs, volume, geometry, stage
        As for :func:`reprojected`; what is found comes on top of the motion in `geometry`.
    registration : Registration or PhaseCorrelation
        Estimator for radiographs of this size.
    magnification : ndarray, (views,)
        That `geometry` has absorbed.
    detector : (int, int)
        As for :func:`in_full_pixels`.

    Returns
    -------
    Registered
    """
    table = np.empty((geometry.views, len(ESTIMATE_FIELDS)))
    for views, measured, simulated in reprojected(stream, radiographs, volume, geometry, stage):
        known = magnification[views]
        table[views] = register(stream, registration, measured, simulated, known)
    return in_full_pixels(table, radiographs.level, detector)


def in_full_pixels(table: Floats, level: int, detector: tuple[int, int]) -> Registered:
    """Translate what was registered at a level to full resolution.

    Parameters
    ----------
    table : ndarray, (views, fields)
        As of :func:`register`.
    level : int
        Binning factor.
    detector : (int, int)
        Rows and columns at full resolution: the magnification is about the binned detector's
        centre, which lies half of what binning drops away from that of the whole one.
    """
    column = {name: table[:, index] for index, name in enumerate(ESTIMATE_FIELDS)}
    magnification = column["magnification"]
    offset_v, offset_u = (0.5 * (1 - magnification) * (n % level) for n in detector)
    return Registered(
        motion=Motion(
            shift_u=level * column["shift_u"] - offset_u,
            shift_v=level * column["shift_v"] - offset_v,
            magnification=magnification,
        ),
        correlation=column["correlation"],
        residual=column["residual"],
        sigma=np.stack(
            [level * column["sigma_u"], level * column["sigma_v"], column["sigma_m"]], axis=1
        ),
    )
