"""One resolution of an alignment: Algorithm 1, steps 2 to 4, free of what they find by mistake."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.options import Solver
from clra.methods.alignment.region import Region
from clra.methods.alignment.reprojection import Registered, reproject_and_register, used_pixels
from clra.methods.reconstruction.fitted_fbp import fitted_fbp, reprojections
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream


@dataclass
class Level:
    """The radiographs of one resolution, and how far their re-projections are displaced.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    scan : Scan
        At full resolution.
    region : Region
        Where to reconstruct, at full resolution.
    solver : Solver
        Estimator, and parts of the iteration.
    factor : int
        Binning.

    Attributes
    ----------
    radiographs : Radiographs
        Binned.
    grid : VolumeGrid
        Of the level.
    bias : Motion or None
        What registration finds where nothing moved, once it is known.
    """

    stream: Stream
    scan: Scan
    region: Region
    solver: Solver
    factor: int
    radiographs: Radiographs = field(init=False)
    grid: VolumeGrid = field(init=False)
    bias: Motion | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        # 1, 7: down-sample the measured radiographs
        self.radiographs = self._binned()
        grid = self.region.grid
        self.grid = grid.binned(self.factor) if self.factor > 1 else grid

    def residual_motion(
        self,
        motion: Motion,
        known: NDArray[np.float64],
        *,
        valid_views: NDArray[np.bool_],
        first: bool,
        magnification: bool,
        measure: bool,
        title: str,
        pulled: bool = True,
    ) -> Registered:
        """Reconstruct, simulate and register: what is left of the motion.

        Parameters
        ----------
        motion : Motion
            As known so far, in pixels of full resolution.
        known : ndarray, (views,)
            Its magnification against the one that is expected.
        valid_views : ndarray of bool, (views,)
            Views to reconstruct from, at least one.
        first : bool
            Whether nothing is known of the motion yet.
        magnification : bool
            Whether to estimate it.
        measure : bool
            Whether to find the bias, if it is not known and images are so small that it counts.
        title : str
            What progress reports begin with.
        pulled : bool
            Whether magnifications of small images are pulled to what is expected.
        """
        # Motions are in full-resolution pixels: absorb first, then bin.
        geometry = self.scan.geometry.with_motion(motion).binned(self.factor)
        at = At(geometry, known, valid_views, first, magnification, pulled)
        # 2: reconstruct from the corrected radiographs
        volume = self._reconstructed(at, self.radiographs, title)
        # 3, 4: simulate and register
        found = self._registered(at, self.radiographs, volume, f"{title}: registering")
        if measure and self.bias is None and self.solver.is_biased(geometry):
            still = self._simulated(at, volume, f"{title}: simulating")
            del volume
            volume = self._reconstructed(at, still, f"{title}: what is simulated")
            doing = f"{title}: registering what is simulated"
            self.bias = self._registered(at, still, volume, doing).motion
        if self.bias is None:
            return found
        return replace(found, motion=self.bias.inverse().then(found.motion))

    def _binned(self) -> Radiographs:
        return Radiographs(self.stream, self.scan, self.factor)

    def _reconstructed(self, at: "At", radiographs: Any, stage: str) -> Any:
        """Return a volume that :meth:`_registered` and :meth:`_simulated` take."""
        return fitted_fbp(
            self.stream,
            radiographs,
            at.geometry,
            self.grid,
            positive=self.solver.positive,
            terms=self.terms,
            valid_views=at.valid_views,
            circle=self.circle,
            beside=self.region.truncated,
            used=self.used,
            stage=stage,
        )

    def _registered(self, at: "At", radiographs: Any, volume: Any, stage: str) -> Registered:
        return reproject_and_register(
            self.stream,
            radiographs,
            volume,
            at.geometry,
            # Made anew: it would stand beside the reconstruction's memory.
            self.solver.registration(
                self.stream,
                self.scan,
                radiographs,
                first=at.first,
                magnification=at.magnification,
                pulled=at.pulled,
            ),
            magnification=at.known,
            detector=self.scan.geometry.shape,
            stage=stage,
        )

    def _simulated(self, at: "At", volume: Any, stage: str) -> Radiographs:
        return reprojections(self.stream, volume, at.geometry, self.factor, stage)

    @property
    def terms(self) -> int:
        """Corrections of each volume."""
        return self.region.terms(self.solver.terms)

    @property
    def circle(self) -> bool:
        """Whether nothing is reconstructed outside the circle that all views see."""
        return self.solver.circle and not self.region.truncated

    @property
    def used(self) -> NDArray[np.bool_]:
        """Pixels of the binned detector that count."""
        return used_pixels(self.scan, self.factor)


@dataclass(frozen=True)
class At:
    """Where an iteration of a level stands.

    Attributes
    ----------
    geometry : ConeBeamGeometry
        Of the level, with the motion absorbed.
    known : ndarray, (views,)
        Magnification that it has absorbed, against the one that is expected.
    valid_views : ndarray of bool, (views,)
        Views to reconstruct from.
    first, magnification, pulled : bool
        As for :meth:`Level.residual_motion`.
    """

    geometry: ConeBeamGeometry
    known: NDArray[np.float64]
    valid_views: NDArray[np.bool_]
    first: bool
    magnification: bool
    pulled: bool
