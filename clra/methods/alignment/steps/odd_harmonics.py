"""Odd harmonics of the shifts along u, which truncated radiographs hardly determine.

Shifts along u on a circle that are odd harmonics of the source's angle look alike to opposite
views. Where the whole sample is seen, its centre of mass tells the third, as it has to move on a
circle. Where the sample is truncated, only rays at the sides of the fan that are measured twice
tell it, and that attenuation is not negative: re-projections show a tenth of what is wrong, and
what truncation does to filtered back-projection displaces them by as much. Therefore the harmonics
are fitted to the radiographs themselves, by variable projection [1]_: for each harmonic a volume is
found anew, by iteration from a uniform one, which has no such artefacts to get rid of.

.. [1] G. H. Golub, V. Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares
   problems whose variables separate", SIAM J. Numer. Anal. 10, 413 (1973).
"""

import logging
from dataclasses import replace
from math import ceil, pi

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from clra.errors import Cancelled
from clra.findings import Finding
from clra.methods.alignment.region import Region
from clra.methods.alignment.reprojection import band_of, used_pixels
from clra.methods.alignment.result import AlignmentInterrupted, AlignmentResult, finished
from clra.methods.reconstruction.fitted_fbp import reprojections
from clra.methods.reconstruction.osem_tr import OrderedSubsets, osem_tr, start_volume
from clra.model.motion import Motion
from clra.model.sampling.angular_coverage import covered, is_circle
from clra.model.sampling.field_of_view import is_offset
from clra.model.scan import Scan
from clra.model.schedule import coarse_level
from clra.model.subsets import ordered_subsets
from clra.ops.streaming.memory import DeviceMemoryError
from clra.ops.streaming.radiographs import Reading, read_here
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]
Images = NDArray[np.float32]

_LOG = logging.getLogger(__name__)

# Harmonics that are fitted. Of the seventh on re-projections find a third in each iteration.
_HARMONICS = 3, 5
# Columns of the radiographs and their number, at most: a volume takes a second or two. At half the
# columns a rock 1.5 fields wide ends at 0.15 pixel instead of 0.09. Fewer views tell too little.
_COLUMNS, _VIEWS, _FEWEST = 80, 240, 30
# Updates of each volume, all subsets of all passes. With 40 a rock 1.2 fields wide ends at 0.03 to
# 0.06 pixel, with 80 at 0.02 to 0.05, with 20 at 0.1.
_UPDATES = 80
# Photons that weigh the rays against each other: nearly alike.
_PHOTONS = 1e3
# Size of a harmonic by whose effect it is known [pixel of the level].
_PROBE = 0.3
# Part of the third harmonic that the volume does not take up, from which on re-projections find it
# by themselves. It is 0.4 to 0.5 of balls with air in between, which end at 0.02 to 0.05 pixel
# without the fit and at 0.05 to 0.1 with it, and 0.25, 0.11 and 0.08 of rocks 1, 1.2 and 1.5 fields
# wide.
_SEEN = 0.3
# What the fit may gain more or less than its linear model expects, as a part of that. It gains 0.96
# to 1.15 of it on rocks, -1.1 on balls, which are sharper than the volumes, and 2.1 on wood, whose
# fit ends farther from the truth.
_UNEXPECTED = 0.5


def are_open(scan: Scan, region: Region, aligned: AlignmentResult) -> bool:
    """Whether the odd harmonics have to be fitted: a truncated sample on a full circle.

    Parameters
    ----------
    scan : Scan
        At full resolution.
    region : Region
        Where it was reconstructed; a caller's grid, which is no wider than the field of view, does
        not do.
    aligned : AlignmentResult
        What re-projections found.
    """
    geometry = scan.geometry
    whole = is_circle(geometry) and not is_offset(geometry) and covered(geometry) == 2 * pi
    wide = region.truncated and region.grid.shape[2] > region.sample.shape[2]
    views = int(aligned.valid_views.sum())
    return wide and whole and views >= _FEWEST and aligned.motion.cause == "detector"


def with_odd_harmonics(
    stream: Stream,
    scan: Scan,
    region: Region,
    aligned: AlignmentResult,
    reading: Reading | None = None,
) -> AlignmentResult:
    """Add the odd harmonics along u that re-projections do not find; none if the call is ended.

    Parameters
    ----------
    stream, scan, region
        As of :func:`fitted_harmonics`.
    aligned : AlignmentResult
        What re-projections found.
    reading : callable, optional
        Reads radiographs; this process by default.

    Raises
    ------
    AlignmentInterrupted
        With what re-projections found.
    """
    try:
        more = fitted_harmonics(stream, scan, region, aligned.motion, aligned.valid_views, reading)
    except KeyboardInterrupt:
        raise AlignmentInterrupted(aligned) from None
    except DeviceMemoryError:
        return aligned  # which is finished
    except Cancelled:
        done = finished(aligned.history)
        Finding("cancelled", f"the alignment was ended early, after {done}").warn()
        return aligned
    return replace(aligned, motion=replace(aligned.motion, shift_u=aligned.motion.shift_u + more))


