"""One resolution of a multigrid reconstruction: Algorithm 3, what it does with its radiographs."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.reprojection import Registered, binned_mask, in_full_pixels, reprojected
from clra.methods.ordered_subsets.subset_rays import VOLUMES
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.methods.reconstruction.osem_tr import OrderedSubsets, osem_tr, start_volume
from clra.methods.reconstruction.residuals import RadiographComparison, residuals
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.model.view_selection import sampled
from clra.ops.streaming.memory import Store
from clra.ops.streaming.multigrid import prolongate, restrict
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.slab_projector import volume_from
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# At the levels that are corrected, the device holds the volume and its correction.
CORRECTED_VOLUMES = 2


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
    volumes : int
        Volumes that the device holds at a time.
    """

    stream: Stream
    scan: Scan
    grid: VolumeGrid
    osem: OrderedSubsets
    factor: int
    lowest: bool
    volumes: int = field(init=False)

    def __post_init__(self) -> None:
        self.volumes = VOLUMES if self.lowest else CORRECTED_VOLUMES
        if self.factor > 1:
            self.grid = self.grid.binned(self.factor)

    @cached_property
    def radiographs(self) -> Radiographs:
        """The measured radiographs, binned when they are needed."""
        return Radiographs(self.stream, self.scan, self.factor)  # 1: down-sample

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

    # What follows takes and returns volumes, and simulated radiographs, of its own kind.

    def restored(self, planes: NDArray[np.float32]) -> Any:
        """Return the volume of this resolution that was kept as an array (z, y, x)."""
        return volume_from(self.stream, self.grid, planes)

    def first(self, motion: Motion, valid_views: Bools) -> Any:
        """Return the volume to start from: steps 1 and 2."""
        return start_volume(
            self.stream,
            self.radiographs,
            self.geometry(motion),
            self.grid,
            self.osem,
            valid_views=valid_views,
        )

    def brought(self, volume: Any, title: str | None) -> Any:
        """Bring the volume of the level before to this resolution; no title, no reports."""
        if not self.lowest:  # 11, 17
            return prolongate(self.stream, volume, self.grid, volumes=self.volumes)
        for _ in range(self.factor.bit_length() - 1):  # 23
            volume = restrict(self.stream, volume, volumes=self.volumes)
        return volume

    def simulate(
        self,
        volume: Any,
        motion: Motion,
        *,
        registering: bool,
        first: bool,
        magnification: bool,
        title: str,
    ) -> tuple[Any, float, Registered | None]:
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
        compare = RadiographComparison(self.osem, self.used, registering, first, magnification)
        simulated, deviance, table = self._compared(compare, volume, motion, f"{title}: simulating")
        found = None
        if table is not None:
            found = in_full_pixels(table, self.factor, self.scan.geometry.shape)
        return simulated, deviance / self.scan.views, found

    def corrected(
        self,
        volume: Any,
        simulated: Any,
        motion: Motion,
        *,
        moved: Floats | None,
        valid_views: Bools,
        title: str,
    ) -> Any:
        """Add what the radiographs hold beyond simulated ones: steps 15, 21.

        Parameters
        ----------
        volume : Volume
            That they were simulated from; its contents are lost.
        simulated : Store
            As of `simulate`; its contents are lost.
        motion : Motion
            Of the measured radiographs.
        moved : ndarray, (views, 3), optional
            As for :func:`clra.methods.reconstruction.residuals.residual_chunks`.
        valid_views : ndarray of bool, (views,)
            Views to correct by, at least one.
        title : str
            What progress reports begin with.
        """
        geometry = self.geometry(motion)
        return ramp_fbp(
            self.stream,
            residuals(self.stream, self.radiographs, simulated, self.used, moved=moved),
            geometry,
            self.grid,
            valid_views=valid_views,
            stage=f"{title}: correcting",
            volumes=self.volumes,
            onto=volume,
            step=sampled(geometry, self.grid),
        )

    def reconstruct(self, volume: Any, motion: Motion, valid_views: Bools, title: str) -> Any:
        """Raise the likelihood of the volume by OSEM-TR: step 9. The volume's contents are lost."""
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
        return volume

    def _compared(
        self, compare: RadiographComparison, volume: Any, motion: Motion, stage: str
    ) -> tuple[Any, float, Floats | None]:
        """Return what is simulated, and what :class:`RadiographComparison` does."""
        simulated = Store(self.radiographs.shape, self.stream.room)
        pairs = reprojected(self.stream, self.radiographs, volume, self.geometry(motion), stage)
        deviance, table = compare(
            self.stream,
            self.scan,
            self.radiographs,
            pairs,
            motion.magnification,
            simulated.write,
        )
        return simulated, deviance, table
