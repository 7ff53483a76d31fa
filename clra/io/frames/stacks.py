"""Raw frames in: TIFF files or headerless binary files, read one by one."""

from __future__ import annotations

import glob
import math
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import tifffile
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError
from clra.findings import warn

Floats = NDArray[np.float64]
Source = str | os.PathLike[str]

_TIFF = (".tif", ".tiff")
_RANGE = re.compile(r"([^:]+):([^:]+):(\d+)")


@dataclass(frozen=True, kw_only=True)
class RawLayout:
    """How the pixels lie in a headerless file.

    Parameters
    ----------
    shape : (int, int), optional
        Rows and columns; needed for raw files only.
    dtype : str
        Type of a pixel, such as "uint16".
    byteorder : {"little", "big"}
        Of the pixels.
    header : int
        Bytes to skip at the start of each file.
    """

    shape: tuple[int, int] | None = None
    dtype: str = "uint16"
    byteorder: str = "little"
    header: int = 0

    def pixel(self) -> np.dtype[Any]:
        """Return the type of a pixel.

        Raises
        ------
        InputError
            If type, byte order or header make no sense.
        """
        try:
            pixel = np.dtype(self.dtype)
        except TypeError:
            pixel = np.dtype(object)
        if pixel.kind not in "iuf":
            raise InputError.at("--dtype", "dtype", repr(self.dtype), "one such as 'uint16'")
        if self.byteorder not in ("little", "big"):
            expected = "'little' or 'big'"
            raise InputError.at("--byteorder", "byteorder", repr(self.byteorder), expected)
        if self.header < 0:
            raise InputError.at("--header", "header", f"{self.header} bytes", "none or more")
        return pixel.newbyteorder("<" if self.byteorder == "little" else ">")