def fitted_harmonics(
    stream: Stream,
    scan: Scan,
    region: Region,
    motion: Motion,
    valid_views: NDArray[np.bool_],
    reading: Reading | None = None,
) -> Floats:
    """Fit the odd harmonics of the shifts along u at a low resolution.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        At full resolution, on a circle.
    region : Region
        Where to reconstruct, at full resolution.
    motion : Motion
        What re-projections found [pixel of the full-resolution detector].
    valid_views : ndarray of bool, (views,)
        Views to go by.
    reading : callable, optional
        Reads radiographs; this process by default.

    Returns
    -------
    ndarray, (views,)
        What is to be added to the shifts along u [pixel]; 0 if re-projections show enough of it, or
        if the fit does not do what its linear model expects.
    """
    chosen = np.flatnonzero(valid_views)
    if len(chosen) > _VIEWS:
        chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, _VIEWS).astype(int))]
    fit = _Fit(stream, scan.subset(chosen), region, reading or read_here(stream))
    angle = np.arctan2(scan.geometry.source[:, 1], scan.geometry.source[:, 0])
    shapes = np.stack([wave(n * angle) for n in _HARMONICS for wave in (np.cos, np.sin)])
    here = motion.subset(chosen)
    left, slope = fit.residual(here, "as found")
    effects, seen, pixels = [], [], _PROBE * fit.level
    for index, shape in enumerate(shapes[:, chosen]):
        title = f"{index + 1} of {len(shapes)}"
        moved = replace(here, shift_u=here.shift_u + pixels * shape)
        effects.append((fit.residual(moved, title)[0] - left) / pixels)
        # Of a volume that takes up nothing, the whole shift would be left.
        whole = shape[:, None, None].astype(np.float32) * slope / fit.level
        seen.append(np.vdot(whole, effects[-1]) / max(np.vdot(whole, whole), 1e-30))
        if index == 1 and np.mean(seen) > _SEEN:
            return np.zeros(scan.views)
    design = np.stack([effect.ravel() for effect in effects], axis=1)
    size = _solved(design, left)
    expected = _square(left) - _square(left.ravel() + design @ size.astype(np.float32))
    corrected = replace(here, shift_u=here.shift_u + size @ shapes[:, chosen])
    after, _ = fit.residual(corrected, "corrected")
    gained = (_square(left) - _square(after)) / max(expected, 1e-30)
    _LOG.info(
        "odd harmonics along u: %s pixel, seen: %s, gain: %.2f of what is expected",
        *(np.round(values, 2) for values in (size, seen)),
        gained,
    )
    if abs(gained - 1) > _UNEXPECTED:
        return np.zeros(scan.views)
    return np.asarray((size + _solved(design, after)) @ shapes)


def _solved(design: Images, left: Images) -> Floats:
    """Sizes of effects that leave least."""
    size, *_ = np.linalg.lstsq(design, -left.ravel(), rcond=None)
    return np.asarray(size, np.float64)


def _square(images: Images) -> float:
    return float(np.vdot(images, images))


class _Fit:
    """What volumes leave of a scan's radiographs at a low resolution."""

    def __init__(self, stream: Stream, scan: Scan, region: Region, reading: Reading) -> None:
        self.level = coarse_level(scan.geometry.shape, _COLUMNS)
        self._stream, self._geometry = stream, scan.geometry
        self._grid = region.grid.binned(self.level) if self.level > 1 else region.grid
        self._radiographs = reading(scan, self.level)
        self._measured = self._radiographs.read(slice(0, scan.views))
        self._used = used_pixels(scan, self.level)
        self._band = band_of(self._used.shape)

    def residual(self, motion: Motion, doing: str) -> tuple[Images, Images]:
        """Return what a volume leaves of the radiographs, in the band, and its slope along u."""
        stream, stage = self._stream, f"odd harmonics, {doing}"
        geometry = self._geometry.with_motion(motion).binned(self.level)
        count = len(ordered_subsets(geometry, self._grid))
        options = OrderedSubsets(passes=ceil(_UPDATES / count), i0=_PHOTONS, initial="uniform")
        volume = start_volume(stream, self._radiographs, geometry, self._grid, options)
        osem_tr(stream, self._radiographs, geometry, volume, options, used=self._used, stage=stage)
        again = reprojections(stream, volume, geometry, self.level, f"{stage}: simulating")
        simulated = again.read(slice(0, len(self._measured)))
        slope = np.gradient(simulated, axis=2)
        return self._in_band(self._measured - simulated), self._in_band(slope)

    def _in_band(self, images: Images) -> Images:
        low, high = ((0.0, sigma, sigma) for sigma in self._band)
        counting = images * self._used
        return np.asarray(gaussian_filter(counting, low) - gaussian_filter(counting, high))
