"""The command line."""

from typing import Annotated

import typer

from clra.app.commands.align import align
from clra.app.commands.config import config
from clra.app.commands.correct import correct
from clra.app.commands.demo import demo
from clra.app.commands.devices import devices
from clra.app.commands.export_motion import export_motion
from clra.app.commands.import_scan import import_scan
from clra.app.commands.info import info
from clra.app.commands.reconstruct import reconstruct
from clra.app.commands.report import report
from clra.app.commands.run import run
from clra.app.commands.simulate import simulate
from clra.app.console import as_written, command
from clra.app.exit_status import Group

app = typer.Typer(
    cls=Group,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


_HELP = """Motion correction for cone-beam X-ray micro-CT.

clra estimates how each radiograph of a scan moved, from the radiographs alone (re-projection
alignment), and reconstructs volumes with that motion corrected. It runs on any OpenCL 1.2 device.

Examples:
  clra demo                                        try it on a simulated scan
  clra info scan.nxs                               what a scan is and what it will take
  clra align scan.nxs -o motion.h5 --report report.html
  clra reconstruct scan.nxs --motion motion.h5 -o volume.h5
  clra run scan.nxs -o results                     all of it in one go
"""


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print("clra", version("clra"))
        raise typer.Exit()


@app.callback(invoke_without_command=True, help=as_written(_HELP))
def _clra(
    context: typer.Context,
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Print a traceback when something fails.")
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())


command(app, "devices")(devices)
command(app, "info")(info)
command(app, "import", writes=True)(import_scan)
command(app, "simulate", writes=True)(simulate)
command(app, "align", writes=True)(align)
command(app, "reconstruct", writes=True)(reconstruct)
command(app, "correct", writes=True)(correct)
command(app, "report", writes=True)(report)
command(app, "export-motion", writes=True)(export_motion)
command(app, "run")(run)
command(app, "config")(config)
command(app, "demo")(demo)


def main() -> None:
    """Entry point of the `clra` command."""
    app()


if __name__ == "__main__":
    main()
