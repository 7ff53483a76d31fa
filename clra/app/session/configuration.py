"""Options of commands from a file, and such a file to begin with."""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from textwrap import wrap
from typing import Any

import typer

from clra.errors import InputError

# Options that say something of one run only, or of the file itself.
_NOT_IN_FILES = {"config", "help", "resume", "no_overwrite"}
# Commands that a file is of use for, in the order of work.
CONFIGURED = ("import", "align", "reconstruct", "report")


def take_defaults(context: typer.Context, value: Path | None) -> Path | None:
    """Make a file's options the defaults of the command that is run; a callback of ``--config``."""
    if value is not None:
        group: Any = context.parent and context.parent.command
        commands = getattr(group, "commands", {context.info_name: context.command})
        context.default_map = options_for(str(context.info_name), value, commands)
    return value


def options_for(
    command: str, path: str | os.PathLike[str], commands: Mapping[str, Any]
) -> dict[str, Any]:
    """Read the options of a command.

    Parameters
    ----------
    command : str
        Its name, such as "align".
    path : path-like
        TOML: a table such as [align] for each command, whose keys are its options and arguments as
        on the command line, with - or _; options above the first table are of every command that
        has them.
    commands : mapping of str to click.Command
        All there are.

    Returns
    -------
    dict
        By the names of the command's parameters.

    Raises
    ------
    InputError
        If the file cannot be read, or holds what no command knows.
    """
    try:
        with open(path, "rb") as file:
            told = tomllib.load(file)
    except OSError as error:
        raise InputError(f"{os.fspath(path)}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{os.fspath(path)}: cannot be read as TOML: {error}") from error
    known = {name: {p.name: p for p in one.params} for name, one in commands.items()}
    chosen: dict[str, Any] = {}
    for key, value in told.items():
        if isinstance(value, dict):
            if key not in known:
                raise _unknown(path, f"[{key}]", "command", key, known)
            own = {_plain(name): v for name, v in value.items()}
            for name in own:
                if name not in known[key] or name in _NOT_IN_FILES:
                    raise _unknown(path, f"[{key}] {name}", "option", name, known[key])
            if key == command:
                chosen |= own
            continue
        name = _plain(key)
        everywhere = {option for options in known.values() for option in options}
        if name not in everywhere or name in _NOT_IN_FILES:
            raise _unknown(path, key, "option", name, everywhere)
        if name in known.get(command, {}):
            chosen.setdefault(name, value)
    return {name: _text(value) for name, value in chosen.items()}


def template(commands: Mapping[str, Any]) -> str:
    """Return a file of all options with their meanings and defaults, as comments.

    Parameters
    ----------
    commands : mapping of str to click.Command
        By name.
    """
    lines = [
        "# Options of clra's commands: clra align --config THIS.toml, clra run --config THIS.toml.",
        "# Remove the # before an option to set it. The command line has the last word.",
        "# Options above the first table are of every command that has them.",
    ]
    for name, command in commands.items():
        lines += ["", f"[{name}]"]
        for parameter in command.params:
            if parameter.name in _NOT_IN_FILES:
                continue
            meaning = getattr(parameter, "help", None) or "Argument."
            lines += [f"# {line}" for line in wrap(meaning, 96)]
            value = parameter.get_default(typer.Context(command), call=False)
            lines.append(f"# {_key(parameter)} = {_toml(value)}")
    return "\n".join(lines) + "\n"


def _key(parameter: Any) -> str:
    return str(parameter.name).replace("_", "-")


def _plain(name: str) -> str:
    return name.replace("-", "_")


def _text(value: Any) -> Any:
    """Numbers as they would be typed: the option converts them."""
    if isinstance(value, list):
        return [_text(item) for item in value]
    return value if isinstance(value, (bool, str)) else str(value)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float)):
        return repr(value)
    return '"{}"'.format("" if value is None else str(value).replace("\\", "\\\\"))


def _unknown(
    path: str | os.PathLike[str], field: str, kind: str, name: str, known: Any
) -> InputError:
    near = difflib.get_close_matches(name, [str(one) for one in known], 1)
    expected = f"{kind} {near[0].replace('_', '-')}?" if near else f"one that clra has: {kind}s"
    return InputError.at(path, field, f"an unknown {kind}", expected)
