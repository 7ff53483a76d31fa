"""Groups of options that several commands share, and where results go."""

import ctypes
import inspect
import json
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast, get_type_hints

import numpy as np
import typer

from clra.app import progress_bar
from clra.app.exit_status import command_line
from clra.app.session.log_file import logged, result_logged, stages_logged
from clra.app.session.session_options import Session
from clra.errors import InputError
from clra.findings import collected, collected_so_far

if TYPE_CHECKING:
    from clra.app.session.overall_progress import Part
    from clra.io.scanners.scanner_options import ScannerOptions
    from clra.io.scanners.scanner_scan import ScannerScan
    from clra.model.motion import Motion
    from clra.model.scan import Scan
    from clra.progress import ProgressCallback


ScanPath = Annotated[
    Path, typer.Argument(metavar="SCAN", help="NXtomo file, or a scanner's metadata or folder.")
]


@dataclass(frozen=True)
class Console:
    """How a command was asked to work and to speak."""

    device: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="OpenCL device: part of its name, or its index (see clra devices); align, "
            "reconstruct and correct take all as well.",
        ),
    ] = None
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")] = False
    json: Annotated[bool, typer.Option("--json", help="Print the results as one JSON object.")] = (
        False
    )

    @contextmanager
    def progress(self, parts: Sequence["Part"] = ()) -> Iterator["ProgressCallback"]:
        """Show progress on stderr while a block with such parts runs, unless quiet; and log it."""
        with progress_bar.shown(self.quiet, parts) as report:
            yield stages_logged(report)

    def result(self, values: Mapping[str, Any], text: str) -> None:
        """Print what a command was run for: JSON, or text for people."""
        print(to_json(values) if self.json else text)
        result_logged(text)

    def summary(self, values: Mapping[str, Any], text: str) -> None:
        """Print what a command that wrote a file has to say of it, unless quiet.

        As JSON it has the findings of the whole command, too.
        """
        if self.json or not self.quiet:
            self.result({**values, "warnings": collected_so_far(outermost=True)}, text)


@dataclass(frozen=True)
class Writing:
    """How a command may write."""

    no_overwrite: Annotated[
        bool, typer.Option("--no-overwrite", help="Refuse to replace files that are there.")
    ] = False


@dataclass(frozen=True)
class Memory:
    """How much memory a command may use."""

    max_device_memory: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE", help="On the device, such as 8G; by default 3/4 of what it has."
        ),
    ] = None
    max_host_memory: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE",
            help="On the host, such as 16G; by default half of what is free. What has no room goes "
            "to temporary files. A CPU device uses half of it.",
        ),
    ] = None

    def limits(self) -> dict[str, Any]:
        """Return the options in bytes, by name."""
        from clra.app.arguments import memory_size

        if self.max_host_memory is not None:
            _give_freed_memory_back()
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        return {
            name: None if text is None else memory_size(f"--{name.replace('_', '-')}", text)
            for name, text in given.items()
        }


def _give_freed_memory_back() -> None:
    """Make glibc return large freed arrays to the system at once, where there is glibc.

    By itself it raises the size from which it does so with every array that is freed, up to 32 MiB,
    and then keeps as much again as is in use. This is our process, so we may tell it.
    """
    threshold = -3  # M_MMAP_THRESHOLD of malloc.h
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(threshold, 1 << 18)


