"""A scan: radiographs, the geometry they were taken with, and what is known about them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError
from clra.findings import warn
from clra.model.corrections.corrections import Corrections
from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion
from clra.model.validation import selection
from clra.progress import ProgressCallback

KINDS = ("line-integrals", "transmission")

# Transmission below which the logarithm is cut off: a dead or fully shadowed pixel must not
# become infinite. exp(-13.8) is far below what a real detector resolves.
_DARKEST = 1e-6
# Part of the pixels of a radiograph that may be so: dead ones, edges of a shield.
_DARK = 0.02


class Projections(Protocol):
    """Radiographs (views, rows, columns): an array, a memory map, an HDF5 dataset or alike."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Views, rows, columns."""
        ...

    def __getitem__(self, views: slice, /) -> Any:
        """Return some consecutive views as an array."""
        ...


@runtime_checkable
class DeliveredProjections(Projections, Protocol):
    """Line integrals that others make, some views here and some there.

    Whoever wants all of them has them delivered.
    """

    def deliver(
        self,
        take: Callable[[int, NDArray[np.float32]], None],
        folder: Path,
        progress: ProgressCallback | None,
    ) -> None:
        """Hand all radiographs on in any order, as :meth:`Scan.read` would give them.

        Parameters
        ----------
        take : callable
            Called with the first view and some radiographs (n, rows, columns), each once.
        folder : Path
            Where files may lie meanwhile.
        progress : callable, optional
            Called with a :class:`clra.progress.Progress` as work goes on.
        """
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Scan:
    """Radiographs with their geometry; pixels are read only when asked for.

    Parameters
    ----------
    projections : array or array-like object, (views, rows, columns)
        Anything with ``shape`` whose slices along the first axis are arrays: numpy, a memory map,
        an HDF5 dataset.
    geometry : ConeBeamGeometry
        Of the same views and detector.
    kind : {"line-integrals", "transmission"}
        What the pixels are: -log(I / I0), or I / I0.
    name : str
        For messages and reports.
    truth : Motion, optional
        The motion that a simulation put in.
    mask : array_like of bool, (rows, columns), optional
        True where the detector's pixels may be used. What the others hold is never used, be it NaN:
        they are interpolated from their neighbours.
    corrections : Corrections, optional
        What is corrected in the line integrals as they are read; see
        :func:`clra.methods.preparation.prepared`, which finds out.

    Raises
    ------
    InputError
        If projections, geometry, truth or mask disagree, or `kind` is none of the two.
    """

    projections: Projections
    geometry: ConeBeamGeometry
    kind: str = "line-integrals"
    name: str = field(default="scan", kw_only=True)
    truth: Motion | None = field(default=None, kw_only=True)
    mask: NDArray[np.bool_] | None = field(default=None, kw_only=True)
    corrections: Corrections | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        expected = (self.geometry.views, *self.geometry.shape)
        found = tuple(self.projections.shape)
        if found != expected:
            raise InputError(
                f"{self.name}: projections: found shape {found}, "
                f"expected {expected} as in the geometry"
            )
        if self.kind not in KINDS:
            raise InputError(f"{self.name}: kind: found {self.kind!r}, expected one of {KINDS}")
        if self.truth is not None and self.truth.views != self.views:
            raise InputError(
                f"{self.name}: truth: found {self.truth.views} views, expected {self.views}"
            )
        if self.mask is not None:
            mask = np.array(self.mask, dtype=np.bool_)
            if mask.shape != self.geometry.shape or not mask.any():
                raise InputError(
                    f"{self.name}: mask: found shape {mask.shape} with {mask.sum()} pixels to use, "
                    f"expected shape {self.geometry.shape} and at least one"
                )
            mask.flags.writeable = False
            object.__setattr__(self, "mask", mask)
        if self.corrections is not None:
            self.corrections.check(self.geometry.shape, self.name)

    @property
    def views(self) -> int:
        """Number of views."""
        return self.geometry.views

    @property
    def shape(self) -> tuple[int, int, int]:
        """Views, rows, columns."""
        return (self.geometry.views, *self.geometry.shape)

    def __len__(self) -> int:
        """Return the number of views."""
        return self.views

    def __repr__(self) -> str:
        """Summarise name, kind and geometry."""
        return f"Scan({self.name!r}, {self.kind}, {self.geometry!r})"

    def read(self, start: int, stop: int, *, check: bool = True) -> NDArray[np.float32]:
        """Read the line integrals of the views `start` to `stop - 1`.

        Parameters
        ----------
        start, stop : int
            Range of views, 0 <= start <= stop <= views.
        check : bool
            Warn of radiographs of which much is too dark.

        Returns
        -------
        ndarray of float32, (stop - start, rows, columns)
            C-contiguous; of a transmission, -log(max(I / I0, 1e-6)). It may share its memory
            with the projections: do not write to it.

        Raises
        ------
        InputError
            If the range is wrong or a pixel is not finite.
        """
        if not 0 <= start <= stop <= self.views:
            raise InputError(
                f"{self.name}: views: found {start}:{stop}, expected within 0:{self.views}"
            )
        pixels = np.ascontiguousarray(self.projections[start:stop], dtype=np.float32)
        if self.kind == "transmission":
            if check:
                self._warn_of_dark(pixels)
            pixels = np.negative(np.log(np.maximum(pixels, np.float32(_DARKEST))))
        if self._all_corrections is not None:
            pixels = self._all_corrections.apply(pixels)
        # One such pixel would spread over the whole volume through filter and back-projection.
        finite = np.isfinite(pixels).all(axis=(1, 2))
        if not finite.all():
            view = start + int(np.argmin(finite))
            raise InputError(f"{self.name}: view {view}: found a pixel that is no finite number")
        return pixels

    def checksum(self) -> str:
        """Return a checksum by which an alignment can be matched to its scan.

        SHA-256 over the shape and three radiographs (first, middle, last): a whole scan of many GB
        would take longer to read than to align.
        """
        digest = hashlib.sha256(repr(self.shape).encode())
        for view in sorted({0, self.views // 2, self.views - 1}):
            pixels = np.ascontiguousarray(self.projections[view : view + 1], dtype="<f4")
            digest.update(pixels.tobytes())
        return f"sha256:{digest.hexdigest()}"

    def _warn_of_dark(self, transmission: NDArray[np.float32]) -> None:
        dark = transmission <= _DARKEST
        known = self._all_corrections
        if known is not None and known.bad is not None:
            dark &= ~known.bad
        part = dark.mean(axis=(1, 2))
        # A radiograph that is dark all over is no view of the sample, and found out elsewhere.
        if part[part < 0.5].max(initial=0) > _DARK:
            warn(
                "dark-pixels",
                f"{self.name}: radiographs of which more than {_DARK:.0%} is dark, expected a "
                f"transmission above {_DARKEST:g}: line integrals there are more than the "
                f"{-np.log(_DARKEST):.3g} that they are taken as",
            )

    @cached_property
    def _all_corrections(self) -> Corrections | None:
        if self.mask is None or self.mask.all():
            return self.corrections
        return (self.corrections or Corrections()).masked(self.mask)

    @property
    def registration_mask(self) -> NDArray[np.bool_] | None:
        """Pixels that registration may use, (rows, columns), or None if all.

        Bad pixels whose neighbours tell their values, on thin lines too, do no harm.
        """
        unreliable = None if self._all_corrections is None else self._all_corrections.unreliable
        return None if unreliable is None else ~unreliable

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the smallest rectangle that holds all pixels to use."""
        if self.mask is None:
            return slice(0, self.geometry.rows), slice(0, self.geometry.columns)
        rows, columns = np.flatnonzero(self.mask.any(axis=1)), np.flatnonzero(self.mask.any(axis=0))
        return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)

    @property
    def window_offset(self) -> tuple[float, float]:
        """(columns, rows) by which the middle of `window` lies off that of the detector."""
        rows, columns = self.window
        total_rows, total_columns = self.geometry.shape
        return (
            0.5 * (columns.start + columns.stop - total_columns),
            0.5 * (rows.start + rows.stop - total_rows),
        )

    def cropped(self) -> Scan:
        """Return the scan without the rows and columns in which no pixel may be used.

        A detector's shadowed sides would be taken for the sample's. Magnifications are about the
        middle of what is left: see :meth:`Motion.about`.
        """
        rows, columns = self.window
        shape = (rows.stop - rows.start, columns.stop - columns.start)
        if shape == self.geometry.shape:
            return self
        offset_u, offset_v = self.window_offset
        geometry = ConeBeamGeometry(
            source=self.geometry.source,
            detector=self.geometry.detector
            + offset_u * self.geometry.u
            + offset_v * self.geometry.v,
            u=self.geometry.u,
            v=self.geometry.v,
            shape=shape,
        )
        assert self.mask is not None  # else nothing is cropped
        mask = self.mask[rows, columns]
        return Scan(
            _Window(self.projections, rows, columns),
            geometry,
            self.kind,
            name=self.name,
            truth=None if self.truth is None else self.truth.about(offset_u, offset_v),
            mask=None if mask.all() else mask,
            corrections=None
            if self.corrections is None
            else self.corrections.cropped(rows, columns),
        )

    def subset(self, index: slice | ArrayLike) -> Scan:
        """Return the scan of some of the views; nothing is read.

        Parameters
        ----------
        index : slice, int, integers or boolean mask (views,)
            Which views, in that order.
        """
        chosen = selection(index)
        return Scan(
            _Selection(self.projections, np.arange(self.views)[chosen]),
            self.geometry.subset(index),
            self.kind,
            name=self.name,
            truth=None if self.truth is None else self.truth.subset(index),
            mask=self.mask,
            corrections=self.corrections,
        )


class _Window:
    """A rectangle of other projections."""

    def __init__(self, projections: Projections, rows: slice, columns: slice) -> None:
        self._projections = projections
        self._rows, self._columns = rows, columns
        size = (rows.stop - rows.start, columns.stop - columns.start)
        self.shape = (projections.shape[0], *size)

    def __getitem__(self, index: slice) -> NDArray[Any]:
        return np.asarray(self._projections[index])[:, self._rows, self._columns]


class _Selection:
    """Some views of other projections, read in runs of consecutive ones."""

    def __init__(self, projections: Projections, views: NDArray[np.int_]) -> None:
        self._projections = projections
        self._views = views
        self.shape = (len(views), *projections.shape[1:])

    def __getitem__(self, index: slice) -> NDArray[Any]:
        views = self._views[index]
        runs = np.split(views, np.flatnonzero(np.diff(views) != 1) + 1)
        if not len(views):
            return np.asarray(self._projections[0:0])
        parts = [np.asarray(self._projections[int(r[0]) : int(r[-1]) + 1]) for r in runs]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)
