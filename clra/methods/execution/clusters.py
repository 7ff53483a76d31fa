"""Which cluster is meant: a client of Dask, or a text that says how to get one."""

import logging
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from clra.errors import ClusterError, InputError
from clra.methods.execution.dask_cluster import DaskCluster
from clra.progress import ProgressCallback

CHOICES = "ADDRESS|FILE|local:N|slurm:N"
_STARTED = re.compile(r"(local|slurm):([1-9]\d*)")
# Seconds to connect to a scheduler.
_CONNECTING = 30


@contextmanager
def on_cluster(
    cluster: Any,
    folder: Path,
    progress: ProgressCallback | None,
    limits: dict[str, Any],
) -> Iterator[DaskCluster]:
    """Yield the executor of one call.

    Parameters
    ----------
    cluster : distributed.Client or str
        A client; or the address of a scheduler, its file, "local:N" for N worker processes on this
        machine, or "slurm:N" for N jobs as dask-jobqueue is configured.
    folder, progress, limits
        As for :class:`DaskCluster`.

    Raises
    ------
    InputError
        If dask.distributed is not installed, or the text is none of these.
    ClusterError
        If there is no scheduler, or as :class:`DaskCluster` raises it.
    """
    with ExitStack() as stack:
        client = stack.enter_context(_client(cluster)) if isinstance(cluster, str) else cluster
        executor = DaskCluster(client, folder, progress=progress, **limits)
        stack.callback(executor.close)
        yield executor


def check_cluster(cluster: Any) -> None:
    """Refuse what is no cluster, before anything is begun; see :func:`on_cluster`."""
    try:
        import distributed
    except ImportError:
        raise InputError(
            "cluster: dask.distributed is not installed: pip install 'clra[dask]'"
        ) from None
    if isinstance(cluster, distributed.Client):
        return
    if not isinstance(cluster, str):
        raise InputError(f"cluster: found {cluster!r}, expected a distributed.Client or {CHOICES}")
    if not (_STARTED.fullmatch(cluster) or Path(cluster).is_file() or "://" in cluster):
        raise InputError(f"cluster: found {cluster!r}, expected {CHOICES}")


@contextmanager
def _client(text: str) -> Iterator[Any]:
    from distributed import Client

    started = _STARTED.fullmatch(text)
    with ExitStack() as stack:
        if started:
            start = _local if started[1] == "local" else _slurm
            address = stack.enter_context(start(int(started[2])))
            where: dict[str, Any] = {"address": address}
        elif Path(text).is_file():
            where = {"scheduler_file": text}
        else:
            where = {"address": text}
        try:
            client = Client(timeout=_CONNECTING, set_as_default=False, **where)
        except (OSError, TimeoutError) as error:
            raise ClusterError(f"cluster: no scheduler at {text}: {error}") from error
        stack.callback(client.close)
        yield client


@contextmanager
def _local(workers: int) -> Iterator[Any]:
    """Start worker processes on this machine."""
    from distributed import LocalCluster

    folder = tempfile.mkdtemp(prefix="clra-dask-")
    try:
        with LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            memory_limit=None,  # clra keeps to its own budgets
            dashboard_address=":0",
            silence_logs=logging.ERROR,
            local_directory=folder,
        ) as cluster:
            yield cluster
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _slurm(jobs: int) -> Iterator[Any]:
    """Submit jobs as dask-jobqueue is configured."""
    try:
        from dask_jobqueue import SLURMCluster
    except ImportError:
        raise InputError("cluster: slurm needs dask-jobqueue: pip install 'clra[dask]'") from None
    try:
        cluster = SLURMCluster()
    except (ValueError, TypeError) as error:
        raise InputError(
            f"cluster: slurm: {error}: expected ~/.config/dask/jobqueue.yaml to tell cores, memory "
            "and queue (see clra/README.md)"
        ) from error
    with cluster:
        cluster.scale(jobs=jobs)
        yield cluster
