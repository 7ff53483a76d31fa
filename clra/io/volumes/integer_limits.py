"""Integers from voxels whose limits are known only at the end."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clra.errors import InputError
from clra.io.volumes.slab_files import SlabWriter
from clra.io.volumes.volume_description import PlaneSink, VolumeDescription

# Voxels that percentiles are taken of, at most, and bytes that are converted at a time.
_SAMPLE, _PIECE = 1 << 20, 2 << 20


@dataclass(frozen=True)
class Limits:
    """What becomes the least and the greatest integer; values beyond are clipped.

    Parameters
    ----------
    low, high : float
        Values, or percentiles of the voxels.
    percentiles : bool
        Which of these.

    Raises
    ------
    InputError
        If they are not in order, or no percentiles.
    """

    low: float = 0.01
    high: float = 99.99
    percentiles: bool = True

    def __post_init__(self) -> None:
        percent = 0 <= self.low and self.high <= 100
        if not self.low < self.high or (self.percentiles and not percent):
            expected = "two percentiles, 0 to 100," if self.percentiles else "two values"
            found = f"{self.low:g} and {self.high:g}"
            raise InputError(f"limits: found {found}, expected {expected} in order")


Open = Callable[[VolumeDescription], AbstractContextManager[PlaneSink]]


@contextmanager
def integer_writer(
    folder: Path, description: VolumeDescription, limits: Limits, open_file: Open
) -> Iterator[PlaneSink]:
    """Take values and write integers.

    Parameters
    ----------
    folder : Path
        Where values are kept, in a temporary file of 4 bytes a voxel, until percentiles are known.
    description : VolumeDescription
        Of the integers, without scale and offset.
    limits : Limits
        Known, or percentiles of the voxels that are not 0: those outside the field of view are.
    open_file : callable
        Opens the file once the description is complete.

    Yields
    ------
    PlaneSink
    """
    if not limits.percentiles:
        whole = description.between(limits.low, limits.high)
        with open_file(whole) as sink:
            yield _Encoded(whole, sink)
        return
    shape = description.grid.shape
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".clra-values-") as kept:
        with SlabWriter(Path(kept.name), 0, shape, np.float32) as values:
            yield values
        voxels = _Values(kept.name, shape)
        whole = description.between(*_percentiles(voxels, limits))
        step = max(1, _PIECE // (4 * shape[1] * shape[2]))
        with open_file(whole) as sink:
            for start in range(0, shape[0], step):
                sink.write(start, whole.encoded(voxels.read(start, min(start + step, shape[0]))))


class _Encoded:
    """Values that are encoded on their way."""

    def __init__(self, description: VolumeDescription, sink: PlaneSink) -> None:
        self._description, self._sink = description, sink

    def write(self, start: int, part: np.ndarray, /) -> None:
        self._sink.write(start, self._description.encoded(part))


@dataclass(frozen=True)
class _Values:
    """Planes in a file; those of a memory map would count as memory of the process."""

    path: str
    shape: tuple[int, int, int]

    def read(self, start: int, stop: int) -> np.ndarray:
        _, rows, columns = self.shape
        plane = rows * columns
        values = np.fromfile(
            self.path, np.float32, (stop - start) * plane, offset=4 * start * plane
        )
        return values.reshape(-1, rows, columns)


def _percentiles(voxels: _Values, limits: Limits) -> tuple[float, float]:
    """Values at the limits, of a sample of the voxels."""
    planes = voxels.shape[0]
    step = math.ceil((math.prod(voxels.shape) / _SAMPLE) ** (1 / 3))
    parts = [voxels.read(k, k + 1)[0, ::step, ::step].ravel() for k in range(0, planes, step)]
    sample = np.concatenate(parts)
    sample = sample[sample != 0]
    if not sample.size:
        return 0.0, 1.0
    low, high = np.percentile(sample, [limits.low, limits.high])
    return float(low), float(high) if high > low else float(low) + 1.0
