"""Simulate, align and reconstruct a small scan."""

from pathlib import Path
from typing import Annotated

import typer

from clra.app.console import Console


def demo(
    console: Console,
    out: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FOLDER", help="Where to keep the files."),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Of all random numbers.", min=0)] = 0,
) -> None:
    """Simulate, align and reconstruct a small scan.

    A space-filling scan whose radiographs jitter and drift by up to 10 pixels and grow and shrink
    by up to 0.2 %. Takes less than a minute on a laptop without a GPU. Without --output the
    files go to a new folder for temporary files.

    Examples
    --------
      clra demo
      clra demo --output demo --device nvidia
    """
    from clra.app.demonstration import run_demo

    with console.progress() as progress:
        shown = run_demo(out, seed=seed, device=console.device, progress=progress)
    console.result(shown.values(), shown.text())
