"""Radiographs as they would have been without motion, for export and for ideal-row methods."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.errors import InputError
from clra.findings import Finding
from clra.methods.alignment.result import AlignmentResult
from clra.methods.execution.choice import check_for_cluster, executing
from clra.methods.execution.executor import PARTS, Held, InProcess, WorkerGroup
from clra.model.motion import Motion
from clra.model.scan import Projections, Scan
from clra.ops.images.warp import Warp
from clra.ops.runtime.devices import usable_devices
from clra.ops.streaming.part_files import RadiographParts
from clra.ops.streaming.stream import Stream, equal_runs
from clra.progress import ProgressCallback

# Bytes of corrected radiographs in a file, which a worker has in memory.
_FILE_BYTES = 256 << 20


def correct(
    scan: Scan,
    motion: AlignmentResult | Motion,
    device: Any = None,
    *,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
    cluster: Any = None,
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
        As :func:`clra.ops.runtime.devices.choose_device` takes it, or "all".
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used.
    cluster : distributed.Client or str, optional
        Workers, as :func:`clra.align` takes them. They, or all devices, correct radiographs that
        :func:`clra.write_scan` writes; single ones are corrected here.

    Returns
    -------
    Scan
        Line integrals; a radiograph is read and corrected when it is asked for.

    Raises
    ------
    InputError
        If the motion is of another number of views, or as :func:`clra.align` for `cluster`.
    """
    check_for_cluster(cluster, scan, "correct", ("correct",))
    if isinstance(motion, AlignmentResult):
        _check(scan, motion.motion)
        if not motion.valid_views.all():
            scan = scan.subset(motion.valid_views)
        motion = motion.motion.subset(motion.valid_views)
    limits: dict[str, Any] = {
        "max_device_memory": max_device_memory,
        "max_host_memory": max_host_memory,
    }
    devices = usable_devices(device)
    stream = Stream(devices[0], **limits)
    found = corrected(stream, scan, motion)
    if cluster is None and len(devices) == 1:
        return found

    def workers(
        folder: Path, progress: ProgressCallback | None
    ) -> AbstractContextManager[InProcess | WorkerGroup]:
        return executing(stream, devices, cluster, None, progress, limits, beside=folder)

    return replace(found, projections=_CorrectedByWorkers(found.projections, scan, motion, workers))


def corrected(stream: Stream, scan: Scan, motion: Motion) -> Scan:
    """Do as :func:`correct`, errors included, on the device and within the memory of a stream."""
    _check(scan, motion)
    if motion.cause == "source":
        Finding(
            "parallax",
            "radiographs are resampled as if their detector had moved, but it was the source: they "
            "are right for what lies at the depth of the axis, and what is nearer to the source or "
            "farther keeps its parallax",
        ).warn()
    return _resampled(stream, scan, motion)


def _check(scan: Scan, motion: Motion) -> None:
    if motion.views != scan.views:
        raise InputError(f"motion: found {motion.views} views, expected {scan.views}")
    if motion.cause == "sample":
        raise InputError(
            "motion: found rotations of the sample, which no resampling of a radiograph undoes, "
            "expected shifts; reconstruct with the alignment instead, or align with estimate "
            "'shift'"
        )


def _resampled(stream: Stream, scan: Scan, motion: Motion) -> Scan:
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


@dataclass(frozen=True)
class _CorrectedByWorkers:
    """Corrected line integrals, some made here as they are read, all by several workers."""

    here: Projections
    scan: Scan
    motion: Motion
    workers: Callable[
        [Path, ProgressCallback | None], AbstractContextManager[InProcess | WorkerGroup]
    ]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.here.shape

    def __getitem__(self, views: slice) -> Any:
        return self.here[views]

    def deliver(
        self,
        take: Callable[[int, NDArray[np.float32]], None],
        folder: Path,
        progress: ProgressCallback | None,
    ) -> None:
        scan = self.scan
        with self.workers(folder, progress) as workers:
            assert not isinstance(workers, InProcess)
            most = max(1, _FILE_BYTES // (4 * scan.geometry.rows * scan.geometry.columns))
            count = max(PARTS * workers.places, -(-scan.views // most))
            parts = equal_runs(scan.views, min(scan.views, count))
            made = RadiographParts(workers.new_folder("corrected"), scan.shape, tuple(parts))
            task = _CorrectViews(workers.share(scan), self.motion, made)
            workers.map(
                task,
                parts,
                stage="correcting",
                # Others are made while these are handed on.
                done=lambda number: made.hand_on(parts[number], take),
            )


@dataclass(frozen=True)
class _CorrectViews:
    """Corrects some radiographs of a scan into a file."""

    scan: Held
    motion: Motion
    target: RadiographParts

    def __call__(self, stream: Stream, views: slice) -> None:
        made = _resampled(stream, self.scan.get(), self.motion)
        self.target.write(views, made.read(views.start, views.stop))
