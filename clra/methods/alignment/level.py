"""One resolution of an alignment: Algorithm 1, steps 2 to 4, free of what they find by mistake."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.options import Solver
from clra.methods.alignment.region import Region
from clra.methods.alignment.reprojection import Registered, reproject_and_register, used_pixels
from clra.methods.reconstruction.fitted_fbp import fitted_fbp, reprojections
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import Volume


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
        self.radiographs = Radiographs(self.stream, self.scan, self.factor)
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
        """
        # Motions are in full-resolution pixels: absorb first, then bin.
        geometry = self.scan.geometry.with_motion(motion).binned(self.factor)

        def reconstructed(radiographs: Radiographs, doing: str | None = None) -> Volume:
            return fitted_fbp(
                self.stream,
                radiographs,
                geometry,
                self.grid,
                positive=self.solver.positive,
                terms=self.region.terms(self.solver.terms),
                valid_views=valid_views,
                circle=self.solver.circle and not self.region.truncated,
                beside=self.region.truncated,
                used=used_pixels(self.scan, self.factor),
                stage=title if doing is None else f"{title}: {doing}",
            )

        def registered(radiographs: Radiographs, volume: Volume, doing: str) -> Registered:
            return reproject_and_register(
                self.stream,
                radiographs,
                volume,
                geometry,
                # Made anew: it would stand beside the reconstruction's memory.
                self.solver.registration(
                    self.stream,
                    self.scan,
                    radiographs,
                    first=first,
                    magnification=magnification,
                ),
                magnification=known,
                detector=self.scan.geometry.shape,
                stage=f"{title}: {doing}",
            )

        # 2: reconstruct from the corrected radiographs
        volume = reconstructed(self.radiographs)
        # 3, 4: simulate and register
        found = registered(self.radiographs, volume, "registering")
        if measure and self.bias is None and self.solver.is_biased(geometry):
            still = reprojections(
                self.stream, volume, geometry, self.factor, f"{title}: simulating"
            )
            del volume
            volume = reconstructed(still, "what is simulated")
            self.bias = registered(still, volume, "registering what is simulated").motion
        if self.bias is None:
            return found
        return replace(found, motion=self.bias.inverse().then(found.motion))
