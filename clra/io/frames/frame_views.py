"""Frames seen otherwise than they are stored, read as they are sliced."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError

Frames = Any  # an array, or anything with shape and dtype whose slices along views are arrays


class ConvertedFrames:
    """Frames that are converted as they are read.

    Parameters
    ----------
    frames : array-like object, (n, rows, columns)
        The stored frames.
    convert : callable
        Of an array of consecutive frames and the number of the first of them, to an array.
    shape : (int, int, int), optional
        After conversion; by default that of `frames`.
    dtype : dtype-like, optional
        After conversion; by default that of `frames`.
    """

    def __init__(
        self,
        frames: Frames,
        convert: Callable[[NDArray[Any], int], NDArray[Any]],
        *,
        shape: tuple[int, int, int] | None = None,
        dtype: Any = None,
    ) -> None:
        self._frames = frames
        self._convert = convert
        self.shape: tuple[int, int, int] = shape or tuple(frames.shape)
        self.dtype = np.dtype(frames.dtype if dtype is None else dtype)

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.shape[0]

    def __getitem__(self, index: slice) -> NDArray[Any]:
        """Read some consecutive frames."""
        start, stop, _ = index.indices(self.shape[0])
        stored = np.asarray(self._frames[start : max(start, stop)])
        return np.asarray(self._convert(stored, start), self.dtype)


class FrameSequence:
    """Several stacks one after the other, as one.

    Parameters
    ----------
    parts : list of array-like objects, (n, rows, columns)
        At least one; their types may differ.
    """

    def __init__(self, parts: list[Frames]) -> None:
        self._parts = parts
        self._ends = np.cumsum([part.shape[0] for part in parts])
        self.dtype = np.result_type(*(part.dtype for part in parts))
        self.shape = (int(self._ends[-1]), *parts[0].shape[1:])

    def __getitem__(self, index: slice) -> NDArray[Any]:
        """Read some consecutive frames."""
        start, stop, _ = index.indices(self.shape[0])
        out = np.empty((max(stop - start, 0), *self.shape[1:]), self.dtype)
        first = 0
        for part, end in zip(self._parts, self._ends.tolist(), strict=True):
            low, high = max(start, first), min(stop, end)
            if low < high:
                out[low - start : high - start] = part[low - first : high - first]
            first = end
        return out


class MissingFrames:
    """Frames that are not there: only what asks for their pixels fails.

    Parameters
    ----------
    shape : (int, int, int)
        As the metadata tell it.
    reason : str
        The message for whoever asks.
    """

    dtype = np.dtype(np.float32)

    def __init__(self, shape: tuple[int, int, int], reason: str) -> None:
        self.shape = shape
        self.reason = reason

    def __getitem__(self, index: slice) -> NDArray[Any]:
        """Refuse.

        Raises
        ------
        InputError
            Always.
        """
        raise InputError(self.reason)


def mirrored(frames: Frames, *, rows: bool, columns: bool) -> Frames:
    """Return frames with their rows or columns, or both, in the reverse order."""
    if not (rows or columns) or frames is None or isinstance(frames, MissingFrames):
        return frames
    order = (
        slice(None),
        slice(None, None, -1 if rows else 1),
        slice(None, None, -1 if columns else 1),
    )
    return ConvertedFrames(frames, lambda part, _: part[order])


def divided(frames: Frames, white: ArrayLike) -> Frames:
    """Return transmission: frames divided by the counts of the open beam.

    Parameters
    ----------
    frames : array-like object, (n, rows, columns)
        Counts from which the detector has been corrected for already.
    white : float or array_like, (n,)
        For all frames, or each.
    """
    level = np.broadcast_to(np.asarray(white, np.float32), frames.shape[0])
    return ConvertedFrames(
        frames,
        lambda part, start: part / level[start : start + len(part), None, None],
        dtype=np.float32,
    )
