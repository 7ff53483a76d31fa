"""What the workers of a cluster have to work with, asked once at the beginning of a call."""

import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from clra.errors import ClusterError, DeviceError, InputError
from clra.methods.execution.worker_process import WorkerFacts, facts
from clra.progress import ProgressCallback, tell

# Seconds for which there may be no worker, and between two looks at them.
PATIENCE, LOOK = 300.0, 1.0


class Ready:
    """Futures in the order in which they are done, of any client."""

    def __init__(self) -> None:
        self._done: SimpleQueue[Any] = SimpleQueue()

    def watch(self, future: Any) -> None:
        """Wait for a future as well."""
        future.add_done_callback(self._done.put)

    def get(self, seconds: float) -> Any:
        """Return the next one; raise Empty if there is none for some time."""
        return self._done.get(timeout=seconds)


def known_workers(
    client: Any, token: Path, session: str, progress: ProgressCallback | None
) -> dict[str, WorkerFacts]:
    """Ask all workers what they have.

    Parameters
    ----------
    client : distributed.Client
        Connected to the cluster.
    token : Path
        A file that every worker has to see.
    session : str
        That no other call has.
    progress : callable, optional
        Called while there is no worker yet.

    Returns
    -------
    dict
        Of the address of each worker that answers, at least one of them with a device.

    Raises
    ------
    InputError
        If none sees the file.
    DeviceError
        If none has a device.
    ClusterError
        If there are no workers.
    """
    started, found = time.monotonic(), dict[str, WorkerFacts]()
    while not found:
        if time.monotonic() - started > PATIENCE:
            raise ClusterError(f"no worker within {PATIENCE:.0f} s: start some")
        addresses = list(client.nthreads())
        if addresses:
            found = _asked(client, addresses, str(token), session)
        else:
            tell(progress, "waiting for workers", 0, 1)
            time.sleep(LOOK)
    if all(fact.failure for fact in found.values()):
        address, fact = next(iter(found.items()))
        if str(token) in fact.failure:
            raise InputError(
                f"{token.parents[1]}: worker {address} does not see it, expected a folder that "
                "all workers share"
            )
        raise DeviceError(f"no worker with a device: worker {address}: {fact.failure}")
    return found


def _asked(client: Any, addresses: list[str], token: str, session: str) -> dict[str, WorkerFacts]:
    """Return what workers answer; any that is lost meanwhile does not."""
    neighbours = max(Counter(host_of(address) for address in addresses).values())
    ready, asked, answers = Ready(), dict[Any, str](), dict[str, WorkerFacts]()
    for address in addresses:
        future = client.submit(
            facts,
            neighbours,
            token,
            key=f"looking-at-the-device-{session}-{address}-{time.monotonic_ns()}",
            workers=[address],
            pure=False,
        )
        asked[future] = address
        ready.watch(future)
    started = time.monotonic()
    # A driver that hangs must not hold the others up for ever.
    while asked and time.monotonic() - started < PATIENCE:
        with suppress(Empty):
            future = ready.get(LOOK)
            address = asked.pop(future, "")
            if address and future.status == "finished":
                answers[address] = future.result()
            elif address and future.status == "error":
                answers[address] = WorkerFacts("", failure=str(future.exception()))
        alive = client.nthreads()
        for future in [f for f, address in asked.items() if address not in alive]:
            del asked[future]
    client.cancel(list(asked))
    return answers


def host_of(address: str) -> str:
    """Return the machine of an address such as tcp://10.0.0.1:4000."""
    return address.rpartition("://")[2].rpartition(":")[0]
