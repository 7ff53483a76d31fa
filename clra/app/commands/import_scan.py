"""Make a scan of frames, or of a scanner's files."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from clra.app.arguments import axis_place, detector, pixel, view_numbers
from clra.app.console import Console
from clra.errors import InputError
from clra.findings import warn

if TYPE_CHECKING:
    from clra.io.scanners.scanner_scan import ScannerScan


def import_scan(
    console: Console,
    frames: Annotated[
        list[str],
        typer.Argument(
            metavar="FRAMES...",
            help="A scanner's metadata or folder; or TIFF or headerless binary files, or a "
            "pattern, in quotes.",
        ),
    ],
    out: Annotated[Path, typer.Option("--output", "-o", metavar="SCAN.nxs", help="Scan to write.")],
    angles: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="Text file with an angle [degree] a line, or START:STOP:COUNT with both ends "
            "included; frames need it.",
        ),
    ] = None,
    pixel_size: Annotated[
        str | None,
        typer.Option(
            metavar="MM",
            help="Pixel of the detector; ROW,COLUMN where they differ; frames need it.",
        ),
    ] = None,
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
        str | None,
        typer.Option(
            metavar="counts|transmission|line-integrals",
            help="What frames hold, by default counts; transmission (I/I0) and line integrals "
            "(-log of it) have no flats and darks.",
        ),
    ] = None,
    shape: Annotated[
        str | None, typer.Option(metavar="ROWSxCOLUMNS", help="Of headerless frames.")
    ] = None,
    dtype: Annotated[
        str | None,
        typer.Option(
            metavar="TYPE", help="Of headerless pixels, as numpy calls it; by default uint16."
        ),
    ] = None,
    byteorder: Annotated[
        str | None,
        typer.Option(metavar="little|big", help="Of headerless pixels; by default little."),
    ] = None,
    header: Annotated[
        int | None, typer.Option(metavar="BYTES", help="To skip at the start of each binary file.")
    ] = None,
    z_translation: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="How far the sample is raised [mm], a line a view."),
    ] = None,
    centre_offset: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMN[,ROW]",
            help="Where the axis is seen, from the detector's middle [pixel]; of a scanner also "
            "the source's perpendicular.",
        ),
    ] = None,
    rotation: Annotated[
        str | None,
        typer.Option(
            metavar="ccw|cw",
            help="How the sample turns as its angle grows, seen from above; by default ccw, or as "
            "the scanner's metadata have it.",
        ),
    ] = None,
    flip: Annotated[
        str | None,
        typer.Option(
            metavar="columns|rows|both",
            help="A scanner's radiographs are stored mirrored against what its metadata say.",
        ),
    ] = None,
    axis: Annotated[
        str,
        typer.Option(
            metavar="vertical|horizontal",
            help="How the rotation axis runs in the frames; of a horizontal one the right end "
            "becomes the top.",
        ),
    ] = "vertical",
    exclude: Annotated[
        str | None,
        typer.Option(
            metavar="VIEWS", help="Radiographs to mark as invalid, from 0, such as 3,17,40-52."
        ),
    ] = None,
    white: Annotated[
        float | None,
        typer.Option(metavar="COUNTS", help="Of the open beam, in place of a scanner's own."),
    ] = None,
) -> None:
    """Make a scan of a scanner's files, or of TIFF or raw frames.

    Read are Nikon (.xtekct), Zeiss (.txrm), SkyScan (.log), GE phoenix (.pca), FleX-ray and TESCAN
    (scan settings.txt, .geom), HeliScan (expt*.in), CTSimU (.json) and Data Exchange (.h5), by
    file or folder. Of other frames row 0 is the top; columns count to the right as seen from the
    source.

    Examples
    --------
      clra import Lego.xtekct -o lego.nxs
      clra import tooth.h5 --parallel --centre-offset -24 -o tooth.nxs
      clra import 'scan/*.tif' --angles angles.txt --source-distance 4.36
        --detector-distance 432 --pixel-size 0.139 --flat flat.tif --dark dark.tif -o scan.nxs
      clra import frames.raw --shape 3040x3040 --angles 0:359.5:720 --source-distance 7.07
        --detector-distance 328.5 --pixel-size 0.139 --flat flat.raw -o scan.nxs
    """
    from clra.io.frames.frame_import import import_frames
    from clra.io.scanners.recognise import read_scanner, recognise_or_none
    from clra.io.scanners.scanner_options import ScannerOptions

    size = None if pixel_size is None else pixel(pixel_size)
    place = None if centre_offset is None else axis_place("--centre-offset", centre_offset)
    excluded = () if exclude is None else view_numbers("--exclude", exclude)
    pixels = detector("--shape", shape) if shape else None
    scanner = None
    if len(frames) == 1 and (angles is None or recognise_or_none(Path(frames[0])) is not None):
        options = ScannerOptions(
            rotation=rotation,
            flip=flip,
            centre_offset=place,
            source_distance=source_distance,
            detector_distance=detector_distance,
            pixel_size=size,
            parallel=parallel,
            angles=angles,
            z_translation=z_translation,
            white=white,
            shape=pixels,
        )
        scanner = read_scanner(frames[0], options)
    if scanner is not None:
        if flat or flat_after or dark:
            given = "--flat, --flat-after or --dark"
            raise InputError.at(scanner.path, given, "frames", "none: they come from the scan")
        framed = {"--kind": kind, "--dtype": dtype, "--byteorder": byteorder, "--header": header}
        for name, told in framed.items():
            if told is not None:
                raise InputError.at(scanner.path, name, told, "none: its metadata tell it")
        if axis != "vertical":
            raise InputError.at(scanner.path, "--axis", axis, "vertical: it is for frames")
        _import_scanner(console, scanner, out, excluded, flipped=flip is not None)
        return
    if angles is None or size is None:
        missing = "--angles" if angles is None else "--pixel-size"
        expected = "--angles FILE and --pixel-size MM: frames do not tell them"
        raise InputError.at(frames[0], missing, "nothing", expected)
    for name, value in (("--flip", flip), ("--white", white)):
        if value is not None:
            raise InputError.at(frames[0], name, value, "none: it is for a scanner's files")
    with console.progress() as report:
        made = import_frames(
            out,
            frames,
            angles,
            source_distance=source_distance,
            detector_distance=detector_distance,
            pixel_size=size,
            parallel=parallel,
            flats=flat or (),
            flats_after=flat_after or (),
            darks=dark or (),
            kind=kind or "counts",
            shape=pixels,
            dtype=dtype or "uint16",
            byteorder=byteorder or "little",
            header=header or 0,
            z_translation=z_translation,
            centre_offset=0.0 if place is None else place[0],
            rotation=rotation or "ccw",
            axis=axis,
            exclude=excluded,
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
    if kind in (None, "counts") and not made.flats:
        _warn_of_no_flats(out)


def _import_scanner(
    console: Console,
    scanner: "ScannerScan",
    out: Path,
    exclude: tuple[int, ...],
    *,
    flipped: bool,
) -> None:
    """Write what a scanner's files hold, and tell what was read and assumed."""
    from clra.app.scan_description import Facts, scanner_text, table
    from clra.io.scan_files import import_scanner

    with console.progress() as report:
        import_scanner(out, scanner, name=out.stem, exclude=exclude, progress=report)
    facts = Facts.of(scanner.described())
    values = {
        "file": out,
        "scan": facts,
        "scanner": {
            **scanner.contents(),
            "findings": [finding.as_dict() for finding in scanner.findings],
        },
    }
    text = f"wrote {out}\n{table(facts.lines())}\n\n{scanner_text(scanner)}"
    if scanner.start_motion is not None and not flipped:
        text += f"\nnote: clra align {out} --start {scanner.path} starts from its motion"
    console.summary(values, text)
    if not scanner.normalisable(white=None):
        _warn_of_no_flats(out)


def _warn_of_no_flats(out: Path) -> None:
    warn(
        "no-flats",
        f"{out} has no flats: every command that reads it needs --white COUNTS, and 1 if these "
        "radiographs are transmission already",
    )
