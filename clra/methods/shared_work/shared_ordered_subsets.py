"""OSEM-TR whose work is shared out to several workers."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.methods.ordered_subsets.passes import StepRule, raise_likelihood
from clra.methods.ordered_subsets.subset_rays import VOLUMES
from clra.methods.reconstruction.osem_tr import FLOOR, OrderedSubsets, mean_attenuation
from clra.methods.shared_work.shared_scan import SharedRadiographs, SharedScan, view_chunks
from clra.methods.shared_work.subset_tasks import (
    BackProjectSlab,
    CompareViews,
    Likelihood,
    RaiseSlab,
    StepSlab,
    SubsetViews,
    SumRays,
    WeighViews,
)
from clra.methods.shared_work.tasks import ReconstructSlab
from clra.methods.truncation import extension
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.subsets import Views, ordered_subsets
from clra.ops.streaming.part_files import RadiographParts, VolumeParts
from clra.ops.streaming.stream import Stream


def shared_start_volume(
    shared: SharedScan,
    stream: Stream,
    radiographs: SharedRadiographs,
    geometry: ConeBeamGeometry,
    grid: VolumeGrid,
    options: OrderedSubsets,
    *,
    valid_views: NDArray[np.bool_] | None = None,
) -> VolumeParts:
    """Make what :func:`clra.methods.reconstruction.osem_tr.start_volume` does, in files.

    Parameters
    ----------
    shared : SharedScan
        The scan, and who does the work.
    stream : Stream
        Of the caller, who reads a few radiographs.
    radiographs : SharedRadiographs
        Of the scan at some resolution.
    geometry, grid, options, valid_views
        As there; a volume to start from that is mapped is not read as a whole.

    Raises
    ------
    InputError
        As there.
    """
    ordered_subsets(geometry, grid, options.subsets)  # refuses a wrong number before the long work
    if not isinstance(options.initial, str):
        return _written(shared, grid, options.initial)
    mean = 0.0
    if options.needs_mean:
        sums = SumRays(radiographs.measured, geometry, grid)
        found = shared.workers.map(sums, shared.chunks, stage="measuring the mean attenuation")
        mean = mean_attenuation(found)
    if options.initial == "uniform":
        return _written(shared, grid, np.broadcast_to(np.float32(mean), grid.shape))
    chosen = np.ones(geometry.views, np.bool_) if valid_views is None else valid_views
    volume = shared.volume_parts(grid, VOLUMES)
    slabs = range(len(volume.planes))
    fbp: dict[str, Any] = {
        "valid_views": chosen,
        "positive": True,
        "extend": extension(radiographs, geometry, chosen),
        "volumes": VOLUMES,
    }
    task = ReconstructSlab(radiographs.measured, geometry, volume, fbp)
    shared.workers.map(task, slabs, stage="back-projecting")
    if not options.needs_mean:
        return volume
    raised = shared.like(volume)
    shared.workers.map(RaiseSlab(volume, raised, FLOOR * mean), slabs, stage="raising voxels of 0")
    return raised


def shared_osem_tr(
    shared: SharedScan,
    stream: Stream,
    radiographs: SharedRadiographs,
    geometry: ConeBeamGeometry,
    volume: VolumeParts,
    options: OrderedSubsets,
    *,
    used: NDArray[np.bool_],
    valid_views: NDArray[np.bool_] | None = None,
    stage: str = "OSEM-TR",
    done: int = 0,
    after_pass: Callable[[int, VolumeParts], None] | None = None,
) -> tuple[VolumeParts, list[float]]:
    """Raise the likelihood of a volume as :func:`clra.methods.reconstruction.osem_tr.osem_tr` does.

    Parameters
    ----------
    shared, stream, radiographs
        As for :func:`shared_start_volume`.
    volume : VolumeParts
        To start from, in slabs of which a device holds `VOLUMES`; left as it is.
    geometry, options, used, valid_views, stage, done, after_pass
        As there.

    Returns
    -------
    volume : VolumeParts
        In files of its own, in the same slabs.
    misfits : list of float
        Of each pass.
    """
    subsets = options.share_out(geometry, volume.grid, valid_views)
    rule = StepRule(options.update, len(subsets))
    # What it starts from is a volume that must not travel.
    likelihood = shared.workers.share(Likelihood(replace(options, initial="uniform"), used))

    def views_of(order: Views) -> SubsetViews:
        ordered = geometry.subset(order)
        return SubsetViews(likelihood, radiographs.measured, order, ordered, volume.grid)

    parts, whole = [views_of(order) for order in subsets], views_of(np.concatenate(subsets))
    work = _SharedWork(shared, parts, whole, volume, rule)
    keep = None if after_pass is None else lambda number: after_pass(number, work.volume)
    misfits = raise_likelihood(work, rule, options.passes, stage=stage, done=done, after_pass=keep)
    return work.volume, misfits


class _SharedWork:
    """The work of :func:`clra.methods.ordered_subsets.passes.raise_likelihood`."""

    def __init__(
        self,
        shared: SharedScan,
        parts: list[SubsetViews],
        whole: SubsetViews,
        volume: VolumeParts,
        rule: StepRule,
    ) -> None:
        self.volume = volume
        self._shared, self._parts, self._whole, self._rule = shared, parts, whole, rule
        self._slabs = range(len(volume.planes))
        self._denominator, self._largest = volume, 0.0
        self._deviance = 0.0

    @property
    def subsets(self) -> int:
        return len(self._parts)

    def weigh(self, stage: str) -> None:
        views = self._whole
        chunks = view_chunks(self._shared.workers.places, len(views.order))
        images = self._shared.radiograph_parts("weighted", views.measured.level, chunks)
        self._shared.workers.map(WeighViews(views, images), chunks, stage=stage, part=(0, 2))
        self._denominator, self._largest = self._back_projected(images, views, stage, (1, 2))

    def update(self, subset: int, stage: str) -> None:
        views, rule, workers = self._parts[subset], self._rule, self._shared.workers
        level = views.measured.level
        steps = 2 if rule.precomputed else 3
        first, count = steps * subset, steps * self.subsets
        # As few tasks as there are workers: each reads the slabs that its views see.
        chunks = view_chunks(workers.places, len(views.order), each=1)
        above, below = self._shared.radiograph_parts("numerator", level, chunks), None
        if not rule.precomputed:
            below = self._shared.radiograph_parts("denominator", level, chunks)
        compare = CompareViews(views, self.volume, above, below)
        for deviance in workers.map(compare, chunks, stage=stage, part=(first, count)):
            self._deviance += deviance
        if below is not None:
            self._denominator, self._largest = self._back_projected(
                below, views, stage, (first + 1, count)
            )
        target = self._shared.like(self.volume)
        step = StepSlab(
            self.volume,
            above,
            views.geometry,
            self._denominator,
            self._largest,
            rule,
            target,
        )
        workers.map(step, self._slabs, stage=stage, part=(first + steps - 1, count))
        self.volume = target

    def misfit(self) -> float:
        mean, self._deviance = self._deviance / len(self._whole.order), 0.0
        return mean

    def _back_projected(
        self, images: RadiographParts, views: SubsetViews, stage: str, part: tuple[int, int]
    ) -> tuple[VolumeParts, float]:
        """Back-project into files; their largest value."""
        target = self._shared.like(self.volume)
        task = BackProjectSlab(images, views.geometry, target)
        return target, max(self._shared.workers.map(task, self._slabs, stage=stage, part=part))


def _written(shared: SharedScan, grid: VolumeGrid, values: NDArray[Any]) -> VolumeParts:
    """Write a volume (z, y, x) that the caller has, where it is not negative, into files."""
    if tuple(values.shape) != grid.shape:
        raise InputError(f"volume: found shape {tuple(values.shape)}, expected {grid.shape}")
    volume = shared.volume_parts(grid, VOLUMES)
    for index in range(len(volume.planes)):
        volume.write_planes(index, values)
    return volume
