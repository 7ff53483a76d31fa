"""Simulate a scan."""

from pathlib import Path
from typing import Annotated

import typer

from clra.app.arguments import detector, interval
from clra.app.console import Console


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
