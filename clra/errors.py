"""What clra raises and warns of; each message is one line, but for a compiler's log."""

from __future__ import annotations

import errno
import os

# What to do about the failures that users meet, by the name of the errno.
_ADVICE = {
    "ENOSPC": "free some space or write elsewhere",
    "EDQUOT": "free some space or write elsewhere",
    "EFBIG": "raise the limit on file sizes or write elsewhere",
    "EACCES": "write to a folder that you may write to",
    "EPERM": "write to a folder that you may write to",
    "EROFS": "write to a folder that you may write to",
    "ENOENT": "make the folder first",
    "ENOTDIR": "write into a folder",
    "EISDIR": "give a file's name",
}


class InputError(ValueError):
    """Bad input: the message names the file, the field, what was found and what was expected.

    Parameters
    ----------
    message : str
        Line breaks in it become blanks.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))

    @classmethod
    def at(
        cls, path: str | os.PathLike[str], field: str, found: object, expected: object
    ) -> InputError:
        """Return the error for one field of a file.

        Parameters
        ----------
        path : path-like
            The file.
        field : str
            Where in the file.
        found, expected : object
            Put into the message as text.
        """
        return cls(f"{os.fspath(path)}: {field}: found {found}, expected {expected}")


class OutputError(OSError):
    """A file could not be written: the message names it, the reason and what to do.

    Parameters
    ----------
    message : str
        Line breaks in it become blanks.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))

    @classmethod
    def writing(cls, path: str | os.PathLike[str], number: int | None, reason: str) -> OutputError:
        """Return the error for a file that could not be written.

        Parameters
        ----------
        path : path-like
            The file that was to appear.
        number : int or None
            The system's errno, if known.
        reason : str
            What is known beside the errno.
        """
        text = reason if number is None else os.strerror(number)
        if number is not None and reason and reason != text:
            text += f" ({reason})"
        advice = None if number is None else _ADVICE.get(errno.errorcode.get(number, ""))
        return cls(f"cannot write {os.fspath(path)}: {text}{f'; {advice}' if advice else ''}")


class DeviceError(RuntimeError):
    """No usable OpenCL device: there is none, none of that name, or it fails the self-test."""


class KernelBuildError(DeviceError):
    """A kernel did not compile; the message carries the compiler's log."""


class ClusterError(RuntimeError):
    """A cluster did not do its work: it lost its workers or its scheduler, or a task failed."""


class Cancelled(Exception):  # noqa: N818  (an answer to a callback, not a fault)
    """Raised by a progress callback to end a long call early, keeping what is finished."""


class ClraWarning(UserWarning):
    """A result, or the machine, is not as good as it might be."""