class FrameStack:
    """Frames (n, rows, columns) of several files as one array, read as it is sliced.

    Parameters
    ----------
    files : path-like or list of path-like
        In the order of the frames. A name with ``*``, ``?`` or ``[`` stands for all files that
        match, numbers in the names counting as numbers: 9 before 10.
    layout : RawLayout
        Of files that are no TIFF.

    Attributes
    ----------
    shape : (int, int, int)
        Frames, rows, columns.
    dtype : dtype
        Of a pixel.
    files : tuple of Path
        In the order of the frames.

    Raises
    ------
    InputError
        If a file is missing, cannot be read, or differs from the first in size or type.
    """

    def __init__(self, files: Source | Sequence[Source], layout: RawLayout) -> None:
        self._layout = layout
        self.files = _matching(files)
        counts: list[int] = []
        for path in self.files:
            frames = self._open(path)
            if not counts:
                first = frames
            if frames.shape[1:] != first.shape[1:] or frames.dtype != first.dtype:
                raise InputError.at(
                    path, "frame", f"{frames.shape[1:]} of {frames.dtype}",
                    f"{first.shape[1:]} of {first.dtype} as in {self.files[0]}",
                )  # fmt: skip
            counts.append(frames.shape[0])
            frames.close()
        self._ends = np.cumsum(counts)
        self.dtype = first.dtype.newbyteorder("=")
        self.shape = (int(self._ends[-1]), *first.shape[1:])
        self._current: _File | None = None
        self._lock = Lock()  # devices read their views in threads of their own

    def __getitem__(self, index: slice) -> NDArray[Any]:
        """Read some consecutive frames."""
        chosen = range(*index.indices(self.shape[0]))
        out = np.empty((len(chosen), *self.shape[1:]), self.dtype)
        for k, frame in enumerate(chosen):
            which = int(np.searchsorted(self._ends, frame, side="right"))
            path = self.files[which]
            with self._lock:
                if self._current is None or self._current.path != path:
                    self.close()
                    self._current = self._open(path)
                out[k] = self._current.read(frame - int(self._ends[which - 1] if which else 0))
        return out

    def __getstate__(self) -> dict[str, Any]:
        files = tuple(path.absolute() for path in self.files)
        return {**self.__dict__, "files": files, "_current": None, "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ |= {**state, "_lock": Lock()}

    def close(self) -> None:
        """Close the file that was read last."""
        if self._current is not None:
            self._current.close()
            self._current = None

    def _open(self, path: Path) -> _File:
        if not path.is_file():
            found = f"a folder: give its files, such as '{path}/*.tif'"
            raise InputError(f"{path}: {found if path.is_dir() else 'no such file'}")
        if path.suffix.lower() in _TIFF:
            return _tiff(path)
        return _raw(path, self._layout)


@dataclass
class _File:
    """The frames of one file: an array, or pages to decode one by one."""

    path: Path
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    frames: Any
    tiff: tifffile.TiffFile | None = None

    def close(self) -> None:
        if self.tiff is not None:
            self.tiff.close()

    def read(self, index: int) -> NDArray[Any]:
        try:
            frame = self.frames[index]
            return np.asarray(frame.asarray() if hasattr(frame, "asarray") else frame)
        except Exception as error:  # a damaged page can fail in any of the decoders
            raise InputError(f"{self.path}: frame {index}: cannot be read: {error}") from error


def _tiff(path: Path) -> _File:
    """Open a TIFF file of one or more grey pages."""
    tiff = None
    try:
        tiff = tifffile.TiffFile(path)
        series = tiff.series
        kinds = {(tuple(s.shape[-2:]), s.dtype) for s in series}
        if len(kinds) != 1 or any(s.ndim not in (2, 3) or "S" in s.axes for s in series):
            found = ", ".join(f"{s.shape} {s.axes}" for s in series[:3]) or "none"
            raise InputError.at(path, "images", found, "grey frames of one size")
        (rows, columns), dtype = kinds.pop()
        count = sum(int(s.shape[0]) if s.ndim == 3 else 1 for s in series)
        shape = (count, int(rows), int(columns))
        if len(series) > 1 or series[0].dataoffset is None:
            return _File(path, shape, dtype, [page for s in series for page in s.pages], tiff)
        end = series[0].dataoffset + math.prod(shape) * dtype.itemsize
        if (size := path.stat().st_size) < end:
            expected = f"{end} at least: the file is cut short, copy it again"
            raise InputError.at(path, "size", f"{size} bytes", expected)
        stored = dtype.newbyteorder(tiff.byteorder)
        frames = np.memmap(path, stored, "r", series[0].dataoffset, shape)
        tiff.close()
        return _File(path, shape, dtype, frames)
    except Exception as error:  # tifffile fails in many ways on what is no TIFF
        if tiff is not None:
            tiff.close()
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be read as TIFF: {error}") from error


def _raw(path: Path, layout: RawLayout) -> _File:
    """Open a headerless file of one or more frames."""
    if layout.shape is None:
        raise InputError.at(
            path, "format", f"suffix {path.suffix!r}",
            "a TIFF, or rows, columns and type of raw frames (shape=, dtype= / --shape, --dtype)",
        )  # fmt: skip
    pixel = layout.pixel()
    rows, columns = layout.shape
    frame = rows * columns * pixel.itemsize
    size = path.stat().st_size - layout.header
    if frame <= 0 or size < frame or size % frame:
        raise InputError.at(
            path, "size", f"{size} bytes after a header of {layout.header}",
            f"a multiple of {frame}: {rows} x {columns} pixels of {pixel.itemsize} bytes",
        )  # fmt: skip
    shape = (size // frame, rows, columns)
    frames = np.memmap(path, pixel, "r", layout.header, shape)
    return _File(path, shape, pixel.newbyteorder("="), frames)


def _matching(files: Source | Sequence[Source]) -> tuple[Path, ...]:
    """Resolve patterns to the list of files."""
    given = [files] if isinstance(files, str | os.PathLike) else list(files)
    found: list[Path] = []
    for item in given:
        name = os.fspath(item)
        if glob.has_magic(name) and not os.path.exists(name):
            matches = sorted(glob.glob(name), key=_natural)
            if not matches:
                raise InputError(f"{name}: no file matches")
            found += [Path(match) for match in matches]
        else:
            found.append(Path(name))
    return tuple(found)


def warn_of_gaps(files: Sequence[Path]) -> None:
    """Warn where the numbers in the names of files do not go on as they do elsewhere.

    A frame that was lost shifts all that follow against their angles, and so does an order in which
    10 comes before 2.

    Parameters
    ----------
    files : sequence of Path
        In the order of the frames.
    """
    names = [re.split(r"(\d+)", path.name) for path in files]
    counted = [k for k, parts in enumerate(zip(*names, strict=False)) if len(set(parts)) > 1]
    if len(counted) != 1 or counted[0] % 2 == 0 or len({len(parts) for parts in names}) != 1:
        return  # not told apart by one number
    steps = np.diff([int(parts[counted[0]]) for parts in names]).tolist()
    usual = Counter(steps).most_common(1)[0][0]
    gaps = [k for k, step in enumerate(steps) if step != usual]
    if gaps:
        k = gaps[0]
        warn(
            "missing-frames",
            f"{files[k].name} is followed by {files[k + 1].name}"
            f"{f', and {len(gaps) - 1} more such' if gaps[1:] else ''}: are frames missing or out "
            "of order? Angles go with frames as they come; a pattern in quotes sorts by number",
        )


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorting key by which 9 comes before 10."""
    parts = re.split(r"(\d+)", name)
    return [(int(p), "") if p.isdigit() else (0, p) for p in parts]


def read_numbers(source: Source | ArrayLike, what: str, count: int, frames: str) -> Floats:
    """Read one number for each frame.

    Parameters
    ----------
    source : path-like, str or array_like
        A text file with a number a line (text after ``#`` is left out), ``start:stop:n`` for n
        evenly spaced numbers of which the first is start and the last is stop, or the numbers.
    what : str
        Their name in messages.
    count : int
        How many there must be.
    frames : str
        Which frames they are for, in messages.

    Returns
    -------
    ndarray of float64, (count,)

    Raises
    ------
    InputError
        If they are no numbers, not finite, or not as many.
    """
    name = what
    if not isinstance(source, str | os.PathLike):
        values = np.atleast_1d(np.asarray(source, dtype=np.float64))
    elif (spaced := _RANGE.fullmatch(os.fspath(source).strip())) and not os.path.exists(source):
        name = os.fspath(source)
        ends = [_number(spaced[k], name, what) for k in (1, 2)]
        values = np.linspace(ends[0], ends[1], int(spaced[3]))
    else:
        name = os.fspath(source)
        values = _read_column(Path(name), what)
    if values.ndim != 1 or len(values) != count:
        raise InputError.at(name, what, f"{values.size} numbers", f"{count}, one a frame {frames}")
    if not np.isfinite(values).all():
        frame = int(np.argmin(np.isfinite(values)))
        raise InputError.at(name, what, f"{values[frame]} at frame {frame}", "finite numbers")
    return values


def _read_column(path: Path, what: str) -> Floats:
    """Read a text file with one number a line."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "no text"
        raise InputError(f"{path}: {what}: cannot be read: {reason}") from error
    values = []
    for number, line in enumerate(lines, 1):
        field = line.split("#")[0].strip().rstrip(",;")
        if field:
            values.append(_number(field, f"{path}: line {number}", what))
    return np.array(values, np.float64)


def _number(field: str, where: str, what: str) -> float:
    try:
        return float(field)
    except ValueError:
        told = repr(field if len(field) < 40 else f"{field[:36]} ...")
        expected = "one number (a line; what follows # is left out)"
        raise InputError.at(where, what, told, expected) from None
