"""Describe a scan and what it will take."""

import warnings

from clra.app.console import Console, Memory, Reading, ScanPath


def info(console: Console, reading: Reading, memory: Memory, scan: ScanPath) -> None:
    """Describe a scan and what it will take.

    Memory and time of a reconstruction and of an iteration of alignment at each level of
    resolution, estimated from a small test on the device. Nothing is written.

    Examples
    --------
      clra info scan.nxs
      clra info scan.nxs --json
    """
    from clra.app.cost import costs_of, costs_table
    from clra.app.scan_description import Facts, table
    from clra.app.speed import Speed, measure
    from clra.errors import DeviceError

    limits = memory.limits()
    opened = reading.scan(scan)
    facts = Facts.of(opened)
    try:
        with console.progress() as report:
            speed = measure(opened.geometry, console.device, report, **limits)
    except DeviceError as error:
        if console.device:
            raise
        warnings.warn(f"no times: {error}", stacklevel=1)
        speed = Speed.unknown()
    costs = costs_of(opened.geometry, speed)
    text = f"{table(facts.lines())}\n\n{costs_table(costs, speed)}"
    console.result({"scan": facts, "device": speed.device, "levels": costs}, text)
