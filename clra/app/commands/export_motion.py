"""Write a motion for another program."""

from pathlib import Path
from typing import Annotated

import typer

from clra.app.console import Console, Reading
from clra.errors import InputError


def export_motion(
    console: Console,
    reading: Reading,
    motion: Annotated[Path, typer.Argument(metavar="MOTION.h5", help="Motion from clra align.")],
    out: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="File to write.")],
    to: Annotated[
        str,
        typer.Option(
            metavar="astra|rtk|cil|tigre|nabu|imod|csv", help="Program that is to read it."
        ),
    ],
    scan: Annotated[
        Path | None,
        typer.Option(metavar="SCAN", help="The scan; all but imod and csv need its geometry."),
    ] = None,
) -> None:
    """Write a motion for another program.

    astra: vectors of cone_vec, .npy. rtk: geometry, .xml. cil, tigre: arrays by name, .npz. These
    describe where source and detector were, with the motion. nabu: translation_movements_file.
    imod: .xf, which aligns the images. csv: shifts towards higher columns and rows in pixels, and
    magnifications; clra align --start reads it. Rotations of the sample are for astra, rtk, cil
    and csv.

    Examples
    --------
      clra export-motion motion.h5 --to csv -o motion.csv
      clra export-motion motion.h5 --to astra --scan scan.nxs -o vectors.npy
    """
    from clra.app.annotations import matched
    from clra.io.alignment_file import read_alignment
    from clra.io.atomic import ensure_writable
    from clra.io.motion_formats.motion_export import PROGRAMS, WITH_SCAN
    from clra.io.motion_formats.motion_export import export_motion as write_motion

    if to not in PROGRAMS:
        raise InputError(f"--to: found {to!r}, expected one of {', '.join(PROGRAMS)}")
    if scan is None and to in WITH_SCAN:
        raise InputError(f"--scan: found none, expected the scan to export to {to}")
    result = read_alignment(motion)
    ensure_writable(out, keep=(motion, scan))
    geometry = None
    if scan is not None:
        geometry = matched(reading.scan(scan), result, motion, reading.geometry()).geometry
    write_motion(out, to, result.motion, geometry=geometry, valid_views=result.valid_views)
    values = {"file": out, "to": to, "views": result.motion.views}
    console.summary(values, f"wrote {out}: {result.motion.views} views for {to}")
