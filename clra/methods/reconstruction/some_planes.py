"""Some planes of a volume by filtered back-projection or Katsevich's method: a task."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clra.methods.correction import corrected
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.methods.reconstruction.katsevich import Exact, katsevich
from clra.methods.reconstruction.missing_views import without_gaps
from clra.model.grid import VolumeGrid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import PlaneWriter


@dataclass(frozen=True)
class SomePlanes:
    """Reconstructs some planes of a volume: by Katsevich's method if helices are given.

    Parameters
    ----------
    scan : Scan
        Radiographs, prepared.
    grid : VolumeGrid
        Of the whole volume.
    motion : Motion or None
        Of the radiographs.
    valid_views : ndarray of bool, (views,), or None
        Views to reconstruct from.
    fitted : optional
        What :func:`clra.methods.reconstruction.katsevich.exact_helices` found.
    window : str
        Of the ramp filter.
    """

    scan: Scan
    grid: VolumeGrid
    motion: Motion | None
    valid_views: NDArray[np.bool_] | None
    fitted: Exact | None
    window: str

    def __call__(self, stream: Stream, planes: slice, target: PlaneWriter) -> None:
        """Reconstruct planes of the grid; `target` counts them from the first of these."""
        scan, motion = self.scan, self.motion
        if self.fitted is not None:
            ideal = scan if motion is None else corrected(stream, scan, motion)
            whole = without_gaps(ideal, self.valid_views)
            radiographs = Radiographs(stream, whole, 1)
            part = self.grid.slab(planes.start, planes.stop)
            katsevich(stream, radiographs, whole.geometry, part, fitted=self.fitted, target=target)
        else:
            geometry = scan.geometry if motion is None else scan.geometry.with_motion(motion)
            radiographs = Radiographs(stream, scan, 1)
            ramp_fbp(
                stream,
                radiographs,
                geometry,
                self.grid,
                valid_views=self.valid_views,
                window=self.window,
                planes=planes,
                target=target,
            )
