"""Ramp-filtered back-projection, corrected by what its re-projections lack."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.methods.fbp import ramp_fbp
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.scan import Scan
from clra.ops.slabs import SlabProjector
from clra.ops.streaming import Radiographs, Stream, Volume


def refined_fbp(
    stream: Stream,
    radiographs: Radiographs,
    geometry: ConeBeamGeometry,
    grid: VolumeGrid,
    *,
    believed: NDArray[np.bool_],
    stage: str,
) -> Volume:
    """Reconstruct by ramp-filtered back-projection B and one correction: ``x + B (p - A x)``.

    With ``x = B p`` and the projection A. Off circles, and far from their plane, B is no inverse
    of A, and re-projections of x are displaced by its artefacts: by 0.3 pixel in v for a helix
    whose views look 34 degrees up and down. The correction, the second term of the Neumann series
    for the inverse, leaves 0.13 of that; two of them leave 0.09, four 0.05.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    radiographs : Radiographs
        Line integrals at the resolution of `geometry`.
    geometry : ConeBeamGeometry
        Of those radiographs, with the motion absorbed.
    grid : VolumeGrid
        Where to reconstruct.
    believed : ndarray of bool, (views,)
        Views to reconstruct from, at least one.
    stage : str
        What progress reports call this.

    Returns
    -------
    Volume
        Attenuation [1/mm].
    """
    options: dict[str, Any] = {"believed": believed, "volumes": 2}
    volume = ramp_fbp(
        stream, radiographs, geometry, grid, stage=f"{stage}: reconstructing", **options
    )
    lacking = Scan(_Lacking(stream, radiographs, volume, geometry), geometry)
    correction = ramp_fbp(
        stream,
        Radiographs(stream, lacking, 1),
        geometry,
        grid,
        stage=f"{stage}: refining",
        **options,
    )
    for index in range(len(volume.planes)):
        volume.put(index, volume.get(index) + correction.get(index))
    return volume


class _Lacking:
    """Line integrals (views, rows, columns) without a volume's, made as they are read."""

    def __init__(
        self, stream: Stream, radiographs: Radiographs, volume: Volume, geometry: ConeBeamGeometry
    ) -> None:
        self.shape = radiographs.shape
        self._stream = stream
        self._radiographs = radiographs
        self._project = SlabProjector(stream, volume, geometry)

    def __getitem__(self, views: slice) -> NDArray[Any]:
        start, stop, _ = views.indices(self.shape[0])
        projected = self._stream.empty((stop - start, *self.shape[1:]))
        self._project(projected, slice(start, stop))
        simulated = self._stream.download(projected)
        return np.subtract(self._radiographs.read(slice(start, stop)), simulated, out=simulated)
