"""Volumes as NRRD, for 3D Slicer and its like: a text header and the voxels in one file [1]_.

References
----------
.. [1] https://teem.sourceforge.net/nrrd/format.html
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.volumes.slab_files import SlabWriter
from clra.io.volumes.volume_description import PlaneSink, VolumeDescription

_TYPES = {"float32": "float", "uint16": "ushort", "uint8": "uchar"}
# Names of types that a header may give; others are not read.
_READ = {
    "f4": ("float",),
    "f8": ("double",),
    "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
}
_LONGEST = 1 << 16


@contextmanager
def nrrd_writer(path: Path, description: VolumeDescription) -> Iterator[PlaneSink]:
    """Write a volume with an attached header.

    Parameters
    ----------
    path : Path
        The file.
    description : VolumeDescription
        The grid becomes space directions and origin [mm], the rest key and value.

    Yields
    ------
    PlaneSink
    """
    grid = description.grid
    nz, ny, nx = grid.shape
    size = repr(grid.voxel_size)
    origin = ",".join(repr(float(axis[0])) for axis in grid.coordinates())
    lines = [
        "NRRD0005",
        f"type: {_TYPES[description.dtype]}",
        "dimension: 3",
        "space: 3D-right-handed",
        f"sizes: {nx} {ny} {nz}",
        f"space directions: ({size},0,0) (0,{size},0) (0,0,{size})",
        "kinds: domain domain domain",
        f"endian: {sys.byteorder}",
        "encoding: raw",
        'space units: "mm" "mm" "mm"',
        f"space origin: ({origin})",
    ]
    told = {**description.attributes(), **description.provenance}
    lines.append(f"sample units: {told.pop('units')}")
    lines += [f"{name}:={_one_line(value)}" for name, value in told.items()]
    header = ("\n".join(lines) + "\n\n").encode()
    path.write_bytes(header)
    with SlabWriter(path, len(header), grid.shape, description.stored) as writer:
        yield writer


def _one_line(value: Any) -> str:
    return str(value).replace("\\", "\\\\").replace("\n", "\\n")


def nrrd_volume(
    path: str | os.PathLike[str],
) -> tuple[NDArray[Any], float, tuple[float, ...], tuple[float, float]]:
    """Open the volume in a NRRD whose voxels follow the header as they are.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    voxels : ndarray, (z, y, x)
        On the disk.
    voxel_size, centre
        Of the grid [mm].
    scaling : (float, float)
        Scale and offset of the values.

    Raises
    ------
    InputError
        If it is anything else.
    """
    try:
        with open(path, "rb") as file:
            start = file.read(_LONGEST)
    except OSError as error:
        raise InputError(f"{os.fspath(path)}: {error.strerror}") from error
    end = start.find(b"\n\n")
    if not start.startswith(b"NRRD") or end < 0:
        raise InputError(f"{os.fspath(path)}: found no NRRD header, expected one with its voxels")
    lines = start[:end].decode("utf-8", "replace").splitlines()[1:]
    fields = dict(line.split(": ", 1) for line in lines if ": " in line and ":=" not in line)
    keys = dict(line.split(":=", 1) for line in lines if ":=" in line)
    kind = next((t for t, names in _READ.items() if fields.get("type") in names), None)
    vectors = re.findall(r"\(([^)]*)\)", fields.get("space directions", ""))
    steps = [sum(float(c) ** 2 for c in v.split(",")) ** 0.5 for v in vectors]
    sizes = [int(n) for n in fields.get("sizes", "").split()]
    wanted = (kind is not None, len(sizes) == 3, len(steps) == 3, fields.get("encoding") == "raw")
    if not all(wanted) or not np.allclose(steps, steps[0], rtol=1e-4):
        told = {n: fields.get(n) for n in ("type", "sizes", "space directions", "encoding")}
        raise InputError(f"{os.fspath(path)}: found {told}, expected 3-D raw voxels that are cubes")
    order = {"little": "<", "big": ">"}.get(fields.get("endian", sys.byteorder), "<")
    voxels = np.memmap(path, np.dtype(f"{order}{kind}"), "r", end + 2, tuple(sizes[::-1]))
    origin = re.findall(r"[^(),]+", fields.get("space origin", "")) or ["0"] * 3
    centre = [float(o) + 0.5 * (n - 1) * steps[0] for o, n in zip(origin, sizes, strict=True)]
    scaling = (float(keys.get("scale_factor", 1)), float(keys.get("add_offset", 0)))
    return voxels, steps[0], tuple(centre), scaling
