"""The OpenCL C sources of clra, for its own operators and for hosts in other languages."""

import re
from functools import cache
from pathlib import Path

from clra.errors import InputError

_INCLUDE = re.compile(r'^[ \t]*#[ \t]*include[ \t]+"([^"]+)"[^\n]*$', re.MULTILINE)


def path() -> Path:
    """Folder that holds the ``.cl`` and ``.clh`` files.

    An installed wheel carries them inside the package, a checkout (also an editable install) at
    its top level.
    """
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "_kernels", package.parent / "kernels"):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"no kernels beside {package}: the installation is incomplete")


def names() -> tuple[str, ...]:
    """Names of the kernel files, sorted."""
    return tuple(sorted(file.name for file in path().glob("*.cl")))


@cache
def source(name: str) -> str:
    """One kernel file as a single text that compiles alone.

    Every ``#include "file.clh"`` is replaced by that file's text, once each: no include path has
    to be given to the compiler (a path with a blank in it breaks several drivers).

    Parameters
    ----------
    name : str
        File name, for example ``"backproject.cl"``.

    Returns
    -------
    str
        OpenCL C 1.2.

    Raises
    ------
    InputError
        If there is no such file.
    """
    if name not in names():
        raise InputError(f"no kernel file {name!r}; there are {', '.join(names())}")
    seen: set[str] = set()

    def paste(text: str) -> str:
        def include(match: re.Match[str]) -> str:
            header = match.group(1)
            if header in seen:
                return ""
            seen.add(header)
            return paste((path() / header).read_text(encoding="utf-8"))

        return _INCLUDE.sub(include, text)

    return paste((path() / name).read_text(encoding="utf-8"))
