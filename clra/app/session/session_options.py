"""Options that every command has."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from clra.app.session.configuration import take_defaults


@dataclass(frozen=True)
class Session:
    """What surrounds a command."""

    config: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.toml",
            callback=take_defaults,
            is_eager=True,
            help="Options from a file; clra config writes one.",
        ),
    ] = None
    log: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Append to FILE what is done, with the time."),
    ] = None
