"""What work will take on a cluster: tasks, bytes, memory and time, by a small simulation."""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, replace

from clra.app.planning.planned_steps import PlannedStep, Workers, steps_of_work
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid


@dataclass(frozen=True)
class Site:
    """What a cluster has beside its workers; assumed, not measured.

    Parameters
    ----------
    file_system : float
        Bytes a second that the shared file system gives to all workers together.
    link : float
        Bytes a second that one worker gets of it at most.
    task_s : float
        Time that the client and the scheduler take for a task [s]; 3 ms of processor time measured.
    start_s, begin_s : float
        Time that a worker takes to begin with the work, and with each task: kernels, files, tables;
        0.7 s and 0.02 s of processor time measured.
    view_s : float
        Time that the client takes for a view in an iteration: gauge and stop rule [s].
    task_bytes, view_bytes : float
        Of messages, for a task, and for a view that is registered.
    """

    file_system: float = 2e9
    link: float = 1e9
    task_s: float = 6e-3
    start_s: float = 0.7
    begin_s: float = 0.02
    view_s: float = 2e-4
    task_bytes: float = 2.5e3
    view_bytes: float = 80.0


@dataclass(frozen=True)
class Plan:
    """What a piece of work will take.

    Attributes
    ----------
    work : str
        Its name.
    workers, tasks : int
        How many.
    read_bytes, written_bytes, message_bytes : float
        Through the shared file system, and through the scheduler.
    memory_bytes : float
        Of a worker's device, for its slabs of the volume.
    seconds : float
        In all.
    efficiency : float
        Time that one device would take by itself, over that of all workers.
    limit : str
        What most of the time is lost to: "device", "file system", "client" or "waiting".
    """

    work: str
    workers: int
    tasks: int
    read_bytes: float
    written_bytes: float
    message_bytes: float
    memory_bytes: float
    seconds: float
    efficiency: float
    limit: str


def plans(
    geometry: ConeBeamGeometry,
    workers: Workers,
    site: Site | None = None,
    aligned: VolumeGrid | None = None,
) -> list[Plan]:
    """Plan reconstructions at full resolution and an alignment by the default schedule.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the scan.
    workers : Workers
        Who does it.
    site : Site, optional
        What else there is.
    aligned : VolumeGrid, optional
        Where alignment reconstructs, as for :func:`steps_of_work`.
    """
    site = site or Site()
    alone = replace(workers, count=1)
    made = []
    for (work, steps, registered), (_, whole, _) in zip(
        steps_of_work(geometry, workers, aligned),
        steps_of_work(geometry, alone, aligned),
        strict=True,
    ):
        device = sum(step.seconds for step in whole)
        made.append(_plan(work, steps, workers, site, registered, device))
    return made


def simulated(steps: Sequence[PlannedStep], workers: Workers, site: Site) -> float:
    """Return how long steps take: each waits for the last task of the one before.

    Workers take the next task as soon as they are free; the client hands tasks out one after the
    other; the file system is shared by those that are busy.

    Parameters
    ----------
    steps : sequence of PlannedStep
        In their order.
    workers, site
        Who does it, and where.

    Returns
    -------
    float
        Seconds.
    """
    now = workers.slowdown * site.start_s
    for step in steps:
        busy = min(workers.count, step.tasks)
        rate = min(site.link, site.file_system / busy)
        moved = (step.read + step.written) / step.tasks / rate
        took = step.seconds / step.tasks + workers.slowdown * site.begin_s + moved
        free = [now] * busy
        for number in range(step.tasks):
            begun = max(heapq.heappop(free), now + (number + 1) * site.task_s)
            heapq.heappush(free, begun + took)
        now = max(free)
    return now


def _plan(
    work: str,
    steps: Sequence[PlannedStep],
    workers: Workers,
    site: Site,
    registered: int,
    alone: float,
) -> Plan:
    tasks = sum(step.tasks for step in steps)
    seconds = simulated(steps, workers, site) + registered * site.view_s
    device = sum(step.seconds for step in steps)
    moved = sum(step.read + step.written for step in steps)
    parts = {
        "device": (device + tasks * workers.slowdown * site.begin_s) / workers.count,
        "file system": moved / min(site.file_system, site.link * workers.count),
        "client": tasks * site.task_s + registered * site.view_s,
    }
    parts["waiting"] = seconds - sum(parts.values())
    return Plan(
        work,
        workers.count,
        tasks,
        sum(step.read for step in steps),
        sum(step.written for step in steps),
        tasks * site.task_bytes + registered * site.view_bytes,
        workers.slab_bytes,
        seconds,
        alone / (seconds * workers.count),
        max(parts, key=lambda name: parts[name]),
    )
