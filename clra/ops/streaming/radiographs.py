"""Radiographs of one resolution, read in chunks."""

from collections.abc import Callable
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray
from pyopencl.array import Array

from clra.model.scan import Scan
from clra.model.view_selection import runs
from clra.ops.images.pyramid import Restrict2D
from clra.ops.streaming.memory import Store, keeps
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float32]

PerView = Callable[[Floats, slice], NDArray[np.float64]]
"""Returns numbers (n, ...) of each of some radiographs (n, rows, columns), given which views."""


class KeptRadiographs(Protocol):
    """Where radiographs are kept, such as `Store`."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Views, rows, columns."""
        ...

    def read(self, start: int, stop: int, rows: slice | None = None) -> Floats:
        """Return the views `start` to `stop - 1`, or some successive rows of them."""
        ...


class Radiographs:
    """The line integrals of a scan, binned, read in chunks.

    Binned radiographs are read from the scan once and then kept, on the host or, beyond its budget,
    in an unnamed temporary file. Full resolution is read where needed. A device with memory of its
    own keeps what was uploaded if all of it takes no more than an eighth of the budget.

    Parameters
    ----------
    stream : Stream
        Device that bins.
    scan : Scan
        At full resolution.
    level : int
        Binning factor: 1, 2, 4, 8 or 16.
    keep : bool
        Whether they are read once even if they are not binned: for few that are used often.

    Attributes
    ----------
    extension : float or None
        How far the sample reaches beyond the detector; None until it is looked at, see
        :func:`clra.methods.truncation.extension`.
    """

    extension: float | None = None

    def __init__(self, stream: Stream, scan: Scan, level: int, *, keep: bool = False) -> None:
        self.shape = (scan.views, *scan.geometry.binned(level).shape)
        self.level = level
        self._stream, self._scan = stream, scan
        self._resident: Array | None = None
        self._uploaded: NDArray[np.bool_] | None = np.zeros(scan.views, np.bool_)
        self._kept: KeptRadiographs | None = self._read_all() if level > 1 or keep else None

    @classmethod
    def of(cls, kept: KeptRadiographs, level: int) -> Self:
        """Radiographs (views, rows, columns) of a level that are known already."""
        known = cls.__new__(cls)
        views, rows, columns = kept.shape
        known.shape, known.level, known._kept = (views, rows, columns), level, kept
        known._uploaded = None  # they may still change
        return known

    @property
    def view_bytes(self) -> int:
        """Bytes of one radiograph at this level."""
        return 4 * self.shape[1] * self.shape[2]

    def read(self, views: slice, rows: slice | None = None) -> Floats:
        """Radiographs `views`, or some rows of them, float32 (n, rows, columns)."""
        if self._kept is not None:
            return self._kept.read(views.start, views.stop, rows)
        whole = self._scan.read(views.start, views.stop)
        return whole if rows is None else np.ascontiguousarray(whole[:, rows])

    def stay_on(self, stream: Stream) -> bool:
        """Whether a stream's device keeps them: then it has all rows."""
        return self._uploaded is not None and keeps(stream.budgets, self.shape)

    def on_device(self, stream: Stream, views: slice, rows: slice | None = None) -> Array:
        """Radiographs `views` on a stream's device, or some rows of those that do not stay there.

        They have to stay as they are.
        """
        if self._uploaded is None or not self.stay_on(stream):
            return stream.upload(self.read(views, rows))
        if self._resident is None:
            self._resident = stream.empty(self.shape)
        for run in runs(~self._uploaded[views]):
            part = slice(views.start + run.start, views.start + run.stop)
            stream.fill(self._resident[part], self.read(part))
            self._uploaded[part] = True
        array: Array = self._resident[views]
        return array

    def tabulated(self, stream: Stream, numbers: PerView, stage: str) -> NDArray[np.float64]:
        """Return numbers of each view, (views, ...); all radiographs are read.

        Parameters
        ----------
        stream : Stream
            Memory budget, and whom to tell how far it is.
        numbers : callable
            Gives them for some views. Picklable: others may do it.
        stage : str
            What progress reports call this.
        """
        rows, views = [], self.shape[0]
        for chunk in stream.chunks(views, self.view_bytes):
            stream.report(stage, chunk.start, views)
            rows.append(numbers(self.read(chunk), chunk))
        stream.report(stage, views, views)
        return np.concatenate(rows)

    def __getitem__(self, views: slice) -> Floats:
        """Radiographs as the projections of a scan."""
        start, stop, _ = views.indices(self.shape[0])
        return self.read(slice(start, stop))

    def _read_all(self) -> Store:
        stream = self._stream
        kept = Store(self.shape, stream.room)
        restrict = Restrict2D(stream.context)
        chunks = stream.chunks(self.shape[0], 4 * self._scan.shape[1] * self._scan.shape[2])
        binned = f", binned {self.level} x {self.level}" if self.level > 1 else ""
        name = f"reading radiographs{binned}"
        for views in chunks:
            stream.report(name, views.start, self.shape[0])
            measured = self._scan.read(views.start, views.stop)
            if self.level == 1:
                kept.write(views.start, measured)
                continue
            images = stream.upload(measured)
            for _ in range(self.level.bit_length() - 1):
                n, rows, columns = images.shape
                halved = stream.empty((n, rows // 2, columns // 2))
                restrict(stream.queue, halved, images)
                images = halved
            kept.write(views.start, stream.download(images))
        stream.report(name, self.shape[0], self.shape[0])
        return kept


Reading = Callable[[Scan, int], Radiographs]
"""Reads all radiographs of a scan once, binned by a factor; others may do it."""


def read_here(stream: Stream) -> Reading:
    """Return what reads radiographs in this process.

    Parameters
    ----------
    stream : Stream
        Device that bins.
    """

    def reading(scan: Scan, level: int) -> Radiographs:
        return Radiographs(stream, scan, level, keep=True)

    return reading
