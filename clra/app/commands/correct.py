"""Write a scan of corrected radiographs."""

from pathlib import Path
from typing import Annotated

import typer

from clra.app.console import Console, Memory, Reading, ScanPath
from clra.app.correcting import Correcting
from clra.app.planning.cluster_option import Cluster


def correct(
    console: Console,
    reading: Reading,
    memory: Memory,
    correcting: Correcting,
    scan: ScanPath,
    motion: Annotated[
        Path, typer.Option(metavar="MOTION.h5", help="Motion to correct, from clra align.")
    ],
    out: Annotated[
        Path, typer.Option("--output", "-o", metavar="CORRECTED.nxs", help="Scan to write.")
    ],
    cluster: Cluster = None,
) -> None:
    """Write a scan of corrected radiographs.

    For programs that cannot take a motion: each radiograph is resampled, once. clra itself
    reconstructs sharper from the scan as it is, with --motion. Views that the alignment flagged,
    blank or wrong ones, keep their places in the file, but are marked invalid (image_key 3): clra
    and other readers of NXtomo leave them out.

    Examples
    --------
      clra correct scan.nxs --motion motion.h5 -o corrected.nxs
      clra correct scan.nxs --motion motion.h5 -o corrected.nxs --cluster local:4
    """
    from clra.app.annotations import alignment_for
    from clra.app.exit_status import command_line
    from clra.app.scan_description import views_flagged
    from clra.io.atomic import ensure_writable
    from clra.io.provenance import provenance
    from clra.io.scan_files import write_scan
    from clra.methods.correction import correct as correct_scan
    from clra.methods.preparation import prepared, used_views

    limits = memory.limits()
    opened = reading.scan(scan)
    opened, alignment = alignment_for(opened, motion, reading.geometry())
    views, rows, columns = opened.shape
    ensure_writable(out, (scan, motion), 4 * views * rows * columns)
    with console.progress() as progress:
        opened = prepared(opened, correcting.options(), progress=progress)
        valid_views = used_views(opened, alignment.valid_views)
        corrected = correct_scan(
            opened, alignment.motion, console.device, cluster=cluster, **limits
        )
        made = provenance(
            command=command_line(), scan=opened, alignment=alignment, method="correct"
        )
        write_scan(
            out,
            corrected,
            valid_views=valid_views,
            provenance=made,
            progress=progress,
        )
    invalid = () if valid_views is None else tuple((~valid_views).nonzero()[0].tolist())
    marked = f"\n{views_flagged(invalid)}; marked invalid, readers leave them out"
    console.summary(
        {"file": out, "shape": opened.shape, "invalid": invalid},
        f"wrote {out}: {views} corrected radiographs of {rows} x {columns}"
        + marked * bool(invalid),
    )