@dataclass(frozen=True)
class Reading:
    """How to read a scan that leaves something open."""

    entry: Annotated[
        str | None, typer.Option(metavar="NAME", help="Which scan, if the file holds several.")
    ] = None
    rotation: Annotated[
        str | None,
        typer.Option(
            metavar="ccw|cw",
            help="How the sample turns as its angle grows, seen from above; by default ccw, or as "
            "the scanner's metadata have it.",
        ),
    ] = None
    flip: Annotated[
        str | None,
        typer.Option(
            metavar="columns|rows|both",
            help="The radiographs are stored mirrored against what the file says.",
        ),
    ] = None
    centre_offset: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMN[,ROW]",
            help="Where the axis is seen, and the source's perpendicular, in pixels from the "
            "detector's middle, in place of the file's.",
        ),
    ] = None
    source_distance: Annotated[
        float | None,
        typer.Option(metavar="MM", help="Source to rotation axis, in place of the file's."),
    ] = None
    parallel: Annotated[
        bool, typer.Option("--parallel", help="The beam is parallel: put the source far away.")
    ] = False
    white: Annotated[
        float | None,
        typer.Option(metavar="COUNTS", help="Counts of the open beam, in place of flat frames."),
    ] = None

    def scanner(self, path: Path) -> "ScannerScan | None":
        """Read the metadata of a scanner; None of an NXtomo file."""
        from clra.io.scanners.recognise import read_scanner

        return read_scanner(path, self._options())

    def start_motion(self, path: Path, scan: "Scan") -> "Motion | None":
        """Read a motion of a table, or that a scanner's software measured; None of other files."""
        from clra.io.motion_formats.motion_csv import is_motion_csv, read_motion_csv
        from clra.io.scanners.recognise import holds_start_motion, read_start_motion

        if is_motion_csv(path):
            motion = read_motion_csv(path, scan.geometry)[0]
            if motion.views != scan.views:
                there = f"{scan.views} of the scan"
                raise InputError.at(path, "view", f"{motion.views} views", there)
            return motion
        if not holds_start_motion(path):
            return None
        return read_start_motion(path, scan.views, self._options())

    def _options(self) -> "ScannerOptions":
        from clra.io.scanners.scanner_options import ScannerOptions

        return ScannerOptions(
            rotation=self.rotation,
            source_distance=self.source_distance,
            parallel=self.parallel,
            white=self.white,
            flip=self.flip,
            centre_offset=self._axis(),
        )

    def _axis(self) -> tuple[float, ...] | None:
        from clra.app.arguments import axis_place

        text = self.centre_offset
        return None if text is None else axis_place("--centre-offset", text)

    def scan(self, path: Path) -> "Scan":
        """Open a scan; its radiographs are read when they are needed."""
        from clra.app.plausible import warn_of_scale
        from clra.io.scan_files import read_scan

        scan = read_scan(
            path,
            entry=self.entry,
            rotation=self.rotation,
            source_distance=self.source_distance,
            parallel=self.parallel,
            white=self.white,
            flip=self.flip,
            centre_offset=self._axis(),
        )
        warn_of_scale(scan)
        return scan

    def geometry(self) -> str:
        """Say by which options the geometry was told, if by any."""
        options = [f for f in fields(self) if f.name not in ("entry", "white")]
        given = [(f.name, getattr(self, f.name)) for f in options]
        changed = [(n, v) for (n, v), f in zip(given, options, strict=True) if v != f.default]
        words = (f"--{n.replace('_', '-')}" + ("" if v is True else f" {v}") for n, v in changed)
        return " ".join(words) or "no --rotation, --source-distance or --parallel"


def to_json(values: Mapping[str, Any]) -> str:
    """Write numpy values, dataclasses and paths as JSON; what is not finite becomes null."""
    return json.dumps(_plain(values), allow_nan=False, ensure_ascii=False)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    return str(value)


def command(
    app: typer.Typer, name: str, *, writes: bool = False
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register a function as a command; groups of options among its parameters are spread out.

    Parameters
    ----------
    app : typer.Typer
        Where to.
    name : str
        What the command is called.
    writes : bool
        Whether it writes files: it has the options of :class:`Writing`, and its outputs are its own
        until it ends.

    Returns
    -------
    callable
        Decorator. A parameter whose type is a dataclass becomes one option for each field of it,
        the others are typer's. The docstring is the command's help.
    """

    def register(function: Callable[..., None]) -> Callable[..., None]:
        own: list[inspect.Parameter] = []
        shared: list[inspect.Parameter] = []
        groups: dict[str, type[Any]] = {}
        for parameter in inspect.signature(function, eval_str=True).parameters.values():
            if is_dataclass(parameter.annotation):
                group = cast(type[Any], parameter.annotation)
                groups[parameter.name] = group
                shared += _options(group)
            else:
                own.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
        if writes:
            shared += _options(Writing)
        named = {parameter.name for parameter in own}
        shared += [option for option in _options(Session) if option.name not in named]

        def run(**values: Any) -> None:
            for key, group in groups.items():
                values[key] = group(**{f.name: values.pop(f.name) for f in fields(group)})
            if "config" not in named:
                del values["config"]  # its callback has read it
            log = values.pop("log")
            if not writes:
                with logged(log, command_line()), collected():
                    function(**values)
                return
            from clra.io.claims import one_run

            writing = Writing(**{f.name: values.pop(f.name) for f in fields(Writing)})
            with logged(log, command_line()), one_run(overwrite=not writing.no_overwrite):
                with collected():
                    function(**values)

        # typer learns a command's options from its signature and its annotations.
        run.__signature__ = inspect.Signature([*own, *shared])  # type: ignore[attr-defined]
        run.__annotations__ = {p.name: p.annotation for p in [*own, *shared]}
        app.command(name, help=as_written(inspect.getdoc(function) or ""))(run)
        return function

    return register


def as_written(text: str) -> str:
    """Keep the lines of the examples in a help text: typer would fill them into a paragraph."""
    return re.sub(r"Examples:?\n(-+\n)?", "\b\nExamples:\n", text)


def _options(group: type[Any]) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    return [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=field.default,
            annotation=hints[field.name],
        )
        for field in fields(group)
    ]
