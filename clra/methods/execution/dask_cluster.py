"""Tasks on the workers of a dask.distributed cluster.

Tasks and their results carry paths, ranges and a few numbers a view. All else is in files of a
folder that every worker sees, each written by one task, so that a task that is done twice, after a
worker was lost, does no harm.
"""

import logging
import shutil
import time
import uuid
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError
from pathlib import Path
from queue import Empty
from typing import Any

from clra.errors import ClusterError, DeviceError, InputError
from clra.findings import Finding
from clra.methods.execution.executor import Item, Result, Task, slabs_of
from clra.methods.execution.travelling import Shared, write_task
from clra.methods.execution.worker_facts import LOOK, PATIENCE, Ready, known_workers
from clra.methods.execution.worker_process import Outcome, Settings, run
from clra.progress import ProgressCallback, tell

_LOG = logging.getLogger(__name__)
# How often a task may fail: a full disk or a lost mount may be gone the next time, a bug is not.
_TRIES = 3
# How often a task may be begun, whose result is lost with a worker before it is fetched.
_BEGUN = 10
# Part of the memory that is free on a machine that its workers may use.
_HOST_PART = 0.5


class DaskCluster:
    """Tasks on the workers of a cluster; see :class:`clra.methods.execution.executor.Executor`.

    Parameters
    ----------
    client : distributed.Client
        Connected to the cluster.
    folder : Path
        For files of this call, which every worker sees under this name: what it holds is lost.
    progress : callable, optional
        Called with a :class:`clra.progress.Progress` when a task is done.
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used on each device, and on each machine by all its workers.

    Raises
    ------
    DeviceError
        If no worker has a device.
    InputError
        If no worker sees the folder.
    ClusterError
        If there are no workers.
    """

    def __init__(
        self,
        client: Any,
        folder: Path,
        *,
        progress: ProgressCallback | None = None,
        max_device_memory: int | None = None,
        max_host_memory: int | None = None,
    ) -> None:
        self._client, self._progress = client, progress
        self._root = folder.absolute()
        self._session = uuid.uuid4().hex[:8]
        # What is left of a client that was killed may still run, and must not write here.
        self.folder = self._root / self._session
        shutil.rmtree(self._root, ignore_errors=True)
        self.folder.mkdir(parents=True)
        self._number = 0
        self._refused: set[str] = set()
        try:
            token = self.folder / "seen"
            token.touch()
            found = known_workers(client, token, self._session, progress)
            for address, fact in found.items():
                if fact.failure:
                    self.refuse(address, f"{address}: {fact.failure}")
        except BaseException:
            self.close()
            raise
        known = {address: fact for address, fact in found.items() if not fact.failure}
        # A task takes its worker's GPU, where all workers were started with one.
        self._resources = {"GPU": 1} if all(fact.gpu for fact in known.values()) else None
        self.places = len(known)
        hosts = Counter(fact.host for fact in known.values())
        device = min(fact.device_memory for fact in known.values()) * 3 // 4
        host = min(
            int(_HOST_PART * fact.host_memory) // hosts[fact.host] for fact in known.values()
        )
        if max_host_memory is not None:
            host = max_host_memory // max(hosts.values())
        # The same for all, so that it does not matter which of them does a task.
        self._settings = Settings(max(hosts.values()), max_device_memory or device, host)
        shared = any(fact.shared for fact in known.values())
        budget = min(self._settings.device_memory, host // 2 if shared else device)
        self.slab_bytes = min(budget // 3, *(fact.largest_buffer for fact in known.values()))
        names = ", ".join(sorted({fact.device for fact in known.values()}))
        self.devices = f"{self.places} x {names}"
        _LOG.info("%s, %d MiB a slab", self.devices, self.slab_bytes >> 20)

    def close(self) -> None:
        """Remove the files of this call."""
        shutil.rmtree(self._root, ignore_errors=True)

    def parts(self, shape: tuple[int, int, int]) -> list[slice]:
        """Cut the planes of a volume (nz, ny, nx) into tasks; see :func:`slabs_of`."""
        return slabs_of(self.places, self.slab_bytes, shape)

    def share(self, value: Any) -> Shared:
        """Write a value once for all tasks that use it."""
        self._number += 1
        path = self.folder / f"shared-{self._number:05}"
        write_task(path, value)
        return Shared(path)

    def new_folder(self, name: str) -> Path:
        """Make a folder that no task has written to."""
        self._number += 1
        folder = self.folder / f"{name}-{self._number:05}"
        folder.mkdir()
        return folder

    def map(
        self,
        task: Task[Item, Result],
        items: Sequence[Item],
        *,
        stage: str,
        part: tuple[int, int] | None = (0, 1),
        done: Callable[[int], None] | None = None,
    ) -> list[Result]:
        """Do a task with each of some items.

        Raises
        ------
        InputError, DeviceError, ClusterError
            If a task failed three times; names the worker and the task.
        """
        path = self.folder / f"task-{self._number:05}"
        self._number += 1
        write_task(path, task)
        waiting = _Waiting(self, str(path), items, stage)
        results: dict[int, Any] = {}
        try:
            for number in range(len(items)):
                waiting.add(number)
            while waiting.futures:
                self._tell(stage, part, len(results), len(items))
                ready = waiting.next()
                if ready is None:
                    continue
                number, outcome = ready
                if outcome.error is not None:
                    self._failed(waiting, number, outcome)
                    continue
                for finding in outcome.findings:
                    finding.warn()
                results[number] = outcome.result
                if done is not None:
                    done(number)
            self._tell(stage, part, len(items), len(items))
        finally:
            waiting.cancel()
        path.unlink(missing_ok=True)
        return [results[number] for number in range(len(items))]

    def _tell(self, stage: str, part: tuple[int, int] | None, done: int, count: int) -> None:
        """Tell how far a stage is."""
        if part is not None:
            tell(self._progress, stage, part[0] * count + done, part[1] * count)

    def _failed(self, waiting: "_Waiting", number: int, outcome: Outcome) -> None:
        """Try again, on another worker if it is this one's device that fails; or give up."""
        error = outcome.error
        assert error is not None
        waiting.failed[number] += 1
        if isinstance(error, DeviceError):
            self.refuse(outcome.address, f"{outcome.worker}: {error}")
        if waiting.failed[number] < _TRIES:
            waiting.add(number)
            return
        where = f"{waiting.stage}: task {number + 1} on worker {outcome.worker}"
        _LOG.error("%s\n%s", where, outcome.trace)
        if isinstance(error, InputError):
            raise InputError(f"{where}: {error}") from error
        if isinstance(error, (DeviceError, OSError, MemoryError)):
            raise ClusterError(f"{where} failed {_TRIES} times: {error}") from error
        error.add_note(f"{where}\n{outcome.trace}")
        raise error

    def refuse(self, address: str, why: str) -> None:
        """Give a worker no more tasks, as long as there are others."""
        if address not in self._refused:
            self._refused.add(address)
            Finding("worker", f"worker {why}", "the others do its work").warn()

    def usable(self) -> list[str] | None:
        """Return the workers that tasks may go to; None for all."""
        if not self._refused:
            return None
        return [address for address in self._client.nthreads() if address not in self._refused]


class _Waiting:
    """The tasks of one call that are not done yet."""

    def __init__(self, cluster: DaskCluster, path: str, items: Sequence[Any], stage: str) -> None:
        self.stage = stage
        self.futures: dict[Any, int] = {}
        self._where: dict[Any, list[str] | None] = {}
        self.begun: Counter[int] = Counter()
        self.failed: Counter[int] = Counter()
        self._items = items
        self._cluster, self._path = cluster, path
        self._seen = time.monotonic()
        self._ready = Ready()

    def add(self, number: int) -> None:
        """Hand a task in."""
        cluster = self._cluster
        self.begun[number] += 1
        # Dask's dashboard shows the words before the number.
        words = "-".join(self.stage.replace(":", " ").split())
        name = Path(self._path).name.removeprefix("task-")
        future = cluster._client.submit(
            run,
            self._path,
            self._items[number],
            cluster._settings,
            key=f"{words}-{cluster._session}-{name}-{number}-{self.begun[number]}",
            pure=False,
            priority=-number,
            workers=(where := cluster.usable()),
            resources=cluster._resources,
        )
        self.futures[future], self._where[future] = number, where
        self._ready.watch(future)

    def next(self) -> tuple[int, Outcome] | None:
        """Wait for a while; return the next task that is done, if any."""
        try:
            future = self._ready.get(LOOK)
        except Empty:
            self._look()
            return None
        self._seen = time.monotonic()
        if future not in self.futures:
            return None  # it was handed in again
        number = self.futures.pop(future)
        outcome = self._outcome(future, number)
        future.release()
        if outcome is None:
            self.add(number)
            return None
        return number, outcome

    def cancel(self) -> None:
        """Take back what is not done."""
        if self.futures:
            self._cluster._client.cancel(list(self.futures), force=True)
            self.futures.clear()

    def _outcome(self, future: Any, number: int) -> Outcome | None:
        """Return what became of a task; None if that was lost with its worker."""
        from distributed.scheduler import KilledWorker

        what = f"{self.stage}: task {number + 1}"
        try:
            outcome: Outcome = future.result()
        except KilledWorker as error:
            raise ClusterError(
                f"{what}: its workers were killed each time, the last of them {error.last_worker}: "
                "look for a lack of memory there (--max-host-memory)"
            ) from error
        except CancelledError:
            if self._cluster._client.status != "running" or self.begun[number] > _BEGUN:
                raise ClusterError(f"{what}: the scheduler was lost") from None
            return None
        return outcome

    def _look(self) -> None:
        """See to tasks that wait for workers that are gone."""
        cluster = self._cluster
        alive = set(cluster._client.nthreads())
        if alive - cluster._refused:
            self._seen = time.monotonic()
        elif time.monotonic() - self._seen > PATIENCE:
            raise ClusterError(
                f"{self.stage}: no worker with a device for {PATIENCE:.0f} s: start some"
            )
        for future, number in list(self.futures.items()):
            where = self._where[future]
            if where is not None and not alive.intersection(where):
                del self.futures[future]
                future.cancel()
                self.add(number)
