"""What a volume file tells of its voxels, and voxels as integers."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.io.provenance import Provenance
from clra.model.grid import VolumeGrid

TYPES = ("float32", "uint16", "uint8")


class PlaneSink(Protocol):
    """Where planes of a file go."""

    def write(self, start: int, part: NDArray[Any], /) -> None:
        """Take planes (n, y, x), the first of them plane `start`."""


@dataclass(frozen=True)
class VolumeDescription:
    """Voxels of a file: where they lie and what they mean.

    Parameters
    ----------
    grid : VolumeGrid
        Of the whole volume.
    units : str
        Of the values.
    dtype : {"float32", "uint16", "uint8"}
        As which they are stored.
    scale, offset : float
        A value is ``stored * scale + offset``.
    provenance : mapping of str to str
        Where the volume comes from.
    """

    grid: VolumeGrid
    units: str = "1/mm"
    dtype: str = "float32"
    scale: float = 1.0
    offset: float = 0.0
    provenance: Provenance = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.dtype not in TYPES:
            raise InputError(f"dtype: found {self.dtype!r}, expected one of {', '.join(TYPES)}")

    @property
    def stored(self) -> np.dtype[Any]:
        """Type of the stored voxels, in this machine's byte order."""
        return np.dtype(self.dtype)

    @property
    def bytes(self) -> int:
        """Bytes of all voxels."""
        return self.stored.itemsize * int(np.prod(self.grid.shape, dtype=np.int64))

    def between(self, low: float, high: float) -> VolumeDescription:
        """Return the description of integers that hold values from `low` to `high`.

        Raises
        ------
        InputError
            If these are not in order.
        """
        if not low < high:
            raise InputError(f"limits: found {low:g} to {high:g}, expected two values in order")
        return replace(self, offset=low, scale=(high - low) / np.iinfo(self.stored).max)

    def attributes(self) -> dict[str, Any]:
        """Return everything but the provenance by name, as it goes into each format.

        The scale of integers has the names of the CF conventions.
        """
        told: dict[str, Any] = {
            "units": self.units,
            "axes": "z, y, x",
            "voxel_size": self.grid.voxel_size,
            "voxel_size_units": "mm",
            "centre": self.grid.centre,
            "centre_units": "mm",
            "centre_axes": "x, y, z",
        }
        if self.dtype != "float32":
            told |= {"scale_factor": self.scale, "add_offset": self.offset}
        return told

    def encoded(self, part: NDArray[Any]) -> NDArray[Any]:
        """Return values as they are stored; beyond the limits they are clipped."""
        if self.dtype == "float32":
            return np.asarray(part, np.float32)
        steps = np.rint((np.asarray(part, np.float32) - self.offset) / self.scale)
        return np.asarray(np.clip(steps, 0, np.iinfo(self.stored).max), self.stored)


def decoded(part: NDArray[Any], scale: float, offset: float) -> NDArray[np.float32]:
    """Return the values of stored voxels."""
    values = np.asarray(part, np.float32)
    return values if (scale, offset) == (1.0, 0.0) else values * np.float32(scale) + offset
