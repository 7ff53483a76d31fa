"""Estimate the motion of each radiograph."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from clra.app.console import Console, Memory, Reading, ScanPath
from clra.app.correcting import Correcting
from clra.app.planning.cluster_option import Cluster
from clra.errors import InputError


def align(
    console: Console,
    reading: Reading,
    memory: Memory,
    correcting: Correcting,
    scan: ScanPath,
    out: Annotated[
        Path, typer.Option("--output", "-o", metavar="MOTION.h5", help="Motion to write.")
    ],
    method: Annotated[
        str,
        typer.Option(
            metavar="ra|imgr|reference",
            help="Re-projection alignment, by itself or within a multigrid reconstruction; or only "
            "the slow drift against a reference scan.",
        ),
    ] = "ra",
    reference: Annotated[
        Path | None,
        typer.Option(
            metavar="REF.nxs",
            help="Reference scan: some views again, taken so quickly that nothing moved.",
        ),
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option(
            metavar="MOTION",
            help="Motion to start from: MOTION.h5 of a run that was interrupted or shall be "
            "refined, a table as clra export-motion writes it, or what a scanner's software "
            "measured (.txrm, .pcr, _TS.csv, CTSimU .json).",
        ),
    ] = None,
    autofocus: Annotated[
        bool,
        typer.Option(
            "--autofocus",
            help="First find the column of the axis and the tilt of the detector.",
        ),
    ] = False,
    schedule: Annotated[
        str,
        typer.Option(
            metavar="TEXT",
            help="Iterations at quarter (QR), half (HR) and full (FR) resolution, such as 2QR-1HR; "
            "auto: 6ER-3QR on large detectors, else 4ER, and QR until converged; then HR likewise; "
            "before it a pre-alignment (PA) where the motion is large or the beam parallel. "
            "With imgr the levels of a cycle: QR-HR-FR.",
        ),
    ] = "auto",
    estimate: Annotated[
        str,
        typer.Option(
            metavar="shift|shift+scale|source|rigid",
            help="What is estimated in each view; source: what the source causes, with parallax; "
            "rigid: translations and rotations of the sample (or shift+roll, shift+scale+roll).",
        ),
    ] = "shift+scale",
    gauge: Annotated[
        str,
        typer.Option(
            metavar="anchored|free",
            help="Take out of the motion, or leave in, what a movement of the sample explains.",
        ),
    ] = "anchored",
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on where this command was interrupted.")
    ] = False,
    cluster: Cluster = None,
    report: Annotated[
        Path | None, typer.Option(metavar="REPORT.html", help="Write a report as well.")
    ] = None,
    volume: Annotated[
        Path | None,
        typer.Option(
            metavar="VOLUME",
            help="imgr: write its volume as well: .h5, .tif, .zarr, .nrrd or .raw.",
        ),
    ] = None,
) -> None:
    """Estimate how each radiograph moved.

    Writes shift and magnification of every view, how much to trust them, and the history of the
    run. Whatever interrupts it, finished iterations stay beside the motion, and --resume goes on
    from there.

    Examples
    --------
      clra align scan.nxs -o motion.h5
      clra align scan.nxs -o motion.h5 --schedule 1QR-1HR --report report.html
      clra align scan.nxs -o finer.h5 --start motion.h5 --schedule 1HR
      clra align scan.nxs -o motion.h5 --method imgr --volume volume.h5
      clra align scan.nxs -o motion.h5 --reference quick.nxs
      clra align scan.nxs -o drift.h5 --reference quick.nxs --method reference
      clra align scan.nxs -o motion.h5 --autofocus
      clra align scan.nxs -o motion.h5 --cluster tcp://node1:8786
    """
    from clra.app.annotations import annotated, focus_attributes, matched
    from clra.app.arguments import volume_file
    from clra.app.exit_status import InterruptedCommandError, command_line, keeping
    from clra.app.report.summary import Errors, findings_of, summary_of
    from clra.app.session.overall_progress import align_parts, report_parts
    from clra.io.alignment_file import read_alignment, write_alignment
    from clra.io.atomic import ensure_writable
    from clra.io.provenance import provenance
    from clra.io.volumes.raw_volume import sidecar
    from clra.io.volumes.volume_files import write_volume
    from clra.methods.alignment.align import align as align_scan
    from clra.methods.alignment.autofocus import autofocus as find_focus
    from clra.methods.alignment.result import AlignmentInterrupted, finished
    from clra.methods.execution.checkpoint import Checkpoint
    from clra.methods.preparation import prepared
    from clra.model.grid import default_grid
    from clra.model.schedule import parse_levels, parse_schedule

    (parse_levels if method == "imgr" else parse_schedule)(schedule)
    if volume is not None:
        if method != "imgr":
            raise InputError(f"--volume: found it with --method {method}, expected imgr")
        volume_file(volume)
    if start is not None and (autofocus or reference is not None):
        other = "--autofocus" if autofocus else "--reference"
        raise InputError(f"--start, {other}: found both, expected one of them")
    limits = memory.limits()
    ensure_writable(out, keep=(scan, reference))  # it may be --start: that is read by then
    kept = [scan, reference, start, out]
    beside = sidecar(volume) if volume is not None and volume.suffix.lower() == ".raw" else None
    for path in (report, volume, beside):
        if path is not None:
            ensure_writable(path, kept)
            kept.append(path)
    opened = reading.scan(scan)
    still = None if reference is None else reading.scan(reference)
    measured = None if start is None else reading.start_motion(start, opened)
    earlier = None if start is None or measured is not None else read_alignment(start)
    if earlier is not None and start is not None:
        opened = matched(opened, earlier, start, reading.geometry())
    about = {
        "file": str(scan.absolute()),
        "geometry": reading.geometry(),
        "command": command_line(),
    }
    stages = () if method != "ra" else parse_schedule(schedule, opened.cropped().geometry.shape)
    checkpoint = Checkpoint(f"{out}.resume", resume=resume)
    parts = [*align_parts(method, stages), *report_parts(report is not None)]
    with console.progress(parts) as progress, keeping(checkpoint):
        opened = prepared(opened, correcting.options(), progress=progress)
        if autofocus:
            focus = find_focus(opened, console.device, progress=progress, **limits)
            about |= focus_attributes(focus)
            opened = focus.applied(opened)
            still = still and focus.applied(still)
        try:
            result = align_scan(
                opened,
                method=method,
                schedule=schedule,
                estimate=estimate,
                gauge=gauge,
                reference=still,
                motion=measured if earlier is None else earlier.motion,
                device=console.device,
                progress=progress,
                checkpoint=checkpoint,
                cluster=cluster,
                **limits,
            )
        except AlignmentInterrupted as stopped:
            result = annotated(stopped.result, opened, earlier, interrupted="yes", **about)
            write_alignment(out, result)
            raise InterruptedCommandError(
                f"{out} keeps what {finished(stopped.result.history)} gave; --resume goes on from "
                f"there, or --start {out}"
            ) from None
        result = annotated(result, opened, earlier, **about)
        write_alignment(out, replace(result, volume=None))
        if volume is None:
            checkpoint.clear()
        errors = Errors.of(result, opened)
        if volume is not None and result.volume is not None:
            grid = default_grid(opened.cropped().geometry)
            made = provenance(
                command=result.command, scan=opened, alignment=result, method=method, grid=grid
            )
            write_volume(volume, result.volume, grid, provenance=made, progress=progress)
            checkpoint.clear()
        if report is not None:
            from clra.app.report.html_report import write_report

            findings = findings_of(
                result,
                opened,
                volume=result.volume,
                device=console.device,
                progress=progress,
                **limits,
            )
            write_report(report, findings)
    values, text = summary_of(result, errors)
    more = {"volume": volume, "report": report}
    written = {"file": out, **{name: path for name, path in more.items() if path}}
    names = " and ".join(str(path) for path in written.values())
    console.summary({**written, **values}, f"wrote {names}\n{text}")
