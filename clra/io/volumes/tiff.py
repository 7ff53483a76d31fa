"""Volumes as TIFF: plain ones for ImageJ, BigTIFF with OME's text above 4 GB."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import tifffile
from numpy.typing import DTypeLike, NDArray

from clra.errors import InputError
from clra.io.provenance import Provenance
from clra.io.units import TO_MM, factor
from clra.model.grid import VolumeGrid

# The offsets of a plain TIFF have 32 bits; room is left for its headers.
_PLAIN_TIFF = (1 << 32) - (1 << 25)
_PROVENANCE = "clra provenance: "
_CENTRE = re.compile(r"clra centre x y z mm: (\S+) (\S+) (\S+)")


def tiff_layout(
    path: Path, grid: VolumeGrid, units: str, provenance: Provenance
) -> tuple[int, DTypeLike]:
    """Write everything of a TIFF but the voxels.

    ImageJ reads the voxel of its own plain TIFF; a BigTIFF cannot be one and carries OME's text.

    Parameters
    ----------
    path : Path
        The file.
    grid : VolumeGrid
        Of the volume.
    units : str
        Of the voxels.
    provenance : mapping of str to str
        Goes into the description, a line of JSON; the program into the tag Software.

    Returns
    -------
    offset : int
        Byte at which the voxels start.
    dtype : dtype-like
        As which they are written.
    """
    size = grid.voxel_size
    note = "clra centre x y z mm: {!r} {!r} {!r}\nunits: {}\n".format(*grid.centre, units)
    note += f"{_PROVENANCE}{json.dumps(dict(provenance))}\n"
    plain = 4 * int(np.prod(grid.shape, dtype=np.int64)) < _PLAIN_TIFF
    described: dict[str, Any]
    if plain:
        described = {"axes": "ZYX", "spacing": size, "unit": "mm", "Info": note}
    else:
        described = {"axes": "ZYX", "Description": note}
        for axis in "XYZ":
            described |= {f"PhysicalSize{axis}": size, f"PhysicalSize{axis}Unit": "mm"}
    tifffile.imwrite(
        path,
        shape=grid.shape,
        dtype=np.float32,
        bigtiff=not plain,
        imagej=plain,
        ome=not plain,
        photometric="minisblack",
        software=f"clra {provenance.get('clra_version', '')}".strip(),
        # ImageJ counts in its own unit, others in centimetres.
        resolution=(1 / size, 1 / size) if plain else (10 / size, 10 / size),
        resolutionunit="NONE" if plain else "CENTIMETER",
        metadata=described,
    )
    with tifffile.TiffFile(path) as tiff:
        series = tiff.series[0]
        offset = series.dataoffset
        # Set for every file whose pages lie in one run, as in those that imwrite makes.
        assert offset is not None
        return offset, series.dtype.newbyteorder(tiff.byteorder)


def tiff_volume(
    path: str | os.PathLike[str],
) -> tuple[NDArray[Any], float, tuple[float, ...]]:
    """Open the volume in a TIFF.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    voxels : ndarray, (z, y, x)
        On the disk where the file is not compressed.
    voxel_size : float
        In mm.
    centre : (float, float, float)
        Of the grid (x, y, z), 0 where the file does not tell [mm].

    Raises
    ------
    InputError
        If it is no stack of grey pages, or its voxels are not told or no cubes.
    """
    if not Path(path).is_file():
        raise InputError(f"{os.fspath(path)}: no such file")
    try:
        with tifffile.TiffFile(path) as tiff:
            series = tiff.series[0]
            shape = (1,) * (3 - series.ndim) + tuple(series.shape)
            sizes, note = _voxel(tiff)
            if len(shape) != 3 or not sizes:
                found = f"axes {series.axes}, voxel size {sizes or 'none'}"
                raise InputError.at(path, "image", found, "a stack with the size of its voxels")
            if not np.allclose(sizes, sizes[0], rtol=1e-4):
                raise InputError.at(path, "voxel", f"{sizes} mm", "a cube")
            voxels: NDArray[Any]
            if series.dataoffset is not None:
                stored = series.dtype.newbyteorder(tiff.byteorder)
                voxels = np.memmap(path, stored, "r", series.dataoffset, shape)
            else:
                voxels = series.asarray().reshape(shape)
    except InputError:
        raise
    except Exception as error:  # tifffile fails in many ways on what is no TIFF
        raise InputError(f"{os.fspath(path)}: cannot be read as TIFF: {error}") from error
    told = _CENTRE.search(note)
    try:
        centre = tuple(float(c) for c in told.groups()) if told else (0.0, 0.0, 0.0)
    except ValueError:
        assert told is not None
        raise InputError.at(path, "centre", repr(told[0]), "three numbers") from None
    return voxels, sizes[-1], centre


def _voxel(tiff: tifffile.TiffFile) -> tuple[list[float], str]:
    """Sizes of a voxel along x, y and, where told, z [mm], and the text in which clra writes."""
    if tiff.ome_metadata:
        root = ElementTree.fromstring(tiff.ome_metadata)
        pixels = root.find(".//{*}Pixels")
        told = {} if pixels is None else pixels.attrib
        sizes = [
            float(told[f"PhysicalSize{axis}"])
            * (factor(told.get(f"PhysicalSize{axis}Unit", "um"), TO_MM) or np.nan)
            for axis in "XYZ"
            if f"PhysicalSize{axis}" in told
        ]
        return sizes, " ".join(root.itertext())
    tags = tiff.pages.first.tags
    if "XResolution" not in tags or "YResolution" not in tags:
        return [], ""
    across = [tags[name].value for name in ("XResolution", "YResolution")]
    steps = [float(below) / float(above) if above else np.nan for above, below in across]
    imagej = tiff.imagej_metadata or {}
    # ImageJ writes the micro sign as an escape.
    unit = str(imagej.get("unit", "")).replace("\\u00B5", "u")
    scale = factor(unit, TO_MM)
    if scale is not None:
        depth = [float(imagej["spacing"])] if "spacing" in imagej else []
        return [step * scale for step in [*steps, *depth]], str(imagej.get("Info", ""))
    scale = {2: 25.4, 3: 10.0}.get(int(tags["ResolutionUnit"].value)) if not imagej else None
    return ([step * scale for step in steps] if scale else []), ""
