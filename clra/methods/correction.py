"""Radiographs as they would have been without motion, for export and for ideal-row methods."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.findings import Finding
from clra.methods.alignment.result import AlignmentResult
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.images.warp import Warp
from clra.ops.streaming.stream import Stream


def correct(
    scan: Scan,
    motion: AlignmentResult | Motion,
    device: Any = None,
    *,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
) -> Scan:
    """Undo the motion of each radiograph by resampling it.

    Every radiograph is interpolated once, from the measured pixels, by cubic B-splines. Methods
    that can absorb the motion into the geometry instead (``geometry.with_motion``) should.

    Parameters
    ----------
    scan : Scan
        As measured.
    motion : AlignmentResult or Motion
        Of its views, as :func:`clra.align` found it. Views that an alignment rejected are left out;
        of a motion alone, no view is.
    device : str or cl.Device, optional
        As :func:`clra.ops.runtime.devices.choose_device` takes it.
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used.

    Returns
    -------
    Scan
        Line integrals; a radiograph is read and corrected when it is asked for.

    Raises
    ------
    InputError
        If the motion is of another number of views.
    """
    stream = Stream(device, max_device_memory=max_device_memory, max_host_memory=max_host_memory)
    if isinstance(motion, AlignmentResult):
        whole = corrected(stream, scan, motion.motion)
        return whole if motion.valid_views.all() else whole.subset(motion.valid_views)
    return corrected(stream, scan, motion)


def corrected(stream: Stream, scan: Scan, motion: Motion) -> Scan:
    """Do as :func:`correct`, errors included, on the device and within the memory of a stream."""
    if motion.views != scan.views:
        raise InputError(f"motion: found {motion.views} views, expected {scan.views}")
    if motion.cause == "sample":
        raise InputError(
            "motion: found rotations of the sample, which no resampling of a radiograph undoes, "
            "expected shifts; reconstruct with the alignment instead, or align with estimate "
            "'shift'"
        )
    if motion.cause == "source":
        Finding(
            "parallax",
            "radiographs are resampled as if their detector had moved, but it was the source: they "
            "are right for what lies at the depth of the axis, and what is nearer to the source or "
            "farther keeps its parallax",
        ).warn()
    return Scan(
        _Corrected(scan, motion, stream),
        scan.geometry,
        name=f"{scan.name}, corrected",
        mask=scan.mask,
    )


class _Corrected:
    """Corrected line integrals (views, rows, columns), made as they are read."""

    def __init__(self, scan: Scan, motion: Motion, stream: Stream) -> None:
        self.shape = scan.shape
        self._scan = scan
        self._stream = stream
        self._warp = Warp(
            stream.context,
            scan.geometry.shape,
            allocator=stream.memory,
            scratch_limit=stream.scratch_limit,
        )
        self._motion = np.stack(
            [motion.shift_u, motion.shift_v, motion.magnification], axis=1
        ).astype(np.float32)

    def __getitem__(self, views: slice) -> NDArray[np.float32]:
        start, stop, _ = views.indices(self.shape[0])
        out = np.empty((stop - start, *self.shape[1:]), np.float32)
        stream = self._stream
        for chunk in stream.chunks(stop - start, out[:1].nbytes):
            part = slice(start + chunk.start, start + chunk.stop)
            measured = stream.upload(self._scan.read(part.start, part.stop))
            corrected = stream.empty(measured.shape)
            motion = stream.upload(np.ascontiguousarray(self._motion[part]))
            self._warp(stream.queue, corrected, measured, motion)
            out[chunk] = stream.download(corrected)
        return out
