"""Describe a scan and what it will take."""

from pathlib import Path
from typing import Annotated

import typer

from clra.app.console import Console, Memory, Reading, ScanPath
from clra.app.correcting import Correcting
from clra.findings import warn


def info(
    console: Console,
    reading: Reading,
    memory: Memory,
    correcting: Correcting,
    scan: ScanPath,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="N|NxGPU|ADDRESS|FILE|local:N",
            help="Also plan the work of N workers with devices like this one or with a GPU, or of "
            "workers that are there, which are tested.",
        ),
    ] = None,
) -> None:
    """Describe a scan and what it will take.

    Memory and time of a reconstruction and of an iteration of alignment at each level of
    resolution, estimated from a small test on the device; bad pixels and other defects, looked for
    in some of the radiographs. Of a scanner's files also what their metadata tell, and what had to
    be assumed. Nothing is written.

    Examples
    --------
      clra info scan.nxs
      clra info scan.nxs --json
      clra info Lego.xtekct
      clra info scan.nxs --cluster 8xGPU
    """
    from clra.app.cost import costs_of, costs_table
    from clra.app.planning.cluster_plan import plans
    from clra.app.planning.live_workers import live_workers
    from clra.app.planning.plan_table import plan_table
    from clra.app.planning.planned_steps import Workers
    from clra.app.scan_description import Facts, scanner_text, table
    from clra.app.speed import Speed, measure
    from clra.errors import DeviceError
    from clra.methods.alignment.region import region_of
    from clra.methods.preparation import prepared
    from clra.model.grid import default_grid
    from clra.ops.streaming.stream import Stream

    limits = memory.limits()
    scanner = reading.scanner(scan)
    unread = scanner is not None and (scanner.missing or not scanner.normalisable(reading.white))
    opened = scanner.described() if scanner is not None and unread else reading.scan(scan)
    if not unread:
        with console.progress() as report:
            opened = prepared(opened, correcting.options(), progress=report)
    facts = Facts.of(opened)
    try:
        with console.progress() as report:
            speed = measure(opened.geometry, console.device, report, **limits)
    except DeviceError as error:
        if console.device:
            raise
        warn("no-times", f"no times: {error}")
        speed = Speed.unknown()
    aligned = None
    if speed.budgets is not None and not unread:
        part = opened.cropped()
        stream = Stream(console.device, **limits)
        aligned = region_of(stream, part, default_grid(part.geometry)).grid
    costs = costs_of(opened.geometry, speed, aligned)
    told = "" if scanner is None else f"\n\n{scanner_text(scanner)}"
    text = f"{table(facts.lines())}{told}\n\n{costs_table(costs, speed)}"
    values = {"scan": facts, "device": speed.device, "levels": costs}
    if cluster is not None:
        if ":" in cluster or Path(cluster).is_file():
            with console.progress() as report:
                workers = live_workers(cluster, opened.geometry, report, **limits)
        else:
            workers = Workers.parse(cluster, speed)
        values["cluster"] = planned = plans(opened.geometry, workers, aligned=aligned)
        text += f"\n\n{plan_table(planned, workers)}"
    if scanner is not None:
        values["scanner"] = {
            **scanner.contents(),
            "findings": [finding.as_dict() for finding in scanner.findings],
        }
    console.result(values, text)
