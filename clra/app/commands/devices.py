"""List and test the OpenCL devices."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from clra.app.console import Console

if TYPE_CHECKING:
    from clra.ops.runtime.devices import DeviceInfo
    from clra.progress import ProgressCallback


def devices(
    console: Console,
    test: Annotated[
        bool, typer.Option("--test", help="Test each of them, which takes 5 to 10 s a device.")
    ] = False,
) -> None:
    """List the OpenCL devices.

    * marks the one that is taken. A test builds and runs kernels in a process of its own and
    compares with known answers; the first time that a device is used it is tested as well. The
    status is 1 if no device passes.

    Examples
    --------
      clra devices
      clra devices --device pocl
      clra devices --test
    """
    from clra.ops.runtime import devices

    found = devices.devices()
    chosen = devices.choose_device(console.device)  # refuses where there is none
    taken = [info.index for info in found if devices.choose_device(info.index) == chosen][:1]
    lines = [
        f"{'*' if info.index in taken else ' '} {info.index:<5}{info.kind:<6}{info.name}: "
        f"{info.compute_units} units, {info.memory / 2**30:.1f} GiB "
        f"(largest buffer {info.largest_buffer / 2**30:.1f} GiB), {info.platform}, {info.driver}"
        for info in found
    ]
    if not test:
        console.result({"devices": found, "taken": taken[0] if taken else None}, "\n".join(lines))
        return
    tested = _results(found, console.progress)
    console.result({"devices": tested, "taken": taken[0] if taken else None}, _table(tested))
    if not any(one.passed for one in tested):
        raise typer.Exit(1)


@dataclass(frozen=True)
class _TestedDevice:
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


def _results(
    found: "Sequence[DeviceInfo]",
    progress: Callable[[], "AbstractContextManager[ProgressCallback]"],
) -> list[_TestedDevice]:
    """Test each device, whatever is known of it from before."""
    from clra.ops.runtime.devices import device_at
    from clra.ops.runtime.self_test import verdict
    from clra.progress import Progress

    tested = []
    with progress() as report:
        for number, info in enumerate(found):
            report(Progress(f"testing {info.name}", number, len(found)))
            outcome = verdict(device_at(info.index), info.index, anew=True, rate=True)
            failure = outcome.failure or ("" if outcome.tested else "the test could not run")
            tested.append(
                _TestedDevice(
                    *(info.index, info.name, info.driver, not failure, failure),
                    *(outcome.rate, outcome.cpu),
                )
            )
    return tested


def _table(tested: Sequence[_TestedDevice]) -> str:
    """Return the lines of the table, with its head."""
    rows = [("", "device", "driver", "verdict", "G voxel-views/s")]
    for one in tested:
        verdict_found = one.failure or ("passes" + (f" as {one.cpu}" if one.cpu else ""))
        rate = "" if one.rate is None else f"{one.rate:.2g}"
        rows.append((one.index, one.name, one.driver, verdict_found, rate))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)
