"""Outputs that one run at a time may write: two that write the same do not both claim success."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from glob import escape
from pathlib import Path

from clra.errors import InputError, OutputError


@dataclass
class Outputs:
    """What a run writes.

    Attributes
    ----------
    overwrite : bool
        Whether files that were there before may be replaced.
    claimed : dict of Path to int
        Outputs that are held until the run ends, with the descriptors of their locks.
    written : set of Path
        Those that are its own by now.
    """

    overwrite: bool = True
    claimed: dict[Path, int] = field(default_factory=dict)
    written: set[Path] = field(default_factory=set)

    def check(self, target: Path) -> None:
        """Raise if the file is there and may not be replaced."""
        if not self.overwrite and target not in self.written and target.exists():
            raise InputError(
                f"cannot write {target}: it is there already: give another name, or leave out "
                "--no-overwrite"
            )


_OUTPUTS: ContextVar[Outputs | None] = ContextVar("outputs", default=None)


def outputs() -> Outputs:
    """Return those of this run; without a run, of a single write."""
    return _OUTPUTS.get() or Outputs()


@contextmanager
def one_run(*, overwrite: bool = True) -> Iterator[None]:
    """Hold what the block claims until it ends, and refuse what is there unless `overwrite`."""
    run = Outputs(overwrite)
    token = _OUTPUTS.set(run)
    try:
        yield
    finally:
        _OUTPUTS.reset(token)
        for target, descriptor in run.claimed.items():
            _release(target, descriptor)


def claim(target: Path) -> None:
    """Hold an output until the run ends, if there is a run.

    Raises
    ------
    OutputError
        If another run holds it.
    """
    run = _OUTPUTS.get()
    if run is not None and target not in run.claimed:
        run.claimed[target] = _acquire(target)


@contextmanager
def held(target: Path) -> Iterator[None]:
    """Hold an output while a block writes it.

    Raises
    ------
    OutputError
        If another run holds it.
    """
    if target in outputs().claimed:
        yield
        return
    descriptor = _acquire(target)
    try:
        yield
    finally:
        _release(target, descriptor)


def _lock_file(target: Path) -> Path:
    return target.with_name(f".{target.name}.lock")


def _acquire(target: Path) -> int:
    """Lock an output, and remove what killed runs left of it."""
    path = _lock_file(target)
    while True:
        descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
        try:
            locked = _lock(descriptor)
        except OSError:
            os.close(descriptor)
            raise OutputError(
                f"cannot write {target}: another run is writing it; wait for its end or give "
                "another name"
            ) from None
        with suppress(OSError):
            # The holder before may have removed the file between our opening and locking it.
            if os.stat(path).st_ino == os.fstat(descriptor).st_ino:
                break
        os.close(descriptor)
    if locked:
        for part in target.parent.glob(f".{escape(target.name)}.*.part"):
            with suppress(OSError):
                shutil.rmtree(part) if part.is_dir() else part.unlink()
    return descriptor


def _release(target: Path, descriptor: int) -> None:
    with suppress(OSError):
        _lock_file(target).unlink()
    os.close(descriptor)


if sys.platform == "win32":
    import msvcrt

    def _lock(descriptor: int) -> bool:
        """Lock a file or raise OSError; return whether this file system knows locks."""
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        return True

else:
    import fcntl

    def _lock(descriptor: int) -> bool:
        """Lock a file or raise OSError; return whether this file system knows locks."""
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError:
            return False
        return True
