"""Output files that appear whole or not at all."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from clra.errors import InputError, OutputError
from clra.io.claims import claim, held, outputs

# HDF5 tells the system's errno only inside its message.
_HDF5_ERRNO = re.compile(r"errno = (\d+)")

# Bytes written and taken back before the file is begun. No quota tells how much it leaves, and HDF5
# 2.0 crashes the process where its header, far smaller than this, does not fit.
_HEADER = 4 << 20


@contextmanager
def atomic_path(path: str | os.PathLike[str], size: int = 0) -> Iterator[Path]:
    """Yield a temporary path beside `path` that is renamed to it once all went well.

    The file is flushed to the disk and renamed at the end of the block; whatever the block raises,
    Ctrl-C included, removes it and leaves what stood at `path` before.

    Parameters
    ----------
    path : path-like
        Where the file is to appear; a link is followed.
    size : int
        Bytes that will be written: refused at once where the disk lacks them.

    Yields
    ------
    Path
        An empty file in the same folder: open it for writing.

    Raises
    ------
    OutputError
        If the file cannot be made, written or renamed.
    """
    target = _target(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.part")
    outputs().check(target)
    try:
        with held(target):
            try:
                temporary.touch()
                _check_room(temporary, size)
                yield temporary
                _flush(temporary)
                outputs().check(target)
                os.replace(temporary, target)
                outputs().written.add(target)
                _flush(target.parent)
            finally:
                with suppress(OSError):
                    temporary.unlink(missing_ok=True)
    except (OSError, RuntimeError) as error:
        raise _explained(path, error) from error


@contextmanager
def atomic_folder(path: str | os.PathLike[str], size: int = 0) -> Iterator[Path]:
    """Yield a temporary folder beside `path` that takes its place once all went well.

    Parameters
    ----------
    path : path-like
        Where the folder is to appear. A folder that is there is replaced only if it is a Zarr.
    size : int
        Bytes that will be written: refused at once where the disk lacks them.

    Yields
    ------
    Path
        An empty folder.

    Raises
    ------
    OutputError
        If the folder cannot be made, written or renamed.
    """
    target = _target(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.part")
    former = target.with_name(f".{target.name}.{os.getpid()}.former")
    outputs().check(target)
    try:
        with held(target):
            try:
                temporary.mkdir()
                probe = temporary / ".room"
                _check_room(probe, size)
                probe.unlink()
                yield temporary
                outputs().check(target)
                if target.exists():
                    os.replace(target, former)
                os.replace(temporary, target)
                outputs().written.add(target)
                _flush(target.parent)
            finally:
                shutil.rmtree(temporary, ignore_errors=True)
                if former.exists() and not target.exists():
                    os.replace(former, target)
                shutil.rmtree(former, ignore_errors=True)
    except (OSError, RuntimeError) as error:
        raise _explained(path, error) from error


def ensure_writable(
    path: str | os.PathLike[str],
    keep: Iterable[str | os.PathLike[str] | None] = (),
    size: int = 0,
) -> None:
    """Check before a long computation that `path` can be written; nothing is left behind.

    Within :func:`clra.io.claims.one_run` no other run can write it from then on.

    Parameters
    ----------
    path : path-like
        Where a file is to appear later.
    keep : iterable of path-like or None
        Files that it must not replace: those that are read, and other results. None is no file.
    size : int
        Bytes that will be written.

    Raises
    ------
    InputError
        If it would replace one of `keep`, or anything where that is not wanted
        (:func:`clra.io.claims.one_run`).
    OutputError
        If it cannot be written: the folder or the disk does not take it, or another run writes it.
    """
    target = _target(path)
    if any(other is not None and Path(os.path.realpath(other)) == target for other in keep):
        raise InputError(
            f"cannot write {os.fspath(path)}: it is what is read, or another result: give another "
            "name"
        )
    outputs().check(target)
    probe = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        probe.touch()
        probe.unlink()
        claim(target)
    except OSError as error:
        raise _explained(path, error) from error
    free = shutil.disk_usage(target.parent).free
    if free < size:
        found = f"{free / 1e9:.3g} GB free of {size / 1e9:.3g} GB wanted"
        raise OutputError.writing(path, errno.ENOSPC, found)


def _target(path: str | os.PathLike[str]) -> Path:
    """Follow `path` to its file; refuse what a rename must not replace: folders, devices, pipes."""
    target = Path(os.path.realpath(path))
    if target.suffix.lower() == ".zarr" and (target / "zarr.json").is_file():
        return target  # a volume that was written before
    if target.exists() and not target.is_file():
        kind = "a folder" if target.is_dir() else "no regular file"
        raise OutputError(f"cannot write {os.fspath(path)}: it is {kind}; give a file's name")
    return target


def _check_room(temporary: Path, size: int) -> None:
    """Raise where the disk lacks `size` bytes: better now than after hours of writing."""
    usage = shutil.disk_usage(temporary.parent)
    # Some network file systems report nothing at all.
    if usage.total and usage.free < size:
        found = f"{usage.free / 1e9:.3g} GB free of {size / 1e9:.3g} GB wanted"
        raise OSError(errno.ENOSPC, found)
    with open(temporary, "wb") as file:
        file.write(bytes(min(size, _HEADER)))
        file.flush()
        os.fsync(file.fileno())
        file.truncate(0)


def _flush(path: Path) -> None:
    """Wait until the disk has it: a rename may otherwise outlive the bytes in a power cut."""
    if path.is_dir() and os.name == "nt":
        return  # Windows opens no folders
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _explained(path: str | os.PathLike[str], error: Exception) -> Exception:
    """Return the error to raise in place of `error`."""
    told = _HDF5_ERRNO.search(str(error))
    if isinstance(error, OutputError) or (isinstance(error, RuntimeError) and not told):
        return error
    if told:
        return OutputError.writing(path, int(told[1]), "")
    number = error.errno if isinstance(error, OSError) else None
    reason = getattr(error, "strerror", None) or str(error)
    return OutputError.writing(path, number, reason)
