"""The executor that a call asks for."""

import tempfile
import uuid
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pyopencl as cl

from clra.errors import InputError
from clra.methods.execution.checkpoint import Checkpoint
from clra.methods.execution.clusters import check_cluster, on_cluster
from clra.methods.execution.executor import InProcess, WorkerGroup
from clra.methods.execution.several_devices import SeveralDevices
from clra.methods.execution.travelling import check_travels
from clra.model.scan import Scan
from clra.ops.streaming.stream import Stream
from clra.progress import ProgressCallback


@contextmanager
def executing(
    stream: Stream,
    devices: Sequence[cl.Device],
    cluster: Any,
    checkpoint: Checkpoint | None,
    progress: ProgressCallback | None,
    limits: dict[str, Any],
    *,
    beside: Path | None = None,
) -> Iterator[InProcess | WorkerGroup]:
    """Yield a cluster if there is one, else several devices, else this process on its device.

    Parameters
    ----------
    stream : Stream
        Of the only device.
    devices : sequence of cl.Device
        Of this machine.
    checkpoint : Checkpoint, optional
        Of the call: files of the work go beside it; else a cluster's into the current folder, and
        those of several devices to where temporary files are.
    beside : Path, optional
        Folder for files of the work, in place of these.
    cluster, progress, limits
        As for :func:`clra.methods.execution.clusters.on_cluster`; None is no cluster.
    """
    if cluster is not None:
        folder = _folder(checkpoint, beside or Path.cwd())
        with on_cluster(cluster, folder, progress, limits) as workers:
            yield workers
    elif len(devices) > 1:
        folder = _folder(checkpoint, beside or Path(tempfile.gettempdir()))
        with closing(SeveralDevices(devices, folder, progress=progress, **limits)) as several:
            yield several
    else:
        yield InProcess(stream)


def _folder(checkpoint: Checkpoint | None, beside: Path) -> Path:
    """Where workers' files go."""
    if checkpoint is None:
        return beside / f"clra-{uuid.uuid4().hex[:8]}.tasks"
    kept = checkpoint.folder
    return kept.with_name(f"{kept.name.removesuffix('.resume')}.tasks")


def check_for_cluster(cluster: Any, scan: Scan, what: str, supported: Sequence[str]) -> None:
    """Refuse, before anything is begun, what a cluster cannot do.

    Parameters
    ----------
    cluster : distributed.Client, str or None
        None is no cluster.
    scan : Scan
        To be read by workers.
    what : str
        What is asked for.
    supported : sequence of str
        What may be asked for.

    Raises
    ------
    InputError
        If it is none of these, or as :func:`clra.methods.execution.clusters.on_cluster` does.
    """
    if cluster is None:
        return
    check_cluster(cluster)
    if what not in supported:
        listed = ", ".join(map(repr, supported))
        raise InputError(f"cluster: found {what!r}, expected one of {listed} on a cluster")
    check_travels(scan)
