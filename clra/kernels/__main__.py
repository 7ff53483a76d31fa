"""Write the kernels for hosts in other languages: ``python -m clra.kernels OUT_DIR``."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from clra import kernels
from clra.kernels.header import header

HEADER = "clra_kernels.h"


def write(folder: Path) -> list[Path]:
    """Write every kernel file as one text, and a C header of names and arguments.

    Each file appears whole; those of an earlier version are replaced.

    Parameters
    ----------
    folder : Path
        Made where there is none.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    texts = {name: kernels.source(name) for name in kernels.names()} | {HEADER: header()}
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        part = folder / f".{name}.{os.getpid()}.part"
        try:
            part.write_text(text, encoding="utf-8", newline="\n")
            part.replace(folder / name)
        finally:
            part.unlink(missing_ok=True)
    return [folder / name for name in texts]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; usage errors exit with 2, failures of the machine with 1."""
    parser = argparse.ArgumentParser(
        prog="python -m clra.kernels",
        description="Write the OpenCL C sources, each compiling alone, and a C header.",
    )
    parser.add_argument("folder", metavar="OUT_DIR", type=Path, help="made where there is none")
    folder = parser.parse_args(arguments).folder
    if folder.exists() and not folder.is_dir():
        parser.error(f"OUT_DIR: found the file {folder}, expected a folder")
    try:
        write(folder)
    except OSError as error:
        print(f"{parser.prog}: {error.filename}: {error.strerror}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
