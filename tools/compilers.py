"""Compilers that need not be there: where they are, and running them."""

import shutil
import subprocess
import sysconfig
from collections.abc import Mapping, Sequence
from pathlib import Path

from clra.ops.runtime.build import BUILD_OPTIONS

APT = "apt-get install -y --no-install-recommends"


class Missing(Exception):  # noqa: N818 - not an error: the check is skipped
    """A tool is not installed; the message says how to get it."""


def program(name: str, how: str) -> str:
    """Path of a tool, on PATH or in a wheel of NVIDIA's."""
    wheels = Path(sysconfig.get_paths()["purelib"]).glob(f"nvidia/**/bin/{name}")
    found = shutil.which(name) or next(map(str, wheels), None)
    if found is None:
        raise Missing(f"no {name} ({how})")
    return found


def data(name: str, folders: Sequence[str], how: str) -> Path:
    """Path of a bitcode library or a folder of them."""
    wheels = Path(sysconfig.get_paths()["purelib"]).glob(f"nvidia/**/{name}")
    for path in (*(Path(folder) / name for folder in folders), *wheels):
        if path.exists():
            return path
    raise Missing(f"no {name} ({how})")


def clang(version: int, *options: str) -> list[str]:
    how = f"{APT} clang-{version}"
    return [program(f"clang-{version}", how), "-x", "cl", BUILD_OPTIONS[0], *options]


def run(command: Sequence[str], folder: Path, *, output: bool = False) -> str:
    """Run a command in a folder; its standard error or output, a RuntimeError if it fails."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{Path(command[0]).name} failed:\n{done.stderr.strip()}")
    return done.stdout if output else done.stderr


def defined(form: Mapping[str, int]) -> list[str]:
    return [f"-D{name}={value}" for name, value in form.items()]
