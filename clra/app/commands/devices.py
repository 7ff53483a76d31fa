"""List and test the OpenCL devices."""

from typing import Annotated

import typer

from clra.app.console import Console


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
    from clra.app.device_table import results, table

    tested = results(found, console.progress)
    console.result({"devices": tested, "taken": taken[0] if taken else None}, table(tested))
    if not any(one.passed for one in tested):
        raise typer.Exit(1)
