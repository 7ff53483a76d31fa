"""Do all the work on a scan in one go."""

from pathlib import Path
from typing import Annotated, Any

import typer

from clra.app.console import Console, Memory
from clra.errors import InputError


def run(
    console: Console,
    memory: Memory,
    context: typer.Context,
    scan: Annotated[
        list[str],
        typer.Argument(metavar="SCAN...", help="NXtomo file, or what clra import takes."),
    ],
    out: Annotated[
        Path, typer.Option("--output", "-o", metavar="FOLDER", help="Where results go.")
    ],
    volume: Annotated[
        str,
        typer.Option(metavar="NAME", help="Volume in that folder; the suffix chooses the format."),
    ] = "volume.h5",
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE.toml", help="Options of import, align, reconstruct and report."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on where this command was interrupted.")
    ] = False,
) -> None:
    """Import, align, reconstruct and report in one go.

    The same as the single commands, with their defaults or the options of a configuration file
    (clra config writes one). The folder then has scan.nxs, unless that was given, motion.h5, the
    volume and report.html.

    Examples
    --------
      clra run scan.nxs -o results
      clra run Lego.xtekct -o results --volume volume.zarr
      clra run 'frames/*.tif' -o results --config scan.toml
    """
    from clra.app.arguments import volume_file
    from clra.app.exit_status import as_command
    from clra.app.session.overall_progress import STEPS, several_steps
    from clra.io.scanners.recognise import recognise_or_none

    volume_file(out / volume)
    if out.exists() and not out.is_dir():
        raise InputError.at(out, "--output", "a file", "a folder, which need not be there yet")
    out.mkdir(parents=True, exist_ok=True)
    assert context.parent is not None  # the group of all commands
    group: Any = context.parent.command
    common = [] if config is None else ["--config", str(config)]
    common += ["--quiet"] if console.quiet or console.json else []
    working = [] if console.device is None else ["--device", console.device]
    for name in ("max_device_memory", "max_host_memory"):
        if getattr(memory, name) is not None:
            working += [f"--{name.replace('_', '-')}", getattr(memory, name)]

    def step(name: str, made: Path, *words: str) -> None:
        unfinished = Path(f"{made}.resume").exists()
        if resume and made.exists() and not unfinished:
            return
        overall.begin(name)
        given = [*words, "-o", str(made), *common]
        given += ["--resume"] if resume and unfinished else []
        with as_command([name, *given]), group.make_context("clra", [name, *given]) as inner:
            group.invoke(inner)

    given = Path(scan[0])
    motion, page = out / "motion.h5", out / "report.html"
    ready = given.suffix.lower() in (".nxs", ".nx", ".h5", ".hdf5")
    importing = len(scan) > 1 or not ready or recognise_or_none(given) is not None
    steps = {name: work for name, work in STEPS.items() if importing or name != "import"}
    with several_steps(steps) as overall:
        if importing:
            given = out / "scan.nxs"
            step("import", given, *scan)
        step("align", motion, str(given), *working)
        step("reconstruct", out / volume, str(given), "--motion", str(motion), *working)
        step("report", page, str(motion), "--scan", str(given), *working)
    values = {"scan": given, "motion": motion, "volume": out / volume, "report": page}
    console.summary(values, f"look at {page}")
