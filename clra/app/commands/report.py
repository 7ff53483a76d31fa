"""Write a report of an alignment."""

from pathlib import Path
from typing import Annotated

import typer

from clra.app.console import Console, Memory, Reading
from clra.findings import warn


def report(
    console: Console,
    reading: Reading,
    memory: Memory,
    motion: Annotated[Path, typer.Argument(metavar="MOTION.h5", help="Motion from clra align.")],
    out: Annotated[
        Path, typer.Option("--output", "-o", metavar="REPORT.html", help="Page to write.")
    ],
    scan: Annotated[
        Path | None,
        typer.Option(metavar="SCAN", help="The scan: adds slices and re-projections."),
    ] = None,
    show: Annotated[
        bool, typer.Option("--open", help="Show the page in the browser when it is written.")
    ] = False,
) -> None:
    """Write a report of an alignment.

    One HTML page that needs nothing else, no network either: the verdict, warnings, corrections,
    convergence, confidence, and with the scan slices and re-projections before and after.

    Examples
    --------
      clra report motion.h5 -o report.html
      clra report motion.h5 -o report.html --scan scan.nxs --open
    """
    from clra.app.annotations import matched
    from clra.app.report.html_report import write_report
    from clra.app.report.summary import findings_of
    from clra.app.session.overall_progress import report_parts
    from clra.io.alignment_file import read_alignment
    from clra.io.atomic import ensure_writable

    limits = memory.limits()
    result = read_alignment(motion)
    ensure_writable(out, keep=(motion, scan))
    opened = None if scan is None else reading.scan(scan)
    if opened is not None:
        opened = matched(opened, result, motion, reading.geometry())
    with console.progress(report_parts(scan is not None)) as progress:
        findings = findings_of(result, opened, device=console.device, progress=progress, **limits)
    write_report(out, findings)
    told = {} if findings.quality is None else {"quality": findings.quality}
    console.summary({"file": out, **told}, f"wrote {out}")
    if show:
        import webbrowser

        page = out.absolute().as_uri()
        if not webbrowser.open(page):
            warn("no-browser", f"found no browser here, open {page} in one")
