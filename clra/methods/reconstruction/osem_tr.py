"""Ordered-subset reconstruction from transmission data with Poisson noise (OSEM-TR)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyopencl.array import Array

from clra.errors import InputError
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.subsets import ordered_subsets
from clra.model.validation import whole
from clra.ops.statistics.poisson import RayStatistics, VolumeStep
from clra.ops.streaming.multigrid import add_update
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.slab_projector import (
    SlabAdjoint,
    SlabProjector,
    constant_volume,
    volume_from,
    writable,
)
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import Volume

UPDATES = ("paraboloid", "optimal", "multiplicative")
INITIAL = ("fbp", "uniform")

# Volume, numerator, denominator, and one of ones: all on the device, or all in slabs.
VOLUMES = 4
# A voxel whose denominator is below this part of the largest is hardly met by rays.
_LEAST = 1e-4
# Steps are this much longer than the paraboloids ask for. Anything below 2 still raises the
# likelihood; 1.5 saves a pass in three, 1.9 gathers more noise.
_RELAXATION = 1.5
# What voxels start from in the multiplicative form, where they would be 0: a part of the mean.
_FLOOR = 0.02


@dataclass(frozen=True, kw_only=True)
class OrderedSubsets:
    """How OSEM-TR goes about it.

    Parameters
    ----------
    subsets : int, optional
        Number of subsets, any up to that of the views; by default as many as leave each subset
        enough views of each voxel (:func:`clra.model.subsets.ordered_subsets`).
    passes : int
        How often all views are used. Noise grows with it.
    update : {"paraboloid", "optimal", "multiplicative"}
        Separable paraboloids with precomputed curvatures [1]_; with the curvatures that are optimal
        at each step, for which one subset never lowers the likelihood, at the cost of two more
        projections; or the multiplicative form of the EM algorithm's descendants [2]_, quick at
        first and not convergent.
    initial : {"fbp", "uniform"} or ndarray, (nz, ny, nx)
        Volume to start from: ramp-filtered back-projection, the mean attenuation, or this one.
    i0 : float
        Photons a pixel of the open beam. It only weighs rays against the background.
    background : float
        Photons a pixel that did not pass the sample straight (scatter, dark counts), contained in
        the measured radiographs.

    Raises
    ------
    InputError
        If an option is none of the above.

    References
    ----------
    .. [1] H. Erdogan, J. A. Fessler, "Ordered subsets algorithms for transmission tomography",
       Phys. Med. Biol. 44, 2835 (1999).
    .. [2] K. Lange, M. Bahn, R. Little, "A theoretical study of some maximum likelihood algorithms
       for emission and transmission tomography", IEEE Trans. Med. Imaging 6, 106 (1987).
    """

    subsets: int | None = None
    passes: int = 3
    update: str = "paraboloid"
    initial: str | NDArray[Any] = "fbp"
    i0: float = 1e4
    background: float = 0.0

    def __post_init__(self) -> None:
        whole("passes", self.passes)
        if self.subsets is not None:
            whole("subsets", self.subsets)
        if self.update not in UPDATES:
            raise InputError(f"update: found {self.update!r}, expected one of {UPDATES}")
        if isinstance(self.initial, str) and self.initial not in INITIAL:
            raise InputError(
                f"initial: found {self.initial!r}, expected one of {INITIAL} or a volume"
            )
        if not 0 < self.i0 < np.inf:
            raise InputError(f"i0: found {self.i0:g}, expected photons, more than 0")
        if not 0 <= self.background < np.inf:
            raise InputError(f"background: found {self.background:g}, expected photons, 0 or more")

    def statistics(self, stream: Stream, used: NDArray[np.bool_], level: int) -> RayStatistics:
        """Photon statistics of radiographs binned by `level`, whose `used` pixels count."""
        return RayStatistics(stream.context, self.i0 * level**2 * used, self.background * level**2)


def osem_tr(
    stream: Stream,
    radiographs: Radiographs,
    geometry: ConeBeamGeometry,
    volume: Volume,
    options: OrderedSubsets,
    *,
    used: NDArray[np.bool_],
    valid_views: NDArray[np.bool_] | None = None,
    stage: str = "OSEM-TR",
    done: int = 0,
    after_pass: Callable[[int], None] | None = None,
) -> list[float]:
    """Raise the likelihood of a volume, one subset of the views after the other.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    radiographs : Radiographs
        Measured line integrals at the resolution of `geometry`.
    geometry : ConeBeamGeometry
        Of those radiographs, with the motion absorbed.
    volume : Volume
        To start from [1/mm], not negative; changed.
    options : OrderedSubsets
        How to go about it; `initial` is `volume`.
    used : ndarray of bool, (rows, columns)
        Pixels of the detector that count.
    valid_views : ndarray of bool, (views,), optional
        Views to reconstruct from, at least one; all by default.
    stage : str
        What progress reports call this.
    done : int
        Passes that `volume` has had already.
    after_pass : callable, optional
        Called with the number of each pass that is finished.

    Returns
    -------
    list of float
        Misfit of each pass: mean Poisson deviance of a ray, as each subset met the volume.
    """
    chosen = np.ones(geometry.views, np.bool_) if valid_views is None else valid_views
    rays = _Rays(stream, radiographs, geometry, volume, options, used, np.flatnonzero(chosen))
    step = VolumeStep(stream.context)
    precomputed = options.update == "paraboloid"
    if precomputed:
        # d = A' (a c): c are the curvatures at the measured counts, so that once is enough
        denominator = rays.curvature(f"{stage}: weighing rays")
        least = _LEAST * _largest(stream, denominator)
    misfits = []
    for number in range(done + 1, options.passes + 1):
        seen = 0
        for subset in rays.subsets:
            numerator = _zeros(stream, volume)
            if not precomputed:
                denominator = _zeros(stream, volume)
            for views in subset:
                # l = A mu, and A' of what the likelihood says of it
                stream.report(f"{stage}: pass {number}/{options.passes}", seen, rays.views)
                rays.add(numerator, None if precomputed else denominator, views)
                seen += views.stop - views.start
            if not precomputed:
                least = _LEAST * _largest(stream, denominator)
            # mu <- max(0, mu + subsets numerator / d), or mu <- mu numerator / denominator
            for index in range(len(volume.planes)):
                above, below = numerator.get(index), denominator.get(index)
                mu = writable(stream, volume, index)
                if options.update == "multiplicative":
                    step.multiply(stream.queue, mu, above, below)
                else:
                    scale = _RELAXATION * (len(rays.subsets) if precomputed else 1)
                    step.add(stream.queue, mu, above, below, scale, least)
                volume.put(index, mu)
                stream.queue.finish()
        misfits.append(rays.statistics.misfit(stream.queue, rays.views))
        stream.report(f"{stage}: pass {number}/{options.passes}", seen, rays.views)
        if after_pass is not None:
            after_pass(number)
    return misfits


def start_volume(
    stream: Stream,
    radiographs: Radiographs,
    geometry: ConeBeamGeometry,
    grid: VolumeGrid,
    options: OrderedSubsets,
    *,
    valid_views: NDArray[np.bool_] | None = None,
) -> Volume:
    """Make the volume that :func:`osem_tr` starts from, as the options say.

    Parameters are as for :func:`osem_tr`; `grid` is where to reconstruct.

    Raises
    ------
    InputError
        If a given volume is not of the grid's shape.
    """
    ordered_subsets(geometry, grid, options.subsets)  # refuses a wrong number before the long work
    volume = constant_volume(stream, grid, volumes=VOLUMES)
    if not isinstance(options.initial, str):
        given = volume_from(stream, grid, options.initial, volumes=VOLUMES)
    elif options.initial == "fbp":
        given = ramp_fbp(
            stream, radiographs, geometry, grid, valid_views=valid_views, volumes=VOLUMES
        )
    else:
        mean = _mean_attenuation(stream, radiographs, geometry, volume)
        given = constant_volume(stream, grid, mean, volumes=VOLUMES)
    add_update(stream, volume, given)
    ramp = isinstance(options.initial, str) and options.initial == "fbp"
    if ramp and options.update == "multiplicative":
        # What is 0 would stay 0.
        mean = _mean_attenuation(stream, radiographs, geometry, volume)
        floor = constant_volume(stream, grid, _FLOOR * mean, volumes=VOLUMES)
        add_update(stream, volume, floor)
    return volume


def _mean_attenuation(
    stream: Stream, radiographs: Radiographs, geometry: ConeBeamGeometry, volume: Volume
) -> float:
    """All line integrals over all lengths of rays within the volume [1/mm]."""
    project = SlabProjector(
        stream, constant_volume(stream, volume.grid, 1.0, volumes=VOLUMES), geometry
    )
    integrals = lengths = 0.0
    for views in stream.chunks(geometry.views, radiographs.view_bytes):
        lengths_of = stream.empty((views.stop - views.start, *geometry.shape))
        project(lengths_of, views)
        chords = stream.download(lengths_of)
        integrals += float(radiographs.read(views)[chords > 0].sum(dtype=np.float64))
        lengths += float(chords.sum(dtype=np.float64))
    return max(integrals / lengths, 0.0) if lengths else 0.0


def _zeros(stream: Stream, volume: Volume) -> Volume:
    return constant_volume(stream, volume.grid, volumes=VOLUMES)


class _Rays:
    """The views of a scan in the order of their subsets, with what is needed of each."""

    def __init__(
        self,
        stream: Stream,
        radiographs: Radiographs,
        geometry: ConeBeamGeometry,
        volume: Volume,
        options: OrderedSubsets,
        used: NDArray[np.bool_],
        views: NDArray[np.intp],
    ) -> None:
        self._stream, self._radiographs, self._options = stream, radiographs, options
        self._volume = volume
        chosen = ordered_subsets(geometry.subset(views), volume.grid, options.subsets)
        self._order = views[np.concatenate(chosen)]
        ends = np.cumsum([len(subset) for subset in chosen]).tolist()
        self.subsets = [
            self._runs(end - len(part), end) for part, end in zip(chosen, ends, strict=True)
        ]
        self._geometry = geometry.subset(self._order)
        self._forward = SlabProjector(stream, volume, self._geometry)
        self._adjoint = SlabAdjoint(stream, volume, self._geometry)
        self._chords: SlabProjector | None = None
        self.statistics = options.statistics(stream, used, radiographs.level)

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self._order)

    def _runs(self, start: int, stop: int) -> list[slice]:
        chunks = self._stream.chunks(stop - start, self._radiographs.view_bytes)
        return [slice(start + chunk.start, start + chunk.stop) for chunk in chunks]

    def curvature(self, stage: str) -> Volume:
        """Sum A' (a c), c the curvature of each measured ray, a its length within the volume."""
        stream, views = self._stream, len(self._order)
        total = _zeros(stream, self._volume)
        for run in self._runs(0, views):
            stream.report(stage, run.start, views)
            weighted, measured = self._lengths(run), self._measured(run)
            self.statistics.curvature(stream.queue, weighted, weighted, measured)
            self._adjoint(total, weighted, run)
            stream.queue.finish()
        stream.report(stage, views, views)
        self._chords = None
        return total

    def add(self, numerator: Volume, denominator: Volume | None, views: slice) -> None:
        """Add what some views say of the volume; a denominator only where it changes."""
        stream, statistics = self._stream, self.statistics
        measured, simulated = self._measured(views), self._integrals(self._forward, views)
        statistics.deviance(stream.queue, simulated, measured)
        if denominator is None:
            statistics.gradient(stream.queue, simulated, simulated, measured)
        elif self._options.update == "optimal":
            weighted = self._lengths(views)
            statistics.optimal_curvature(stream.queue, weighted, simulated, weighted, measured)
            self._adjoint(denominator, weighted, views)
            statistics.gradient(stream.queue, simulated, simulated, measured)
        else:
            found = stream.empty(simulated.shape)
            statistics.balance(stream.queue, simulated, found, measured)
            self._adjoint(denominator, found, views)
        self._adjoint(numerator, simulated, views)
        stream.queue.finish()

    def _measured(self, views: slice) -> Array:
        """Line integrals of some of the views, in their order here."""
        read, chosen = self._radiographs.read, self._order[views]
        return self._stream.upload(np.concatenate([read(slice(v, v + 1)) for v in chosen]))

    def _lengths(self, views: slice) -> Array:
        """Length of each ray within the volume [mm]."""
        if self._chords is None:
            ones = constant_volume(self._stream, self._volume.grid, 1.0, volumes=VOLUMES)
            self._chords = SlabProjector(self._stream, ones, self._geometry)
        return self._integrals(self._chords, views)

    def _integrals(self, projector: SlabProjector, views: slice) -> Array:
        integrals = self._stream.empty((views.stop - views.start, *self._geometry.shape))
        projector(integrals, views)
        return integrals


def _largest(stream: Stream, volume: Volume) -> float:
    """Largest value of a volume."""
    parts = (volume.get(index) for index in range(len(volume.planes)))
    return max(float(stream.download(part).max()) for part in parts)
