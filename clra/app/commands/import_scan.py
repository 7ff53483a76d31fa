"""Make a scan of frames."""

import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from clra.app.arguments import detector, pixel
from clra.app.console import Console


def import_scan(
    console: Console,
    frames: Annotated[
        list[str],
        typer.Argument(
            metavar="FRAMES...", help="TIFF or headerless binary files, or a pattern, in quotes."
        ),
    ],
    out: Annotated[Path, typer.Option("--output", "-o", metavar="SCAN.nxs", help="Scan to write.")],
    angles: Annotated[
        str,
        typer.Option(
            metavar="FILE",
            help="Text file with an angle [degree] a line, or START:STOP:COUNT with both ends "
            "included.",
        ),
    ],
    pixel_size: Annotated[
        str, typer.Option(metavar="MM", help="Pixel of the detector; ROW,COLUMN where they differ.")
    ],
    source_distance: Annotated[
        float | None, typer.Option(metavar="MM", help="Source to rotation axis.")
    ] = None,
    detector_distance: Annotated[
        float | None, typer.Option(metavar="MM", help="Rotation axis to detector.")
    ] = None,
    parallel: Annotated[bool, typer.Option("--parallel", help="The beam is parallel.")] = False,
    flat: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FILE",
            help="Frames of the open beam, or a pattern in quotes; may be given again.",
        ),
    ] = None,
    flat_after: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FILE",
            help="The same, taken after the radiographs: flats drift linearly from first to last.",
        ),
    ] = None,
    dark: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FILE", help="Frames without beam, or a pattern in quotes; may be given again."
        ),
    ] = None,
    kind: Annotated[
        str,
        typer.Option(
            metavar="counts|transmission|line-integrals",
            help="What frames hold; transmission (I/I0) and line integrals (-log of it) have no "
            "flats and darks.",
        ),
    ] = "counts",
    shape: Annotated[
        str | None, typer.Option(metavar="ROWSxCOLUMNS", help="Of headerless frames.")
    ] = None,
    dtype: Annotated[
        str, typer.Option(metavar="TYPE", help="Of headerless pixels, as numpy calls it.")
    ] = "uint16",
    byteorder: Annotated[
        str, typer.Option(metavar="little|big", help="Of headerless pixels.")
    ] = "little",
    header: Annotated[
        int, typer.Option(metavar="BYTES", help="To skip at the start of each binary file.")
    ] = 0,
    z_translation: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="How far the sample is raised [mm], a line a view."),
    ] = None,
    centre_offset: Annotated[
        float,
        typer.Option(metavar="PIXEL", help="Column of the axis, from the detector's middle."),
    ] = 0.0,
    rotation: Annotated[
        str,
        typer.Option(
            metavar="ccw|cw", help="How the sample turns as its angle grows, seen from above."
        ),
    ] = "ccw",
) -> None:
    """Make a scan of TIFF or raw frames.

    Row 0 of a frame is its top; columns count to the right as seen from the source.

    Examples
    --------
      clra import 'scan/*.tif' --angles angles.txt --source-distance 4.36
        --detector-distance 432 --pixel-size 0.139 --flat flat.tif --dark dark.tif -o scan.nxs
      clra import frames.raw --shape 3040x3040 --angles 0:359.5:720 --source-distance 7.07
        --detector-distance 328.5 --pixel-size 0.139 --flat flat.raw -o scan.nxs
    """
    from clra.io.frames.frame_import import import_frames

    with console.progress() as report:
        made = import_frames(
            out,
            frames,
            angles,
            source_distance=source_distance,
            detector_distance=detector_distance,
            pixel_size=pixel(pixel_size),
            parallel=parallel,
            flats=flat or (),
            flats_after=flat_after or (),
            darks=dark or (),
            kind=kind,
            shape=detector("--shape", shape) if shape else None,
            dtype=dtype,
            byteorder=byteorder,
            header=header,
            z_translation=z_translation,
            centre_offset=centre_offset,
            rotation=rotation,
            name=out.stem,
            progress=report,
        )
    rows, columns = made.shape
    first, last = made.angles_deg
    console.summary(
        {"file": out, **asdict(made)},
        f"wrote {out}: {made.views} radiographs of {rows} x {columns}, {made.flats} flats, "
        f"{made.darks} darks; the sample turns from {first:g} to {last:g} degrees",
    )
    if kind == "counts" and not made.flats:
        warnings.warn(
            f"{out} has no flats: every command that reads it needs --white COUNTS, and 1 if these "
            "radiographs are transmission already",
            stacklevel=1,
        )
