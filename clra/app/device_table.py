"""The devices and how each of them fares in the self-test."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

from clra.ops.runtime.devices import DeviceInfo, device_at
from clra.ops.runtime.self_test import verdict
from clra.progress import Progress, ProgressCallback


@dataclass(frozen=True)
class TestedDevice:
    """A line of the table.

    Attributes
    ----------
    index, name, driver : str
        Which device.
    passed : bool
        Whether all answers were right.
    failure : str
        What went wrong, in one line.
    rate : float or None
        Back-projection, 1e9 voxels times views a second.
    cpu : str or None
        CPU name that PoCL's compiler had to be given.
    """

    index: str
    name: str
    driver: str
    passed: bool
    failure: str
    rate: float | None
    cpu: str | None


def results(
    found: Sequence[DeviceInfo], progress: Callable[[], AbstractContextManager[ProgressCallback]]
) -> list[TestedDevice]:
    """Test each device, whatever is known of it from before."""
    tested = []
    with progress() as report:
        for number, info in enumerate(found):
            report(Progress(f"testing {info.name}", number, len(found)))
            outcome = verdict(device_at(info.index), info.index, anew=True, rate=True)
            failure = outcome.failure or ("" if outcome.tested else "the test could not run")
            tested.append(
                TestedDevice(
                    *(info.index, info.name, info.driver, not failure, failure),
                    *(outcome.rate, outcome.cpu),
                )
            )
    return tested


def table(tested: Sequence[TestedDevice]) -> str:
    """Return the lines of the table, with its head."""
    rows = [("", "device", "driver", "verdict", "G voxel-views/s")]
    for one in tested:
        verdict_found = one.failure or ("passes" + (f" as {one.cpu}" if one.cpu else ""))
        rate = "" if one.rate is None else f"{one.rate:.2g}"
        rows.append((one.index, one.name, one.driver, verdict_found, rate))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)
