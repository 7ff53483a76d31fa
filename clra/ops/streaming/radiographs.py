"""Radiographs of one resolution, read in chunks."""

import numpy as np
from numpy.typing import NDArray

from clra.model.scan import Scan
from clra.ops.images.pyramid import Restrict2D
from clra.ops.streaming.memory import Store
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float32]


class Radiographs:
    """The line integrals of a scan, binned, read in chunks.

    Binned radiographs are read from the scan once and then kept, on the host or, beyond its budget,
    in an unnamed temporary file. Full resolution is read where needed.

    Parameters
    ----------
    stream : Stream
        Device that bins.
    scan : Scan
        At full resolution.
    level : int
        Binning factor: 1, 2, 4 or 8.

    Attributes
    ----------
    extension : float or None
        How far the sample reaches beyond the detector; None until it is looked at, see
        :func:`clra.methods.truncation.extension`.
    """

    extension: float | None = None

    def __init__(self, stream: Stream, scan: Scan, level: int) -> None:
        self.shape = (scan.views, *scan.geometry.binned(level).shape)
        self.level = level
        self._stream, self._scan = stream, scan
        self._kept: Store | None = None if level == 1 else self._read_all()

    @classmethod
    def of(cls, kept: Store, level: int) -> "Radiographs":
        """Radiographs (views, rows, columns) of a level that are known already."""
        known = cls.__new__(cls)
        views, rows, columns = kept.shape
        known.shape, known.level, known._kept = (views, rows, columns), level, kept
        return known

    @property
    def view_bytes(self) -> int:
        """Bytes of one radiograph at this level."""
        return 4 * self.shape[1] * self.shape[2]

    def read(self, views: slice) -> Floats:
        """Radiographs `views`, float32 (n, rows, columns)."""
        if self._kept is None:
            return self._scan.read(views.start, views.stop)
        return self._kept.read(views.start, views.stop)

    def __getitem__(self, views: slice) -> Floats:
        """Radiographs as the projections of a scan."""
        start, stop, _ = views.indices(self.shape[0])
        return self.read(slice(start, stop))

    def _read_all(self) -> Store:
        stream = self._stream
        kept = Store(self.shape, stream.room)
        restrict = Restrict2D(stream.context)
        chunks = stream.chunks(self.shape[0], 4 * self._scan.shape[1] * self._scan.shape[2])
        name = f"reading radiographs, binned {self.level} x {self.level}"
        for views in chunks:
            stream.report(name, views.start, self.shape[0])
            measured = self._scan.read(views.start, views.stop)
            images = stream.upload(measured)
            for _ in range(self.level.bit_length() - 1):
                n, rows, columns = images.shape
                halved = stream.empty((n, rows // 2, columns // 2))
                restrict(stream.queue, halved, images)
                images = halved
            kept.write(views.start, stream.download(images))
        stream.report(name, self.shape[0], self.shape[0])
        return kept
