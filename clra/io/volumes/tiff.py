"""Volumes as TIFF: plain ones for ImageJ, BigTIFF with OME's text above 4 GB."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import tifffile
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.units import TO_MM, factor
from clra.io.volumes.slab_files import SlabWriter
from clra.io.volumes.volume_description import PlaneSink, VolumeDescription

# The offsets of a plain TIFF have 32 bits; room is left for its headers.
_PLAIN_TIFF = (1 << 32) - (1 << 25)
_PROVENANCE = "clra provenance: "
_SCALING = "clra scale and offset of values: "
_SCALED = re.compile(rf"{_SCALING}(\S+) (\S+)")
_CENTRE = re.compile(r"clra centre x y z mm: (\S+) (\S+) (\S+)")


@contextmanager
def tiff_writer(path: Path, description: VolumeDescription) -> Iterator[PlaneSink]:
    """Write a volume as a stack of pages.

    ImageJ reads the voxel and the scale of its own plain TIFF; a BigTIFF cannot be one and carries
    OME's text.

    Parameters
    ----------
    path : Path
        The file.
    description : VolumeDescription
        Goes into the text, the provenance as a line of JSON; the program into the tag Software.

    Yields
    ------
    PlaneSink
    """
    grid, told = description.grid, description.attributes()
    size = grid.voxel_size
    note = "clra centre x y z mm: {!r} {!r} {!r}\nunits: {}\n".format(*grid.centre, told["units"])
    note += f"{_SCALING}{description.scale!r} {description.offset!r}\n"
    note += f"{_PROVENANCE}{json.dumps(dict(description.provenance))}\n"
    plain = description.bytes < _PLAIN_TIFF
    described: dict[str, Any]
    if plain:
        described = {"axes": "ZYX", "spacing": size, "unit": "mm", "Info": note}
        if description.dtype != "float32":
            # ImageJ's straight line from stored numbers to values.
            line = {"cf": 0, "c0": description.offset, "c1": description.scale}
            described |= {**line, "vunit": description.units}
    else:
        described = {"axes": "ZYX", "Description": note}
        for axis in "XYZ":
            described |= {f"PhysicalSize{axis}": size, f"PhysicalSize{axis}Unit": "mm"}
    tifffile.imwrite(
        path,
        shape=grid.shape,
        dtype=description.stored,
        bigtiff=not plain,
        imagej=plain,
        ome=not plain,
        photometric="minisblack",
        software=f"clra {description.provenance.get('clra_version', '')}".strip(),
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
        stored = series.dtype.newbyteorder(tiff.byteorder)
    with SlabWriter(path, offset, grid.shape, stored) as writer:
        yield writer


def tiff_volume(
    path: str | os.PathLike[str],
) -> tuple[NDArray[Any], float, tuple[float, ...], tuple[float, float]]:
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
    scaling : (float, float)
        Scale and offset of the values.

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
    line = _SCALED.search(note)
    try:
        centre = tuple(float(c) for c in told.groups()) if told else (0.0, 0.0, 0.0)
        scaling = (float(line[1]), float(line[2])) if line else (1.0, 0.0)
    except ValueError:
        found = repr((told or line or [""])[0])
        raise InputError.at(path, "centre", found, "three numbers") from None
    return voxels, sizes[-1], centre, scaling


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
