"""Ordered-subset reconstruction from transmission data with Poisson noise (OSEM-TR)."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.methods.ordered_subsets.passes import StepRule, raise_likelihood
from clra.methods.ordered_subsets.subset_rays import VOLUMES, SubsetRays
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.subsets import Views, ordered_subsets
from clra.model.validation import whole
from clra.ops.statistics.poisson import RayStatistics
from clra.ops.streaming.multigrid import add_update
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.slab_projector import (
    ConstantVolume,
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

FLOOR = 0.02
"""Added to what the multiplicative form starts from, as what is 0 stays 0: a part of the mean."""


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

    @property
    def needs_mean(self) -> bool:
        """Whether the volume to start from takes the mean attenuation."""
        if not isinstance(self.initial, str):
            return False
        return self.initial == "uniform" or self.update == "multiplicative"

    def share_out(
        self, geometry: ConeBeamGeometry, grid: VolumeGrid, valid_views: NDArray[np.bool_] | None
    ) -> list[Views]:
        """Return the valid views of each subset, in the order of their use."""
        chosen = np.ones(geometry.views, np.bool_) if valid_views is None else valid_views
        views = np.flatnonzero(chosen)
        return [views[part] for part in ordered_subsets(geometry.subset(views), grid, self.subsets)]

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
    after_pass: Callable[[int, Volume], None] | None = None,
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
        Called with the number of each pass that is finished, and the volume.

    Returns
    -------
    list of float
        Misfit of each pass: mean Poisson deviance of a ray, as each subset met the volume.
    """
    subsets = options.share_out(geometry, volume.grid, valid_views)
    rule = StepRule(options.update, len(subsets))
    statistics = options.statistics(stream, used, radiographs.level)
    work = _InOneProcess(stream, radiographs, subsets, geometry, volume, rule, statistics)
    keep = None if after_pass is None else lambda number: after_pass(number, volume)
    return raise_likelihood(work, rule, options.passes, stage=stage, done=done, after_pass=keep)


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

    def constant(value: float) -> Volume:
        return constant_volume(stream, grid, value, volumes=VOLUMES)

    if not isinstance(options.initial, str):
        volume = volume_from(stream, grid, options.initial, volumes=VOLUMES)
        add_update(stream, volume, constant(0.0))
        return volume
    mean = 0.0
    if options.needs_mean:
        mean = mean_attenuation([ray_sums(stream, radiographs, geometry, grid)])
    if options.initial == "uniform":
        return constant(mean)
    volume = ramp_fbp(
        stream,
        radiographs,
        geometry,
        grid,
        valid_views=valid_views,
        positive=True,
        volumes=VOLUMES,
    )
    if options.needs_mean:
        add_update(stream, volume, constant(FLOOR * mean))
    return volume


def ray_sums(
    stream: Stream, radiographs: Radiographs, geometry: ConeBeamGeometry, grid: VolumeGrid
) -> tuple[float, float]:
    """Sum up the line integrals of rays that meet a grid, and the lengths of these within it [mm].

    Parameters are as for :func:`start_volume`.
    """
    project = SlabProjector(stream, ConstantVolume(stream, grid, 1.0, volumes=VOLUMES), geometry)
    integrals = lengths = 0.0
    for views in stream.chunks(geometry.views, radiographs.view_bytes):
        lengths_of = stream.empty((views.stop - views.start, *geometry.shape))
        project(lengths_of, views)
        chords = stream.download(lengths_of)
        integrals += float(radiographs.read(views)[chords > 0].sum(dtype=np.float64))
        lengths += float(chords.sum(dtype=np.float64))
    return integrals, lengths


def mean_attenuation(sums: Iterable[tuple[float, float]]) -> float:
    """Return all line integrals over all lengths [1/mm], as :func:`ray_sums` gives them."""
    integrals, lengths = np.sum(list(sums), axis=0)
    return max(float(integrals / lengths), 0.0) if lengths else 0.0


class _InOneProcess:
    """The work of :func:`clra.methods.ordered_subsets.passes.raise_likelihood`."""

    def __init__(
        self,
        stream: Stream,
        radiographs: Radiographs,
        subsets: list[Views],
        geometry: ConeBeamGeometry,
        volume: Volume,
        rule: StepRule,
        statistics: RayStatistics,
    ) -> None:
        order = np.concatenate(subsets)
        ordered = geometry.subset(order)
        self._stream, self._volume, self._rule = stream, volume, rule
        self._statistics = statistics
        self._rays = SubsetRays(stream, radiographs, order, ordered, volume.grid, statistics)
        ends = np.cumsum([len(subset) for subset in subsets]).tolist()
        self._runs = [self._rays.runs(start, stop) for start, stop in pairwise([0, *ends])]
        self._project = SlabProjector(stream, volume, ordered)
        self._adjoint = SlabAdjoint(stream, volume, ordered)
        self._views, self._seen = len(order), 0
        self._denominator, self._largest = volume, 0.0

    @property
    def subsets(self) -> int:
        return len(self._runs)

    def weigh(self, stage: str) -> None:
        stream, total = self._stream, self._zeros()
        for run in self._rays.runs(0, self._views):
            stream.report(stage, run.start, self._views)
            self._adjoint(total, self._rays.weighted(run), run)
            stream.queue.finish()
        stream.report(stage, self._views, self._views)
        self._rays.release()
        self._denominator, self._largest = total, _largest(stream, total)

    def update(self, subset: int, stage: str) -> None:
        stream, rule = self._stream, self._rule
        numerator = self._zeros()
        denominator = self._denominator if rule.precomputed else self._zeros()
        for run in self._runs[subset]:
            stream.report(stage, self._seen, self._views)
            simulated = self._rays.projected(self._project, run)
            above, below = self._rays.compared(simulated, run, rule.update)
            self._adjoint(numerator, above, run)
            if below is not None:
                self._adjoint(denominator, below, run)
            stream.queue.finish()
            self._seen += run.stop - run.start
        largest = self._largest if rule.precomputed else _largest(stream, denominator)
        for index in range(len(self._volume.planes)):
            mu = writable(stream, self._volume, index)
            rule(stream, mu, numerator.get(index), denominator.get(index), largest)
            self._volume.put(index, mu)
        stream.report(stage, self._seen, self._views)

    def misfit(self) -> float:
        self._seen = 0
        return self._statistics.misfit(self._stream.queue, self._views)

    def _zeros(self) -> Volume:
        return constant_volume(self._stream, self._volume.grid, volumes=VOLUMES)


def _largest(stream: Stream, volume: Volume) -> float:
    """Largest value of a volume."""
    parts = (volume.get(index) for index in range(len(volume.planes)))
    return max(float(stream.download(part).max()) for part in parts)
