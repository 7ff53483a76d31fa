"""One resolution of an alignment: Algorithm 1, steps 2 to 4, free of what they find by mistake."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment.options import Solver
from clra.methods.alignment.reprojection import Registered, reproject_and_register
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.streaming.memory import Store
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.slab_projector import SlabProjector
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
    grid : VolumeGrid
        At full resolution.
    solver : Solver
        Estimator, and parts of the iteration.
    factor : int
        Binning.

    Attributes
    ----------
    radiographs : Radiographs
        Binned.
    bias : Motion or None
        What registration finds where nothing moved, once it is known.
    """

    stream: Stream
    scan: Scan
    grid: VolumeGrid
    solver: Solver
    factor: int
    radiographs: Radiographs = field(init=False)
    bias: Motion | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        # 1, 7: down-sample the measured radiographs
        self.radiographs = Radiographs(self.stream, self.scan, self.factor)
        if self.factor > 1:
            self.grid = self.grid.binned(self.factor)

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

        def reconstructed(radiographs: Radiographs, doing: str) -> Volume:
            return ramp_fbp(
                self.stream,
                radiographs,
                geometry,
                self.grid,
                valid_views=valid_views,
                circle=self.solver.circle,
                stage=f"{title}: {doing}",
            )

        def registered(radiographs: Radiographs, volume: Volume, doing: str) -> Registered:
            return reproject_and_register(
                self.stream,
                radiographs,
                volume,
                geometry,
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

        def projected(volume: Volume, lacking_of: Radiographs | None = None) -> Radiographs:
            return reprojections(
                self.stream,
                volume,
                geometry,
                self.factor,
                f"{title}: simulating",
                lacking_of=lacking_of,
            )

        # 2: reconstruct from the corrected radiographs
        volume = reconstructed(self.radiographs, "reconstructing")
        # 3, 4: simulate and register
        found = registered(self.radiographs, volume, "registering")
        if measure and self.bias is None and self.solver.is_biased(geometry.shape):
            if self.solver.is_blurred(geometry.shape):
                volume = reconstructed(projected(volume, self.radiographs), "sharpening")
            still = projected(volume)
            del volume
            volume = reconstructed(still, "reconstructing what is simulated")
            self.bias = registered(still, volume, "registering what is simulated").motion
        if self.bias is None:
            return found
        return replace(found, motion=self.bias.inverse().then(found.motion))


def reprojections(
    stream: Stream,
    volume: Volume,
    geometry: ConeBeamGeometry,
    level: int,
    stage: str,
    *,
    lacking_of: Radiographs | None = None,
) -> Radiographs:
    """Return the re-projections ``A x`` of a volume x, kept like binned radiographs.

    Off circles, and far from their plane, ramp-filtered back-projection B is no inverse of the
    projection A, and re-projections ``A B p`` of radiographs p are displaced by its artefacts: by
    0.3 pixel in v for a helix whose views look 34 degrees up and down. How far depends on what the
    sample looks like, and x looks like it. Its re-projections fit each other and their geometry
    exactly: whatever a registration finds of them against their own ``A B A x`` is displacement.

    The more x is blurred, the less it looks like the sample. A volume from ``p + (p - A x)`` is
    sharper: ``x + B (p - A x)``, two terms of the Neumann series for the inverse.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    volume : Volume
        Attenuation [1/mm].
    geometry : ConeBeamGeometry
        Of the radiographs, with the motion absorbed.
    level : int
        Binning factor that they shall count as.
    stage : str
        What progress reports call this.
    lacking_of : Radiographs, optional
        Return these and what they have beyond the re-projections instead.
    """
    project = SlabProjector(stream, volume, geometry)
    kept = Store((geometry.views, *geometry.shape), stream.room)
    radiographs = Radiographs.of(kept, level)
    for views in stream.chunks(geometry.views, radiographs.view_bytes):
        stream.report(stage, views.start, geometry.views)
        projected = stream.empty((views.stop - views.start, *geometry.shape))
        project(projected, views)
        part = stream.download(projected)
        kept.write(views.start, part if lacking_of is None else 2 * lacking_of.read(views) - part)
    stream.report(stage, geometry.views, geometry.views)
    return radiographs
