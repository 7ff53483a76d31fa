"""One resolution of a multigrid reconstruction: Algorithm 3, what it does with its radiographs."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.reprojection import (
    Registered,
    binned_mask,
    in_full_pixels,
    register,
    registration_for,
    reprojected,
)
from clra.methods.ordered_subsets.subset_rays import VOLUMES
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.methods.reconstruction.osem_tr import OrderedSubsets, osem_tr, start_volume
from clra.methods.reconstruction.residuals import residuals
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.registration.gauss_newton import ESTIMATE_FIELDS
from clra.ops.streaming.memory import Store
from clra.ops.streaming.multigrid import prolongate, restrict
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import Volume

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# At the levels that are corrected, the device holds the volume and its correction.
_VOLUMES = 2


@dataclass
class MultigridLevel:
    """The radiographs and the grid of one resolution.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        At full resolution.
    grid : VolumeGrid
        At full resolution; kept at this one.
    osem : OrderedSubsets
        How the lowest level is reconstructed.
    factor : int
        Binning.
    lowest : bool
        Whether it is reconstructed; higher levels are corrected only.

    Attributes
    ----------
    radiographs : Radiographs
        Binned.
    volumes : int
        Volumes that the device holds at a time.
    """

    stream: Stream
    scan: Scan
    grid: VolumeGrid
    osem: OrderedSubsets
    factor: int
    lowest: bool
    radiographs: Radiographs = field(init=False)
    volumes: int = field(init=False)

    def __post_init__(self) -> None:
        # 1: down-sample the measured radiographs
        self.radiographs = Radiographs(self.stream, self.scan, self.factor)
        self.volumes = VOLUMES if self.lowest else _VOLUMES
        if self.factor > 1:
            self.grid = self.grid.binned(self.factor)

    @property
    def used(self) -> NDArray[np.bool_]:
        """Pixels of the binned detector that count."""
        mask = self.scan.registration_mask
        return binned_mask(
            np.ones(self.scan.geometry.shape, np.bool_) if mask is None else mask, self.factor
        )

    def geometry(self, motion: Motion) -> ConeBeamGeometry:
        """Motions are in full-resolution pixels: absorb first, then bin."""
        return self.scan.geometry.with_motion(motion).binned(self.factor)

    def first(self, motion: Motion, valid_views: Bools) -> Volume:
        """Return the volume to start from: steps 1 and 2."""
        return start_volume(
            self.stream,
            self.radiographs,
            self.geometry(motion),
            self.grid,
            self.osem,
            valid_views=valid_views,
        )

    def brought(self, volume: Volume) -> Volume:
        """Bring the volume of the level before to this resolution."""
        if not self.lowest:  # 11, 17
            return prolongate(self.stream, volume, self.grid, volumes=self.volumes)
        for _ in range(self.factor.bit_length() - 1):  # 23
            volume = restrict(self.stream, volume, volumes=self.volumes)
        return volume

    def simulate(
        self,
        volume: Volume,
        motion: Motion,
        *,
        registering: bool,
        first: bool,
        magnification: bool,
        title: str,
    ) -> tuple[Store, float, Registered | None]:
        """Project the volume, once; compare and, if asked, register chunk by chunk.

        Parameters
        ----------
        volume : Volume
            So far, at this resolution.
        motion : Motion
            Of the radiographs as known so far.
        registering : bool
            Whether to register the measured radiographs with the simulated ones.
        first : bool
            Whether nothing is known of the motion yet.
        magnification : bool
            Whether to estimate it.
        title : str
            What progress reports begin with.

        Returns
        -------
        simulated : Store
            Line integrals (views, rows, columns).
        misfit : float
            Mean Poisson deviance of a ray.
        found : Registered or None
            What is left of the motion.
        """
        stream, level, geometry = self.stream, self.factor, self.geometry(motion)
        simulated = Store(self.radiographs.shape, stream.room)
        statistics = self.osem.statistics(stream, self.used, level)
        registration = registration_for(
            stream,
            self.scan,
            self.radiographs,
            first=first,
            magnification=magnification,
        ) if registering else None  # fmt: skip
        table = np.empty((geometry.views, len(ESTIMATE_FIELDS)))
        for views, measured, made in reprojected(
            stream, self.radiographs, volume, geometry, f"{title}: simulating"
        ):
            statistics.deviance(stream.queue, made, measured)
            simulated.write(views.start, stream.download(made))
            if registration is not None:
                known = motion.magnification[views]
                table[views] = register(stream, registration, measured, made, known)
        misfit = statistics.misfit(stream.queue, geometry.views)
        found = in_full_pixels(table, level, self.scan.geometry.shape) if registering else None
        return simulated, misfit, found

    def correction(
        self,
        simulated: Store,
        motion: Motion,
        grid: VolumeGrid,
        *,
        moved: Floats | None,
        valid_views: Bools,
        title: str,
    ) -> Volume:
        """Filter and back-project what the radiographs hold beyond simulated ones: steps 15, 21.

        Parameters
        ----------
        simulated : Store
            As of `simulate`; its contents are lost.
        motion : Motion
            Of the measured radiographs.
        grid : VolumeGrid
            Of the volume to be corrected.
        moved : ndarray, (views, 3), optional
            As for :func:`clra.methods.reconstruction.residuals.residuals`.
        valid_views : ndarray of bool, (views,)
            Views to correct by, at least one.
        title : str
            What progress reports begin with.
        """
        return ramp_fbp(
            self.stream,
            residuals(self.stream, self.radiographs, simulated, self.used, moved=moved),
            self.geometry(motion),
            grid,
            valid_views=valid_views,
            stage=f"{title}: correcting",
            volumes=self.volumes,
        )

    def reconstruct(self, volume: Volume, motion: Motion, valid_views: Bools, title: str) -> None:
        """Raise the likelihood of the volume by OSEM-TR: step 9."""
        osem_tr(
            self.stream,
            self.radiographs,
            self.geometry(motion),
            volume,
            self.osem,
            used=self.used,
            valid_views=valid_views,
            stage=f"{title}: OSEM-TR",
        )
