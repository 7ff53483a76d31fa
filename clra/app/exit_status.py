"""What an error means to the caller of a command: an exit status and one line on stderr."""

import errno
import shlex
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

from typer.core import TyperGroup

from clra.errors import InputError

if TYPE_CHECKING:
    from clra.methods.execution.checkpoint import Checkpoint

OK = 0
FAILED = 1
BAD_INPUT = 2
INTERRUPTED = 130

_DEBUG = "--debug"
_BUG = "this is a bug in clra, please report it with all that is printed here"


_COMMAND: ContextVar[str] = ContextVar("command", default="")


def command_line() -> str:
    """Return the command line that is being run, as a shell would take it."""
    return _COMMAND.get()


@contextmanager
def as_command(words: Sequence[str]) -> Iterator[None]:
    """Let :func:`command_line` tell another one within a block: a step of a longer command."""
    token = _COMMAND.set(shlex.join(["clra", *words]))
    try:
        yield
    finally:
        _COMMAND.reset(token)


class InterruptedCommandError(Exception):
    """Ctrl-C; the message says what was kept.

    Parameters
    ----------
    kept : str
        One line.
    """

    def __init__(self, kept: str = "nothing was written") -> None:
        super().__init__(f"interrupted: {kept}")


@contextmanager
def keeping(checkpoint: "Checkpoint") -> Iterator[None]:
    """Say what of a block's finished work is on disk, whatever ends it early."""
    try:
        yield
    except KeyboardInterrupt:
        if not checkpoint.kept:
            raise
        raise InterruptedCommandError(_goes_on(checkpoint)) from None
    except Exception as error:
        if checkpoint.kept and not isinstance(error, InterruptedCommandError):
            error.add_note(_goes_on(checkpoint))
        raise


def _goes_on(checkpoint: "Checkpoint") -> str:
    return f"{checkpoint.folder} keeps {checkpoint.kept}, --resume goes on from there"


def verdict(error: BaseException) -> tuple[int, str]:
    """Exit status of an error and the line that tells a user what to do.

    Parameters
    ----------
    error : BaseException
        As it left a command.

    Returns
    -------
    status : int
        2 for bad input or usage, 1 for a failure of the machine or of clra itself, 130 for Ctrl-C
        and SIGTERM.
    line : str
        Without a line break.
    """
    status, text = _verdict(error)
    notes = () if status == BAD_INPUT else getattr(error, "__notes__", ())
    return status, " ".join("; ".join((text, *notes)).split())


def _verdict(error: BaseException) -> tuple[int, str]:
    if isinstance(error, (KeyboardInterrupt, InterruptedCommandError)):
        return INTERRUPTED, str(error) or str(InterruptedCommandError())
    if hasattr(error, "format_message"):  # typer's own: an unknown option, a missing argument
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "clra"
        return BAD_INPUT, f"{error.format_message()} (see {command} --help)"
    kind = type(error).__name__
    if kind == "KernelBuildError":
        first = str(error).partition("\n")[0]
        return FAILED, (
            f"{first}: update the device's driver or choose another with --device "
            f"(clra devices lists them; {_DEBUG} shows the compiler's log)"
        )
    if kind in ("DeviceError", "DeviceMemoryError", "OutputError", "ClusterError"):
        return FAILED, str(error)
    if isinstance(error, OSError):
        return _of_system(error)
    if isinstance(error, MemoryError) or _is_opencl(error, "MemoryError"):
        place = "this machine" if isinstance(error, MemoryError) else "the device"
        return FAILED, (
            f"the memory of {place} is full: close other programs or work at a lower resolution "
            f"(clra info tells what each needs): {error}"
        )
    if _is_opencl(error, "Error") and not _is_opencl(error, "LogicError"):
        return FAILED, f"the OpenCL device failed: {error}: try another with --device"
    if isinstance(error, InputError):
        return BAD_INPUT, str(error)
    return FAILED, f"{_BUG}: {kind}: {error}"


def _of_system(error: OSError) -> tuple[int, str]:
    name = f"{error.filename}: " if error.filename else ""
    what = error.strerror or str(error)
    if isinstance(error, (FileNotFoundError, IsADirectoryError, NotADirectoryError)):
        return BAD_INPUT, f"{name}{what}"
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return FAILED, f"{name}{what}: free some space or write elsewhere"
    if isinstance(error, PermissionError):
        return FAILED, f"{name}{what}: check who may read and write there"
    return FAILED, f"{name}{what}"


def _as_found(error: Exception, given: Sequence[str]) -> str:
    """Quote what was given for an option that typer refused: its message does not."""
    for option in getattr(getattr(error, "param", None), "opts", ()):
        for position, word in enumerate(given[:-1]):
            if word == option:
                return f", found {given[position + 1]!r}"
    return ""


def _is_opencl(error: BaseException, name: str) -> bool:
    """Whether it is pyopencl's exception of that name, without importing pyopencl."""
    module = sys.modules.get("pyopencl")
    return module is not None and isinstance(error, getattr(module, name))


def _show_warning(
    message: Warning | str, category: type[Warning], *_: object, **__: object
) -> None:
    # pyopencl warns of non-empty compiler logs, and some compilers always write one.
    if category.__name__ != "CompilerWarning":
        print("warning:", " ".join(str(message).split()), file=sys.stderr)


@contextmanager
def _plain_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        yield


@contextmanager
def _ended_like_ctrl_c() -> Iterator[None]:
    """Let SIGTERM, which batch systems send before they kill, do what Ctrl-C does."""
    if threading.current_thread() is not threading.main_thread():
        yield  # which alone may say what signals do
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class Group(TyperGroup):
    """Commands whose errors become one line on stderr and an exit status."""

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> Any:
        """Run a command and exit with its status."""
        given = list(sys.argv[1:] if args is None else args)
        # Wanted mostly after something failed, so it may be added at either end of the line.
        debug = _DEBUG in given
        _COMMAND.set(shlex.join(["clra", *given]))
        try:
            with _plain_warnings(), _ended_like_ctrl_c():
                status = super().main(
                    [argument for argument in given if argument != _DEBUG],
                    prog_name or "clra",
                    complete_var,
                    standalone_mode=False,
                    windows_expand_args=windows_expand_args,
                    **extra,
                )
        except Exception as error:
            status, line = verdict(error)
            if debug or line.startswith(_BUG):
                traceback.print_exc()
            kind = "" if status == INTERRUPTED else "error: "
            print(f"{kind}{line}{_as_found(error, given)}", file=sys.stderr)
        sys.exit(status or OK)

    def list_commands(self, ctx: Any) -> list[str]:
        """Name the commands in the order of work; older typers sort them."""
        return list(self.commands)

    def invoke(self, ctx: Any) -> Any:
        """Run a command; Ctrl-C becomes an error like others, before typer sees it."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:
            raise InterruptedCommandError() from error
