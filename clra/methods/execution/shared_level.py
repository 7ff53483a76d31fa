"""One resolution of an alignment, whose work is shared out to the workers of a cluster."""

import shutil
import weakref
from collections.abc import Callable, Iterator, MutableMapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from clra.methods.alignment.level import At, Level
from clra.methods.alignment.reprojection import Registered, in_full_pixels
from clra.methods.execution.checkpoint import Checkpoint
from clra.methods.execution.clusters import on_cluster
from clra.methods.execution.dask_cluster import DaskCluster
from clra.methods.execution.executor import PARTS, slabs_of
from clra.methods.execution.level_tasks import (
    Bin,
    Measured,
    ReconstructSlab,
    Register,
    Simulate,
    planned_volumes,
)
from clra.methods.execution.travelling import Shared
from clra.methods.truncation import extension
from clra.model.scan import Scan
from clra.ops.streaming.part_files import RadiographParts, VolumeParts
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import equal_runs
from clra.progress import ProgressCallback

# Views of a task at most: what a worker that is killed loses, and what one keeps on its host.
_MOST_VIEWS = 1024


@dataclass
class SharedLevel(Level):
    """A level whose radiographs and volumes are in files.

    Parameters
    ----------
    cluster : DaskCluster
        Who does the work; the gauge, acceleration and the stop rule stay with the caller.
    shared_scan : Shared
        The scan, for the workers.
    """

    cluster: DaskCluster = field(kw_only=True)
    shared_scan: Shared = field(kw_only=True)
    measured: MutableMapping[Radiographs, Measured] = field(
        init=False, default_factory=weakref.WeakKeyDictionary
    )

    def _binned(self) -> Radiographs:
        if self.factor == 1:
            radiographs = Radiographs(self.stream, self.scan, 1)
            self.measured[radiographs] = Measured(1, self.shared_scan)
            return radiographs
        target = self._parts("radiographs")
        task = Bin(self.shared_scan, target, self.factor)
        stage = f"reading radiographs, binned {self.factor} x {self.factor}"
        self.cluster.map(task, target.parts, stage=stage)
        return self._radiographs(target)

    def _reconstructed(self, at: At, radiographs: Radiographs, stage: str) -> VolumeParts:
        positive = self.solver.positive
        terms = self.terms if positive else 0
        planes = slabs_of(
            self.cluster.places,
            self.cluster.slab_bytes,
            self.grid.shape,
            planned_volumes(terms),
        )
        options: dict[str, Any] = {
            "geometry": at.geometry,
            "valid_views": at.valid_views,
            "circle": self.circle,
            "beside": self.region.truncated,
            "positive": positive,
            "extend": extension(radiographs, at.geometry, at.valid_views),
            "volumes": planned_volumes(terms),
        }
        volume = self._volume(planes)
        task = ReconstructSlab(self.measured[radiographs], target=volume, **options)
        slabs = range(len(planes))
        self.cluster.map(task, slabs, stage=f"{stage}: reconstructing")
        for _ in range(terms):
            lacking = self._parts("lacking")
            simulate = Simulate(
                volume, at.geometry, lacking, self.factor, self.measured[radiographs], self.used
            )
            self.cluster.map(simulate, lacking.parts, stage=f"{stage}: simulating")
            # A slab that is corrected is another file: a task that is done again finds the old one.
            corrected = self._volume(planes)
            source = Measured(self.factor, lacking)
            task = ReconstructSlab(source, target=corrected, onto=volume, **options)
            self.cluster.map(task, slabs, stage=f"{stage}: correcting")
            volume = corrected
        return volume

    def _registered(
        self, at: At, radiographs: Radiographs, volume: VolumeParts, stage: str
    ) -> Registered:
        task = Register(
            self.shared_scan,
            self.measured[radiographs],
            volume,
            at.geometry,
            self.solver,
            at.known,
            at.first,
            at.magnification,
            at.pulled,
        )
        tables = self.cluster.map(task, self._chunks, stage=stage)
        return in_full_pixels(np.concatenate(tables), self.factor, self.scan.geometry.shape)

    def _simulated(self, at: At, volume: VolumeParts, stage: str) -> Radiographs:
        target = self._parts("simulated")
        task = Simulate(volume, at.geometry, target, self.factor)
        self.cluster.map(task, target.parts, stage=stage)
        return self._radiographs(target)

    @property
    def _chunks(self) -> tuple[slice, ...]:
        """Views of each task."""
        return view_chunks(self.cluster.places, self.scan.views)

    def _parts(self, name: str) -> RadiographParts:
        """Return files for radiographs of this level, which go when nobody needs them."""
        shape = (self.scan.views, *self.scan.geometry.binned(self.factor).shape)
        parts = RadiographParts(self.cluster.new_folder(name), shape, self._chunks)
        weakref.finalize(parts, shutil.rmtree, parts.folder, ignore_errors=True)
        return parts

    def _volume(self, planes: Sequence[slice]) -> VolumeParts:
        """Return files for a volume, likewise."""
        parts = VolumeParts(self.cluster.new_folder("volume"), self.grid, tuple(planes))
        weakref.finalize(parts, shutil.rmtree, parts.folder, ignore_errors=True)
        return parts

    def _radiographs(self, parts: RadiographParts) -> Radiographs:
        radiographs = Radiographs.of(parts, self.factor)
        self.measured[radiographs] = Measured(self.factor, parts)
        return radiographs


@contextmanager
def levels_on(
    cluster: Any,
    scan: Scan,
    checkpoint: Checkpoint | None,
    progress: ProgressCallback | None,
    limits: dict[str, Any],
) -> Iterator[Callable[..., Level]]:
    """Yield what makes levels: of a cluster, or of this process if that is None.

    Parameters
    ----------
    cluster, scan, checkpoint, progress, limits
        As for :func:`clra.methods.execution.clusters.on_cluster`.
    """
    if cluster is None:
        yield Level
        return
    with on_cluster(cluster, scan, checkpoint, progress, limits) as executor:
        yield partial(SharedLevel, cluster=executor, shared_scan=executor.share(scan))


def view_chunks(places: int, views: int) -> tuple[slice, ...]:
    """Cut views into tasks: some for each worker, none of many views."""
    count = max(PARTS * places, -(-views // _MOST_VIEWS))
    return tuple(equal_runs(views, min(views, count)))
