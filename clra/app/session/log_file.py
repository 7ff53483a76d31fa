"""What a command did, in a file with the time of day."""

from __future__ import annotations

import logging
import platform
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING

from clra.errors import OutputError

if TYPE_CHECKING:
    from clra.progress import Progress, ProgressCallback

_LOG = logging.getLogger("clra")
_FORMAT = "%(asctime)s %(levelname)-7s %(message)s"
_LOGGING: ContextVar[bool] = ContextVar("logging", default=False)


@contextmanager
def logged(path: Path | None, command: str) -> Iterator[None]:
    """Append to a log file what a block does: stages, warnings, and how it ended.

    Parameters
    ----------
    path : Path, optional
        Of the file; nothing is logged without one.
    command : str
        The command line.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    if path is None:
        yield
        return
    try:
        handler = logging.FileHandler(path, encoding="utf-8")
    except OSError as error:
        raise OutputError.writing(path, error.errno, error.strerror or str(error)) from error
    handler.setFormatter(logging.Formatter(_FORMAT))
    level, propagate = _LOG.level, _LOG.propagate
    _LOG.addHandler(handler)
    _LOG.setLevel(logging.INFO)
    _LOG.propagate = False
    token = _LOGGING.set(True)
    try:
        python = platform.python_version()
        _LOG.info("%s (Python %s, %s)", command, python, platform.platform())
        with _warnings_too():
            yield
        _LOG.info("done")
    except BaseException as error:
        _LOG.error("%s: %s", type(error).__name__, error)
        raise
    finally:
        _LOGGING.reset(token)
        _LOG.removeHandler(handler)
        _LOG.setLevel(level)
        _LOG.propagate = propagate
        handler.close()


def stages_logged(report: ProgressCallback) -> ProgressCallback:
    """Return a callback that logs each new stage, and how far it came, too."""
    if not _LOGGING.get():
        return report
    last: list[Progress] = []

    def told(progress: Progress) -> None:
        if not last or last[0].stage != progress.stage:
            last[:] = [progress]
            _LOG.info("%s (%d)", progress.stage, progress.total)
        report(progress)

    return told


def result_logged(text: str) -> None:
    """Log what a command says at its end."""
    if _LOGGING.get():
        _LOG.info("%s", text)


@contextmanager
def _warnings_too() -> Iterator[None]:
    show: Callable[..., None] = warnings.showwarning

    def both(message: Warning | str, category: type[Warning], *more: object, **k: object) -> None:
        if category.__name__ != "CompilerWarning":
            _LOG.warning("%s", " ".join(str(message).split()))
        show(message, category, *more, **k)

    with warnings.catch_warnings():
        warnings.showwarning = both
        yield
