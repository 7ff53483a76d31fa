"""What reading libraries raise on damaged files, told as bad input that names the file."""

from __future__ import annotations

import functools
import os
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

from clra.errors import InputError

# Libraries that decode files: what they raise, or what they call raises, is the file's fault; what
# our own code raises is ours. Cython's frames have the path that they had where it was compiled.
_LIBRARIES = {"h5py", "tifffile", "imagecodecs", "olefile"}

_Function = TypeVar("_Function", bound=Callable[..., Any])


@contextmanager
def readable(path: str | os.PathLike[str]) -> Iterator[None]:
    """Raise what a reading library raises within the block as an InputError.

    Parameters
    ----------
    path : path-like
        That is read.

    Raises
    ------
    InputError
        If the file is damaged; it names the file and says what the library says.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        if not _is_theirs(error):
            raise
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise InputError(
            f"{os.fspath(path)}: cannot be read: {reason}: the file is damaged, copy it again"
        ) from error


def reads(function: _Function) -> _Function:
    """Make a function that reads the file named by its argument `path` do as :func:`readable`."""

    @functools.wraps(function)
    def run(path: str | os.PathLike[str], *args: Any, **options: Any) -> Any:
        with readable(path):
            return function(path, *args, **options)

    return cast(_Function, run)


def _is_theirs(error: Exception) -> bool:
    """Whether one of the libraries raised it, or something that it called."""
    frames = traceback.extract_tb(error.__traceback__)
    parts = (frame.filename.replace("\\", "/").removesuffix(".py").split("/") for frame in frames)
    return any(_LIBRARIES.intersection(part) for part in parts)
