"""Held-out views: how well a volume from some of the views predicts the others.

A volume can be made to agree with radiographs that lie wrong, as long as it is made from them.
Views that it was not made from are predicted well only if all lie where they belong. The volume is
not negative and found by iteration: ramp-filtered back-projection is a poor inverse where rays are
missing, and its artefacts would hide the difference.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.reprojection import (
    Registered,
    band_of,
    in_full_pixels,
    register,
    registration_for,
    reprojected,
)
from clra.methods.assessment.residual_regions import PARTS, residual_by_part
from clra.methods.reconstruction.osem_tr import OrderedSubsets, osem_tr, start_volume
from clra.model.gauge.gauge import Gauge, sample_points
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid, default_grid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.model.schedule import coarse_level
from clra.model.subsets import ordered_subsets
from clra.ops.registration.gauss_newton import ESTIMATE_FIELDS, Registration
from clra.ops.streaming.radiographs import Radiographs, Reading, read_here
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import Volume

Floats = NDArray[np.float64]

# Updates of the volume, all subsets of all passes.
_UPDATES = 9
FEW = 60
"""Number of views below which a half of them is too few to go by."""
# Parts of the views, each predicted from the others.
_PARTS, _PARTS_OF_FEW = 2, 4
# Photons that weigh the rays against each other: nearly alike.
_PHOTONS = 1e3
# Expected spread of log(magnification), so wide that it pulls nothing: alignments of small images
# are held to what is expected, and what this hides along slow modes has to show here.
_SPREAD = 0.1
# Columns and views of what is looked at, at most: a few seconds whatever the size of the scan.
_COLUMNS, _VIEWS = 80, 480
# Points of the sample by which the gauge is known.
_POINTS = 300


@dataclass(frozen=True)
class Predicted:
    """What held-out views say of a motion; one value a view, NaN for views not held out.

    Attributes
    ----------
    residual : ndarray, (views,)
        RMS of what the prediction leaves of a radiograph where it lies, in the band of
        registration, as a part of the radiograph's own.
    shift : ndarray, (views, 3)
        What registration with the prediction finds to be left: shift_u, shift_v [pixel of the
        full-resolution detector] and log(magnification); 0 where it is not registered.
    parts : ndarray, (views, 3, 3)
        Mean squares of the same residual in each third of the rows and of the columns.
    sharpness : float
        Mean squared gradient of the volumes.
    """

    residual: Floats
    shift: Floats
    parts: Floats
    sharpness: float

    def left(self, geometry: ConeBeamGeometry, *, magnification: bool) -> Floats:
        """Return the gauge-free part of `shift`, (views, 3); NaN for views not held out.

        Parameters
        ----------
        geometry : ConeBeamGeometry
            Of the scan, at full resolution.
        magnification : bool
            Whether it was registered.
        """
        held = np.flatnonzero(np.isfinite(self.residual))
        u, v, m = self.shift[held].T
        points = sample_points(default_grid(geometry), _POINTS)
        gauge = Gauge(geometry.subset(held), points, magnification=magnification)
        left = np.full(self.shift.shape, np.nan)
        left[held] = gauge.fit(Motion(shift_u=u, shift_v=v, magnification=np.exp(m))).remainder
        return left


@dataclass(frozen=True)
class HeldOut:
    """Predictions of one scan's radiographs at a low resolution.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        At full resolution.
    grid : VolumeGrid
        At full resolution: of all that the radiographs show.
    reading : callable, optional
        Reads radiographs; this process by default.
    """

    stream: Stream
    scan: Scan
    grid: VolumeGrid
    reading: Reading | None = None

    @property
    def level(self) -> int:
        """Binning factor."""
        return coarse_level(self.scan.geometry.shape, _COLUMNS)

    def chosen(self, valid_views: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return the valid views that are looked at: all, or some evenly spread runs of two."""
        valid = np.flatnonzero(valid_views)
        if len(valid) <= _VIEWS:
            return valid
        spread = np.unique(np.linspace(0, len(valid) - 1, _VIEWS).astype(int))
        return np.asarray(valid[spread])

    def radiographs(self, valid_views: NDArray[np.bool_]) -> tuple[Radiographs, NDArray[np.intp]]:
        """Read and bin what is needed; the second value are the views that these are."""
        views = self.chosen(valid_views)
        reading = self.reading or read_here(self.stream)
        return reading(self.scan.subset(views), self.level), views

    def predict(
        self,
        radiographs: Radiographs,
        views: NDArray[np.intp],
        motion: Motion,
        further: Motion | None = None,
        *,
        magnification: bool,
        whole: bool,
        stage: str,
    ) -> Predicted:
        """Predict views from others, and compare.

        Parameters
        ----------
        radiographs : Radiographs
            As :meth:`radiographs` reads them.
        views : ndarray of int
            Of the scan that they are.
        motion : Motion
            Of all views of the scan [pixel of the full-resolution detector].
        further : Motion, optional
            That is taken to follow it.
        magnification : bool
            Whether to register it.
        whole : bool
            Whether each of the views is held out once, or one part of them only.
        stage : str
            What progress reports begin with.
        """
        level, scan = self.level, self.scan.subset(views)
        grid = self.grid.binned(level) if level > 1 else self.grid
        geometry = scan.geometry.with_motion(motion.subset(views))
        if further is not None:
            geometry = geometry.with_motion(further.subset(views))
        geometry = geometry.binned(level)
        binned = Scan(radiographs, geometry)
        index = np.arange(len(views))
        times = _PARTS_OF_FEW if len(views) < FEW else _PARTS
        residual = np.full(self.scan.views, np.nan)
        shift = np.full((self.scan.views, 3), np.nan)
        parts = np.full((self.scan.views, PARTS, PARTS), np.nan)
        sharpness = []
        for part in range(times if whole else 1):
            held, train = index[part::times], np.delete(index, np.s_[part::times])
            seen, around = Radiographs(self.stream, binned.subset(train), 1), geometry.subset(train)
            count = len(ordered_subsets(around, grid))
            options = OrderedSubsets(passes=ceil(_UPDATES / count), i0=_PHOTONS)
            volume = start_volume(self.stream, seen, around, grid, options)
            used = np.ones(geometry.shape, np.bool_)
            title = f"{stage}: volume {part + 1}"
            osem_tr(self.stream, seen, around, volume, options, used=used, stage=title)
            hidden = Radiographs(self.stream, binned.subset(held), 1)
            registrations = [
                registration_for(
                    self.stream,
                    scan,
                    radiographs,
                    first=False,
                    magnification=magnification,
                    spread=_SPREAD,
                    still=where_it_lies,
                )
                for where_it_lies in (True, False)
            ]
            (still, moved), parts[views[held]] = self._compared(
                registrations, hidden, volume, geometry.subset(held), f"{stage}: comparing"
            )
            residual[views[held]] = still.unexplained
            found = moved.motion
            shift[views[held]] = np.stack(
                [level * found.shift_u, level * found.shift_v, np.log(found.magnification)], axis=1
            )
            sharpness.append(_gradient(volume.to_host()))
        return Predicted(residual, shift, parts, float(np.mean(sharpness)))

    def _compared(
        self,
        registrations: Sequence[Registration],
        hidden: Radiographs,
        volume: Volume,
        geometry: ConeBeamGeometry,
        stage: str,
    ) -> tuple[list[Registered], Floats]:
        """Register held-out views with one prediction in several ways; what it leaves by part."""
        tables = np.empty((len(registrations), geometry.views, len(ESTIMATE_FIELDS)))
        parts = np.empty((geometry.views, PARTS, PARTS))
        known, band = np.ones(geometry.views), band_of(geometry.shape)
        for views, measured, simulated in reprojected(self.stream, hidden, volume, geometry, stage):
            for table, registration in zip(tables, registrations, strict=True):
                table[views] = register(
                    self.stream, registration, measured, simulated, known[views]
                )
            parts[views] = residual_by_part(
                hidden.read(views), self.stream.download(simulated), band
            )
        return [in_full_pixels(table, 1, geometry.shape) for table in tables], parts


def _gradient(volume: NDArray[np.float32]) -> float:
    """Mean squared gradient of the middle half of the planes."""
    quarter = len(volume) // 4
    middle = volume[quarter : len(volume) - quarter].astype(np.float64)
    slopes = np.gradient(middle, axis=(1, 2))
    return float(np.mean(slopes[0] ** 2 + slopes[1] ** 2))
