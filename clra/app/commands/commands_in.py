"""The commands that look at machines and scans, and make scans."""

import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from clra.app.arguments import detector, interval, pixel
from clra.app.console import Console, Memory, Reading, command

ScanPath = Annotated[Path, typer.Argument(metavar="SCAN", help="NXtomo file.")]


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


def simulate(
    console: Console,
    out: Annotated[Path, typer.Argument(metavar="OUT.nxs", help="Scan to write.")],
    trajectory: Annotated[
        str,
        typer.Option(
            metavar="circular|helix|double-helix|space-filling", help="How the source moves."
        ),
    ] = "space-filling",
    motion: Annotated[
        str, typer.Option(metavar="none|random|smooth|both", help="How the radiographs move.")
    ] = "none",
    shift: Annotated[
        str, typer.Option(metavar="LOW,HIGH", help="Least and greatest shift in pixels.")
    ] = "-10,8",
    magnification: Annotated[
        float, typer.Option(metavar="X", help="Magnifications lie within 1 -+ X, about.")
    ] = 0.0,
    views: Annotated[int, typer.Option(metavar="N", help="Number of radiographs.")] = 720,
    detector_size: Annotated[
        str, typer.Option("--detector", metavar="ROWSxCOLUMNS", help="Pixels of the detector.")
    ] = "384x256",
    phantom: Annotated[
        str,
        typer.Option(
            metavar="spheres|porous|wood",
            help="The paper's, texture everywhere, or hollow fibres along the axis.",
        ),
    ] = "spheres",
    noise: Annotated[
        float | None,
        typer.Option(metavar="I0", help="Photons a pixel of the open beam; none: no noise."),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Of all random numbers.", min=0)] = 0,
    keep_gauge: Annotated[
        bool,
        typer.Option(
            "--keep-gauge",
            help="Keep the part of the motion that a movement of the whole sample would explain as "
            "well, which no alignment can find.",
        ),
    ] = False,
) -> None:
    """Simulate a scan whose motion is known.

    Geometry in proportion to the paper's: source to axis 4.36 mm, to detector 436 mm. The
    file keeps the true motion, and `clra align` reports its errors against it.

    Examples
    --------
      clra simulate jitter.nxs --motion random
      clra simulate drift.nxs --trajectory helix --motion smooth --shift -9,9
      clra simulate noisy.nxs --motion both --magnification 0.002 --noise 10000
    """
    from clra.app.simulation import paper_like, sample, simulated_motion, simulated_scan
    from clra.io.atomic import ensure_writable
    from clra.io.scan_files import write_scan

    ensure_writable(out)
    geometry = paper_like(trajectory, views, detector("--detector", detector_size))
    truth = simulated_motion(
        motion,
        geometry,
        shift=interval("--shift", shift),
        magnification=magnification,
        seed=seed,
        keep_gauge=keep_gauge,
    )
    scan = simulated_scan(
        geometry, sample(phantom, geometry, seed), truth, noise=noise, seed=seed, name=out.stem
    )
    with console.progress() as report:
        write_scan(out, scan, progress=report)
    largest = float(max(abs(truth.shift_u).max(), abs(truth.shift_v).max()))
    console.summary(
        {"file": out, "views": views, "trajectory": trajectory, "largest_shift": largest},
        f"wrote {out}: {views} views of {geometry.rows} x {geometry.columns}, {trajectory}, "
        f"shifts up to {largest:.2f} pixel",
    )


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    command(app, "devices")(devices)
    command(app, "info")(info)
    command(app, "import")(import_scan)
    command(app, "simulate")(simulate)
