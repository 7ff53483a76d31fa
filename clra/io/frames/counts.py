"""Radiographs read when asked for: counts in, transmission out."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.findings import warn
from clra.io.damage import readable
from clra.model.bad_pixels import Patches

Floats = NDArray[np.float32]
Frames = NDArray[np.intp]

# Part of the pixels of a flat that have the highest counts, all the same, if it is clipped: in the
# noise of a flat that is not, a handful.
_CLIPPED = 0.002
# A pixel whose flat is below this part of its neighbours' on all sides sees nothing but noise.
_DIM = 0.1
# Flats that are not above the dark in more than this part of the detector are no flats.
_DEAD = 0.5


class CountedRadiographs:
    """Transmission (views, rows, columns) of a scan, computed from counts as it is sliced.

    ``(counts - dark) / (flat - dark)``, with the mean of the dark frames and a flat that runs
    linearly from one group of consecutive flat frames to the next by the number of the frame. Where
    a flat is saturated, or not above the dark, the pixel is bad: it is interpolated from its good
    neighbours.

    Parameters
    ----------
    frames : HDF5 data set or array, (frames, rows, columns)
        Everything that the detector wrote.
    path : str
        Its file, for messages.
    views, flats, darks : ndarray of int
        Which frames are radiographs, flat fields and dark fields.
    white : float, optional
        Counts of the open beam, in place of the flat frames.
    normalised : bool
        The frames hold transmission or line integrals already: they are only checked.
    saturation : float, optional
        Counts at which the detector saturates; by default the largest of an integer type.

    Attributes
    ----------
    shape : (int, int, int)
        Views, rows, columns.
    dtype : dtype
        float32.
    notes : tuple of str
        What was noticed: for users.
    mask : ndarray of bool, (rows, columns), or None
        False where bad pixels stand so close together that their values are far-fetched.

    Raises
    ------
    InputError
        If there is neither flat nor `white`, or flats do not stand above the darks. On slicing:
        if a frame cannot be read or has pixels that are no finite numbers.
    """

    def __init__(
        self,
        frames: Any,
        *,
        path: str,
        views: Frames,
        flats: Frames,
        darks: Frames,
        white: float | None = None,
        normalised: bool = False,
        saturation: float | None = None,
    ) -> None:
        self._frames = frames
        self._path = path
        self._field = str(getattr(frames, "name", "frames"))
        self._views = views
        self._warned = self._clipped = False
        self._saturation = saturation
        if saturation is None and frames.dtype.kind in "iu":
            self._saturation = float(np.iinfo(frames.dtype).max)
        self.shape = (len(views), int(frames.shape[1]), int(frames.shape[2]))
        self.dtype = np.dtype(np.float32)
        self.notes: tuple[str, ...] = ()
        self.mask: NDArray[np.bool_] | None = None
        self._flats: list[Floats] = []
        if not normalised:
            self._prepare(flats, darks, white)

    def __len__(self) -> int:
        """Return the number of views."""
        return self.shape[0]

    def __getitem__(self, index: Any) -> Floats:
        """Read some views: a slice, a number, numbers or a mask (views,)."""
        frames = self._views[index]
        chosen = np.atleast_1d(frames)
        out = np.empty((len(chosen), *self.shape[1:]), np.float32)
        for start, stop in _runs(chosen):
            counts = self._read(int(chosen[start]), stop - start)
            self._check_saturation(counts, int(chosen[start]))
            out[start:stop] = counts
        for frame, image in zip(chosen, out, strict=True):
            self._normalise(int(frame), image)
        return out if np.ndim(frames) else out[0]

    def _prepare(self, flats: Frames, darks: Frames, white: float | None) -> None:
        """Average darks and flats and find the bad pixels."""
        if white is None and not len(flats):
            raise InputError.at(
                self._path, "image_key", "no flat frame (image_key 1)",
                "at least one, or the counts of the open beam: white= / --white "
                "(1 for radiographs that are normalised already)",
            )  # fmt: skip
        detector = self.shape[1:]
        self._dark = self._mean(darks) if len(darks) else np.zeros(detector, np.float32)
        if not len(darks):
            self._note("no dark frame: 0 counts taken as dark")
        if white is None:
            groups = [flats[start:stop] for start, stop in _runs(flats)]
        else:
            groups = []
            self._flats.append(np.full(detector, white, np.float32) - self._dark)
        self._positions = np.array([float(group.mean()) for group in groups] or [0.0])
        self._flats += [self._flat(group) for group in groups]
        dead = np.any([_dim(flat) for flat in self._flats], axis=0)
        if dead.mean() > _DEAD:
            raise InputError.at(
                self._path, self._field,
                f"flats that are not above the darks in {int(dead.sum())} of {dead.size} pixels",
                "flats brighter than darks: image_key 1 is flat, 2 is dark",
            )  # fmt: skip
        for flat in self._flats:
            flat[dead] = 1.0
        self._patches = Patches(dead)
        if dead.any():
            self._note(
                f"{int(dead.sum())} bad pixels (saturated or dim in a flat field) interpolated "
                "from their neighbours"
            )
        if self._patches.far.any():
            self.mask = ~self._patches.far

    def _note(self, text: str) -> None:
        self.notes = (*self.notes, text)

    def _normalise(self, frame: int, image: Floats) -> None:
        """Turn the counts of one frame into transmission, in place."""
        if not self._flats:
            return
        right = int(np.searchsorted(self._positions, frame))
        image -= self._dark
        if right in (0, len(self._positions)):
            image /= self._flats[min(right, len(self._flats) - 1)]
        else:
            before, after = self._positions[right - 1 : right + 1]
            weight = np.float32((frame - before) / (after - before))
            image /= (1 - weight) * self._flats[right - 1] + weight * self._flats[right]
        self._patches.fill(image)

    def _mean(self, frames: Frames) -> Floats:
        """Mean of some frames, read one by one."""
        total = np.zeros(self.shape[1:], np.float64)
        for frame in frames:
            total += self._read(int(frame), 1)[0]
        return np.asarray(total / len(frames), np.float32)

    def _flat(self, frames: Frames) -> Floats:
        """Mean of some flats above the dark; 0 where one is saturated."""
        total = np.zeros(self.shape[1:], np.float64)
        saturated = np.zeros(self.shape[1:], np.bool_)
        for frame in frames:
            counts = self._read(int(frame), 1)
            self._check_clipping(counts[0], int(frame))
            if self._saturation is not None:
                full = counts[0] >= self._saturation
                if full.mean() > _DEAD:
                    raise InputError.at(
                        self._path, self._field,
                        f"flat frame {frame} with {int(full.sum())} pixels at "
                        f"{self._saturation:g} counts",
                        f"at most {_DEAD:.0%} of the pixels saturated",
                    )  # fmt: skip
                saturated |= full
            total += counts[0]
        flat = np.asarray(total / len(frames), np.float32) - self._dark
        flat[saturated] = 0
        return flat

    def _read(self, start: int, count: int) -> NDArray[Any]:
        """Read consecutive frames as they are; refuse pixels that are no finite numbers."""
        with readable(self._path):
            return self._finite(start, count)

    def _finite(self, start: int, count: int) -> NDArray[Any]:
        try:
            counts = np.asarray(self._frames[start : start + count])
        except (OSError, RuntimeError) as error:
            raise InputError.at(
                self._path, self._field, f"frames {start} to {start + count - 1}: {error}",
                "readable frames",
            ) from error  # fmt: skip
        if counts.dtype.kind == "f":
            bad = np.count_nonzero(~np.isfinite(counts), axis=(1, 2))
            if bad.any():
                first = int(np.argmax(bad > 0))
                raise InputError.at(
                    self._path, self._field,
                    f"frame {start + first} with {bad[first]} pixels that are no finite numbers",
                    "finite numbers",
                )  # fmt: skip
        return counts

    def _check_saturation(self, counts: NDArray[Any], start: int) -> None:
        """Warn once of saturated pixels; whole frames are rejected when views are compared."""
        if self._saturation is None or self._warned:
            return
        full = np.count_nonzero(counts >= self._saturation, axis=(1, 2))
        worst = int(np.argmax(full))
        if full[worst]:
            self._warned = True
            found = (
                f"frame {start + worst} with {full[worst]} pixels at {self._saturation:g} counts"
            )
            warn("saturation", f"{self._path}: {self._field}: {found}: saturated")

    def _check_clipping(self, flat: NDArray[Any], frame: int) -> None:
        """Warn once of a flat whose brightest pixels all have the same counts."""
        top, size = float(flat.max()), flat.size
        clipped = int(np.count_nonzero(flat == top))
        if self._clipped or not _CLIPPED * size < clipped < 0.9 * size or top <= 0:
            return
        below = int(np.count_nonzero(flat >= top - max(3.0, 1e-3 * top))) - clipped
        # Without noise all that is bright has the same counts, and nothing has a little less.
        if 0.02 * clipped < below < 0.33 * clipped and top != self._saturation:
            self._clipped = True
            warn(
                "clipping",
                f"{self._path}: {self._field}: flat frame {frame} with {clipped} pixels at exactly "
                f"{top:g} counts and none above: the detector seems to saturate there; line "
                "integrals of thin parts of the sample are too low",
                "expose less, or set saturation_value in the file",
            )


def _dim(flat: Floats) -> NDArray[np.bool_]:
    """Where a flat above the dark is not positive, or far below two pixels beside it each way."""
    rows, columns = flat.shape
    dim = np.ones(flat.shape, np.bool_)
    for axis in (0, 1):
        reach = min(2, flat.shape[axis] - 1)
        padded = np.pad(flat, reach, mode="reflect" if min(rows, columns) > 2 else "edge")
        for step in (-reach, reach):
            moved = np.roll(padded, step, axis)[reach : reach + rows, reach : reach + columns]
            dim &= flat < _DIM * moved
    found: NDArray[np.bool_] = dim | (flat <= 0)
    return found


def _runs(frames: Frames) -> list[tuple[int, int]]:
    """Ranges of `frames` in which they are consecutive, so that each is one read."""
    breaks = np.flatnonzero(np.diff(frames) != 1) + 1
    edges = [0, *breaks.tolist(), len(frames)] if len(frames) else [0]
    return list(pairwise(edges))
