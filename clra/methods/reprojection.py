"""Re-projection: simulate each radiograph from the volume and register the measured one with it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion
from clra.ops.registration import ESTIMATE_FIELDS, Registration
from clra.ops.slabs import SlabProjector
from clra.ops.streaming import Radiographs, Stream, Volume

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Registered:
    """What registration found, a value a view; lengths in pixels of the full-resolution panel.

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


def reproject_and_register(
    stream: Stream,
    radiographs: Radiographs,
    volume: Volume,
    geometry: ConeBeamGeometry,
    registration: Registration,
    *,
    magnification: Floats,
    lost: tuple[int, int],
    stage: str = "registering",
) -> Registered:
    """Run steps 3 and 4 of Algorithm 1.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    radiographs : Radiographs
        Measured line integrals at the resolution of `geometry`.
    volume : Volume
        Reconstruction.
    geometry : ConeBeamGeometry
        Of the radiographs, with the motion known so far absorbed: what is found comes on top.
    registration : Registration
        Estimator for radiographs of this size.
    magnification : ndarray, (views,)
        That `geometry` has absorbed; the registration may expect it to be close to 1.
    lost : (int, int)
        Rows and columns of the full-resolution panel that binning dropped: the magnification is
        about the binned panel's centre, which lies half of that away.
    stage : str
        What progress reports call this.

    Returns
    -------
    Registered
    """
    project = SlabProjector(stream, volume, geometry)
    views, rows, columns = radiographs.shape
    table = np.empty((views, len(ESTIMATE_FIELDS)))
    for chunk in stream.chunks(views, radiographs.view_bytes):
        stream.report(stage, chunk.start, views)
        measured = stream.upload(radiographs.read(chunk))
        simulated = stream.empty((chunk.stop - chunk.start, rows, columns))
        projected = project(simulated, chunk)
        estimates = stream.empty((chunk.stop - chunk.start, len(ESTIMATE_FIELDS)))
        known = stream.upload(np.log(magnification[chunk]).astype(np.float32))
        registration(
            stream.queue, estimates, measured, simulated, known, wait_for=[projected]
        ).wait()
        table[chunk] = stream.download(estimates)
    stream.report(stage, views, views)
    return _in_full_pixels(table, radiographs.level, lost)


def _in_full_pixels(table: Floats, level: int, lost: tuple[int, int]) -> Registered:
    column = {name: table[:, index] for index, name in enumerate(ESTIMATE_FIELDS)}
    magnification = column["magnification"]
    aside_u, aside_v = (0.5 * (1 - magnification) * n for n in (lost[1], lost[0]))
    return Registered(
        motion=Motion(
            shift_u=level * column["shift_u"] - aside_u,
            shift_v=level * column["shift_v"] - aside_v,
            magnification=magnification,
        ),
        correlation=column["correlation"],
        residual=column["residual"],
        sigma=np.stack(
            [level * column["sigma_u"], level * column["sigma_v"], column["sigma_m"]], axis=1
        ),
    )
