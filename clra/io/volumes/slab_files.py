"""Large arrays written part by part at their place in a file.

The writes are the system's own, not HDF5's: where the disk fills up they fail as an ordinary error,
while HDF5 2.0 crashes the process when it cannot flush what it holds.
"""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import DTypeLike, NDArray

from clra.errors import InputError


def reserve(
    group: h5py.Group, name: str, shape: tuple[int, ...], dtype: DTypeLike
) -> tuple[h5py.Dataset, int]:
    """Make a data set whose bytes are written later, in one run, without HDF5.

    Parameters
    ----------
    group : h5py.Group
        Where.
    name : str
        Of the data set.
    shape : tuple of int
        Of the array.
    dtype : dtype-like
        Its pixels, in this machine's byte order.

    Returns
    -------
    dataset : h5py.Dataset
        For attributes.
    offset : int
        Byte of the file at which the array starts.
    """
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_layout(h5py.h5d.CONTIGUOUS)
    plan.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    plan.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    dataset = group.create_dataset(name, shape=shape, dtype=dtype, dcpl=plan)
    return dataset, int(dataset.id.get_offset())


class SlabWriter:
    """Write parts of one array that lies in one run in a file.

    Parameters
    ----------
    path : Path
        A file that exists.
    offset : int
        Where in it the array starts [byte].
    shape : tuple of int
        Of the array.
    dtype : dtype-like
        Its pixels.
    """

    def __init__(self, path: Path, offset: int, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        self.shape = shape
        self.dtype = np.dtype(dtype)
        self._offset = offset
        self._stride = self.dtype.itemsize * int(np.prod(shape[1:], dtype=np.int64))
        self._file = open(path, "r+b", buffering=0)

    def write(self, start: int, part: NDArray[Any]) -> None:
        """Write `part`, (n, ...), as the elements `start` to `start + n - 1` of the first axis.

        Raises
        ------
        InputError
            If the part does not fit.
        OSError
            If the disk does not take it.
        """
        if part.shape[1:] != self.shape[1:] or not 0 <= start <= self.shape[0] - len(part):
            raise InputError(
                f"part: found shape {part.shape} at {start}, expected to fit into {self.shape}"
            )
        view = np.ascontiguousarray(part, self.dtype).reshape(-1).view(np.uint8).data
        self._file.seek(self._offset + start * self._stride)
        while view:
            view = view[self._file.write(view) :]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            # A part that was never written must be zeros, not a file that ends too early.
            end = self._offset + self.shape[0] * self._stride
            self._file.truncate(max(end, os.fstat(self._file.fileno()).st_size))
        self._file.close()
