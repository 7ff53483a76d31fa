"""What measured radiographs hold beyond simulated ones, as radiographs to be back-projected."""

import numpy as np
from numpy.typing import NDArray

from clra.model.motion import Motion
from clra.ops.images.warp import Warp
from clra.ops.streaming.memory import Store
from clra.ops.streaming.multigrid import Residual
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

Floats = NDArray[np.float64]


def between(before: Motion, after: Motion, shape: tuple[int, int], level: int) -> Floats:
    """By what a feature of each radiograph moves from one motion to another.

    Parameters
    ----------
    before, after : Motion
        In pixels of the full-resolution detector.
    shape : (int, int)
        Rows and columns of that detector.
    level : int
        Binning factor of the radiographs.

    Returns
    -------
    ndarray, (views, 3)
        Shifts along columns and rows [pixel of the level], and magnification, about the centre of
        the binned detector, which lies half of what binning drops away from that of the whole one.
    """
    grown = after.magnification / before.magnification
    lost_v, lost_u = (0.5 * (grown - 1) * (n % level) for n in shape)
    shift_u = after.shift_u - grown * before.shift_u - lost_u
    shift_v = after.shift_v - grown * before.shift_v - lost_v
    return np.stack([shift_u / level, shift_v / level, grown], axis=1)


def residuals(
    stream: Stream,
    radiographs: Radiographs,
    simulated: Store,
    used: NDArray[np.bool_],
    *,
    moved: Floats | None = None,
) -> Radiographs:
    """Subtract simulated radiographs from the measured ones, in the frame of the measured ones.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    radiographs : Radiographs
        As measured.
    simulated : Store
        Line integrals (views, rows, columns) of a volume; replaced by the result.
    used : ndarray of bool, (rows, columns)
        Pixels that count; the result is 0 elsewhere.
    moved : ndarray, (views, 3), optional
        By what features of the simulated radiographs lie elsewhere in the measured ones, as of
        :func:`between`. The simulated one is resampled to lie there too: a shift and a
        magnification of the detector leave rays as they are, so that but for the interpolation, by
        splines in an image without noise, it is what a projection with the detector moved would
        give.

    Returns
    -------
    Radiographs
        Measured minus simulated line integrals.
    """
    queue = stream.queue
    subtract = Residual(stream.context, used)
    back = np.tile([0.0, 0.0, 1.0], (simulated.shape[0], 1))
    if moved is not None:
        warp = Warp(
            stream.context,
            (used.shape[0], used.shape[1]),
            allocator=stream.memory,
            scratch_limit=stream.scratch_limit,
        )
        back = np.column_stack([-moved[:, :2] / moved[:, 2:], 1 / moved[:, 2]])
    for views in stream.chunks(simulated.shape[0], radiographs.view_bytes):
        measured = radiographs.on_device(stream, views)
        made = stream.empty(measured.shape)
        made.set(simulated.read(views.start, views.stop), queue=queue)
        motion = stream.upload(np.ascontiguousarray(back[views], np.float32))
        if moved is not None:
            warp(queue, made, made, motion)
        subtract(queue, made, measured, made, motion)
        simulated.write(views.start, stream.download(made))
    return Radiographs.of(simulated, radiographs.level)
