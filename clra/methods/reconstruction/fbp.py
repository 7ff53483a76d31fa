"""Ramp-filtered back-projection for any trajectory, streamed."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clra.methods.alignment.rejected_views import neighbour_weights
from clra.methods.truncation import extension
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.sampling.angular_coverage import angle_weights
from clra.model.sampling.ray_weights import ray_weights
from clra.model.view_selection import rows_that_see, runs, together, views_that_see
from clra.ops.filtering.ramp import FADE, RampFilter, taper
from clra.ops.projection.coverage import Coverage, around
from clra.ops.projection.projector import BackProjector
from clra.ops.streaming.multigrid import add_to_slab
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import PlaneWriter, Volume

# Width of the detector, in detectors, by whose views voxels beside the field of view of a truncated
# sample are divided: by those alone that show them they would come out too strong, and corrections
# overshoot. A sample 1.2 times as wide as the field ended at 0.58 pixel in u instead of 0.24.
_WIDE = 3


def ramp_fbp(
    stream: Stream,
    radiographs: Radiographs,
    geometry: ConeBeamGeometry,
    grid: VolumeGrid,
    *,
    valid_views: NDArray[np.bool_] | None = None,
    stage: str = "back-projecting",
    volumes: int = 1,
    circle: bool = True,
    positive: bool = False,
    window: str = "ram-lak",
    extend: float | None = None,
    beside: bool = False,
    planes: slice | None = None,
    target: PlaneWriter | None = None,
    onto: Volume | None = None,
    step: float = 1.0,
) -> Volume:
    """Reconstruct by ramp-filtered back-projection.

    ``f(x) = pi / W(x) sum_i w_i(x) (SOD / U_i(x))^2 q_i(x)``: q_i is the cosine-weighted,
    ramp-filtered radiograph, U_i the depth of x below the source, w_i the weight of the row that x
    falls on, and W = sum_i w_i the number of views that see x. For circles this is FDK [1]_: views
    that do not stand evenly have the weight of the angle that each stands for, and redundant rays
    of short scans and offset detectors those of
    :class:`clra.model.sampling.ray_weights.RayWeights`. Elsewhere
    intensities are a few per cent off, and edges are where they belong.

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
    valid_views : ndarray of bool, (views,), optional
        Views to reconstruct from, at least one; all by default. The weight of the others goes to
        those beside them, see :func:`clra.methods.alignment.rejected_views.neighbour_weights`.
    stage : str
        What progress reports call this.
    volumes : int
        How many volumes like this one the device has to hold at a time.
    circle : bool
        Leave zero what lies outside the circle that all views see.
    positive : bool
        Raise negative attenuations to zero.
    window : {"ram-lak", "shepp-logan", "hann"}
        Of the ramp filter.
    extend : float, optional
        Part of the columns by which rows are continued past the detector; by default as far as the
        sample seems to reach, see :func:`clra.methods.truncation.extension`.
    beside : bool
        Divide voxels beside the field of view by all views that would show them on a wider
        detector.
    planes : slice, optional
        Planes of the grid that are wanted, all by default; the volume is then on their grid.
    target : PlaneWriter, optional
        Takes the planes of each slab as soon as it is done; the volume is then not kept.
    onto : Volume, optional
        On the grid of the planes: changed to ``max(0, onto + step * what is reconstructed)`` and
        returned. `positive` and `target` do not go with it.
    step : float
        Of what is added to `onto`.

    Returns
    -------
    Volume
        Attenuation [1/mm]; without its slabs if they went to `target`.

    References
    ----------
    .. [1] L. A. Feldkamp, L. C. Davis, J. W. Kress, "Practical cone-beam algorithm", J. Opt. Soc.
       Am. A 1, 612 (1984).
    """
    context, queue = stream.context, stream.queue
    row_weight = taper(geometry.rows, FADE)
    memory: dict[str, Any] = {"allocator": stream.memory, "scratch_limit": stream.scratch_limit}
    chosen = np.ones(geometry.views, np.bool_) if valid_views is None else valid_views
    weight = neighbour_weights(geometry.source, chosen) * angle_weights(geometry)
    rays = ray_weights(geometry)
    scale = math.pi if rays is None else rays.covered / float(weight.sum())
    ramp = RampFilter(
        context,
        geometry,
        row_weight=row_weight,
        view_weight=weight,
        ray_weights=rays,
        window=window,
        extend=extension(radiographs, geometry, chosen) if extend is None else extend,
        **memory,
    )
    filtered_bytes = 4 * math.prod(ramp.geometry.shape)
    wanted = slice(0, grid.shape[0]) if planes is None else planes
    near = around(wanted, grid.shape[0])
    counted = geometry.subset(chosen)
    if beside and rays is None:
        counted = replace(counted, shape=(geometry.rows, _WIDE * geometry.columns))
    coverage = Coverage(
        context,
        counted,
        grid.slab(near.start, near.stop),
        row_weight,
        view_weight=weight[chosen],
        ray_weights=None if rays is None else rays.subset(chosen),
        circle=circle,
        allocator=stream.memory,
    )
    coverage.compute(queue)
    volume = onto or Volume(stream, grid.slab(wanted.start, wanted.stop), volumes=volumes)
    slabs = volume.slabs
    seeing = [chosen & views_that_see(geometry, slab) for slab in slabs]
    total, done = sum(int(views.sum()) for views in seeing), 0
    for index, slab in enumerate(slabs):
        nz, ny, nx = slab.shape
        attenuation = stream.empty((ny, nx, nz))
        attenuation.fill(np.float32(0), queue=queue)
        back = BackProjector(context, ramp.geometry, slab, volume_order="yxz", **memory)
        busy: list[tuple[cl.Event, tuple[Any, ...]]] = []
        needed = rows_that_see(geometry, slab, coverage.radius)
        for run in runs(seeing[index]):
            for views, rows in _pieces(stream, radiographs, run, needed, filtered_bytes):
                stream.report(stage, done, total)
                measured = radiographs.on_device(stream, views, rows)
                filtered = stream.empty((len(measured), *ramp.geometry.shape))
                ready = ramp(queue, filtered, measured, views=views, rows=rows)
                event = back(
                    queue, attenuation, filtered, views=views, accumulate=True, wait_for=[ready]
                )
                # One chunk is read while another is worked on; none may be let go before.
                busy.append((event, (measured, filtered)))
                if len(busy) > 1:
                    busy[0][0].wait()
                    del busy[0]
                del measured, filtered
                done += views.stop - views.start
        first = wanted.start - near.start + volume.planes[index].start
        lowest = 0.0 if positive else -math.inf
        coverage.normalise(
            queue, attenuation, scale, first=first, lowest=lowest, volume_order="yxz"
        )
        if onto is not None:
            add_to_slab(stream, onto, index, attenuation, step)
        elif target is None:
            volume.put(index, attenuation)
        else:
            volume.write_slab(index, attenuation, target)
        del attenuation  # before the next slab is made
        queue.finish()
    stream.report(stage, total, total)
    return volume


def _pieces(
    stream: Stream,
    radiographs: Radiographs,
    run: slice,
    needed: NDArray[np.int_],
    view_bytes: int,
) -> Iterator[tuple[slice, slice | None]]:
    """Cut a run of views into what fits the device and needs the same rows; None for all rows."""
    for chunk in stream.chunks(run.stop - run.start, view_bytes):
        start, stop = run.start + chunk.start, run.start + chunk.stop
        if radiographs.stay_on(stream):
            yield slice(start, stop), None
            continue
        for views, rows in together(needed[start:stop], radiographs.shape[1]):
            yield slice(start + views.start, start + views.stop), rows
