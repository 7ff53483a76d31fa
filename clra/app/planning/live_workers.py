"""The workers of a cluster that is there, and how fast they are when all of them work."""

import time
import uuid
from dataclasses import dataclass, fields, replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from clra.app.planning.planned_steps import Workers
from clra.app.speed import Speed, measure
from clra.methods.execution.clusters import check_cluster, on_cluster
from clra.model.geometry import ConeBeamGeometry

if TYPE_CHECKING:
    from clra.ops.streaming.stream import Stream
    from clra.progress import ProgressCallback

# Time for which a worker counts, to see what it gets of its core [s].
_COUNTING = 0.3


def live_workers(
    text: str,
    geometry: ConeBeamGeometry,
    progress: "ProgressCallback | None" = None,
    **limits: Any,
) -> Workers:
    """Test the workers of a cluster, all of them at once.

    Parameters
    ----------
    text : str
        As for :func:`clra.methods.execution.clusters.on_cluster`.
    geometry : ConeBeamGeometry
        Of a scan whose work is to be planned.
    progress : callable, optional
        Told how far it is.
    **limits
        ``max_device_memory`` and ``max_host_memory``, see
        :class:`clra.methods.execution.dask_cluster.DaskCluster`.

    Raises
    ------
    InputError, ClusterError, DeviceError
        As `on_cluster` does.
    """
    check_cluster(text)
    folder = Path(f"clra-{uuid.uuid4().hex[:8]}.tasks")
    with on_cluster(text, folder, progress, limits) as cluster:
        items = range(cluster.places)
        # The first time kernels are built, by one worker longer than by another.
        for _ in range(2):
            found = cluster.map(SpeedTest(geometry), items, stage="testing the workers")
        return Workers(
            cluster.places,
            _middle([speed for speed, _ in found]),
            cluster.slab_bytes,
            median(slowdown for _, slowdown in found),
        )


@dataclass(frozen=True)
class SpeedTest:
    """Measures the speed of a worker's device, and what the worker gets of its core."""

    geometry: ConeBeamGeometry

    def __call__(self, stream: "Stream", number: int) -> tuple[Speed, float]:
        """Return the speed, and by how much longer than alone on a core a worker counts."""
        speed = replace(measure(self.geometry, stream.device), budgets=None)
        started, counted = time.perf_counter(), time.thread_time()
        while time.thread_time() - counted < _COUNTING:
            pass
        return speed, (time.perf_counter() - started) / (time.thread_time() - counted)


def _middle(speeds: list[Speed]) -> Speed:
    """Return the median of each kind of work."""
    kinds = [field.name for field in fields(Speed) if field.name not in ("device", "budgets")]
    values = {kind: median(getattr(speed, kind) for speed in speeds) for kind in kinds}
    return Speed(speeds[0].device, None, **values)
