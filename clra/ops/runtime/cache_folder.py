"""Where verdicts and compiled kernels are kept between runs, and what if nothing can be kept there.

PoCL ends without a device where it cannot make its cache folder, and pyopencl fails with the first
kernel. So folders are looked at before OpenCL is, and a temporary one stands in for them.
"""

import os
import shutil
import stat
import sys
import tempfile
from functools import cache
from pathlib import Path

from clra.errors import DeviceError
from clra.findings import warn

ROOM = 32 << 20  # bytes; PoCL's binaries of all kernels take about 10 MiB


@cache
def cache_folder() -> Path:
    """Folder for what clra keeps between runs, by the platform's convention.

    Where it, or those of PoCL and pyopencl, cannot be written to, the process and its children get
    a temporary one by ``XDG_CACHE_HOME``.

    Returns
    -------
    Path
        ``$XDG_CACHE_HOME/clra`` or ``~/.cache/clra`` on Linux; it exists.

    Raises
    ------
    DeviceError
        If no folder can be written to; names them.

    Warns
    -----
    ClraWarning
        If a temporary folder is used instead.
    """
    pocl = Path(os.environ.get("POCL_CACHE_DIR") or _xdg_cache() / "pocl")
    for folder in (_own_folder(), pocl, _xdg_cache() / "pytools"):
        if problem := unusable(folder):
            temporary = _temporary_folder(f"{folder}: {problem}")
            os.environ["XDG_CACHE_HOME"] = str(temporary)
            os.environ.pop("POCL_CACHE_DIR", None)
            warn(
                "cache-folder",
                f"{folder}: {problem}: verdicts and compiled kernels are kept in {temporary}; set "
                "XDG_CACHE_HOME to a folder with room to keep them there",
            )
            own = temporary / "clra"
            break
    else:
        own = _own_folder()
    own.mkdir(parents=True, exist_ok=True)
    return own


def unusable(folder: Path) -> str:
    """Return why nothing can be kept in a folder that may not exist yet; empty if it can."""
    existing = next(parent for parent in (folder, *folder.parents) if os.path.lexists(parent))
    if not existing.is_dir():
        return f"{existing} is not a folder" if existing != folder else "not a folder"
    try:
        with tempfile.TemporaryFile(dir=existing) as file:
            file.write(bytes(1 << 16))
            file.flush()
    except OSError as error:
        return error.strerror or str(error)
    if shutil.disk_usage(existing).free < ROOM:
        return f"less than {ROOM >> 20} MiB are free"
    return ""


def _own_folder() -> Path:
    if sys.platform == "darwin":
        return _home() / "Library" / "Caches" / "clra"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or _home()) / "clra" / "Cache"
    return _xdg_cache() / "clra"


def _xdg_cache() -> Path:
    given = os.environ.get("XDG_CACHE_HOME")
    return Path(given) if given else _home() / ".cache"


def _home() -> Path:
    try:
        return Path.home()
    except RuntimeError:  # no HOME, and the user is not known to the system
        return Path(tempfile.gettempdir())


def _temporary_folder(why: str) -> Path:
    """Make the user's own folder among the temporary ones, which nobody else can write to."""
    try:
        parent = Path(tempfile.gettempdir())
        if problem := unusable(parent):
            raise OSError(f"{parent}: {problem}")
        folder = parent / f"clra-{os.getuid() if hasattr(os, 'getuid') else 'cache'}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        private = stat.S_ISDIR(found.st_mode) and not found.st_mode & 0o077
        if hasattr(os, "getuid") and not (private and found.st_uid == os.getuid()):
            folder = Path(tempfile.mkdtemp(prefix="clra-"))
    except OSError as error:
        raise DeviceError(
            f"no folder for compiled kernels: {why}; {error}: free "
            "some space, or set XDG_CACHE_HOME to a folder that you can write to"
        ) from error
    return folder
