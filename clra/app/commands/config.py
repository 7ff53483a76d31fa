"""Write a configuration file to begin with."""

from pathlib import Path
from typing import Annotated

import typer

from clra.app.console import Console


def config(
    console: Console,
    context: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="OUT.toml", help="File to write.")],
) -> None:
    """Write a configuration file with every option, its meaning and its default, as comments.

    Other commands take it by --config: a table for each command, and above them options of all.
    The command line has the last word.

    Examples
    --------
      clra config scan.toml
      clra align --config scan.toml
    """
    from clra.app.session.configuration import CONFIGURED, template
    from clra.io.atomic import atomic_path

    assert context.parent is not None  # the group of all commands
    commands = context.parent.command.commands  # type: ignore[attr-defined]
    text = template({name: commands[name] for name in CONFIGURED})
    with atomic_path(out) as temporary:
        temporary.write_text(text, encoding="utf-8")
    console.summary({"file": out}, f"wrote {out}")
