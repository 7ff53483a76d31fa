"""From a scan to a volume: picks the method and the defaults."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.methods.alignment import align as align_scan
from clra.methods.fbp import ramp_fbp
from clra.model.grid import VolumeGrid, default_grid
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.streaming import Radiographs, Report, Stream

METHODS = ("fbp",)


def reconstruct(
    scan: Scan,
    method: str = "fbp",
    grid: VolumeGrid | None = None,
    motion: Motion | None = None,
    align: bool = False,
    device: Any = None,
    *,
    progress: Report | None = None,
    max_device_memory: int | None = None,
    max_host_memory: int | None = None,
) -> NDArray[np.float32]:
    """Reconstruct a volume.

    Parameters
    ----------
    scan : Scan
        Radiographs and their geometry.
    method : {"fbp"}
        Ramp-filtered back-projection, for any trajectory.
    grid : VolumeGrid, optional
        Where to reconstruct; by default the whole field of view
        (:func:`clra.model.grid.default_grid`).
    motion : Motion, optional
        Of the radiographs, absorbed into the geometry: nothing is resampled.
    align : bool
        Estimate the motion first, with the defaults of :func:`clra.align`.
    device : str or cl.Device, optional
        As :func:`clra.ops.opencl.choose_device` takes it.
    progress : callable, optional
        Called with a :class:`clra.ops.streaming.Progress` as work goes on.
    max_device_memory, max_host_memory : int, optional
        Bytes that may be used.

    Returns
    -------
    ndarray of float32, (nz, ny, nx)
        Attenuation [1/mm].

    Raises
    ------
    ValueError
        If the method is unknown, or both `motion` and `align` are given.
    """
    if method not in METHODS:
        raise ValueError(f"method: found {method!r}, expected one of {METHODS}")
    if align and motion is not None:
        raise ValueError("motion and align: found both, expected one of them")
    if align:
        motion = align_scan(
            scan,
            device=device,
            progress=progress,
            max_device_memory=max_device_memory,
            max_host_memory=max_host_memory,
        ).motion
    stream = Stream(
        device,
        max_device_memory=max_device_memory,
        max_host_memory=max_host_memory,
        report=progress,
    )
    geometry = scan.geometry if motion is None else scan.geometry.with_motion(motion)
    volume = ramp_fbp(
        stream,
        Radiographs(stream, scan, 1),
        geometry,
        grid or default_grid(scan.geometry),
    )
    return volume.to_host()
