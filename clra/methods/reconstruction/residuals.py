"""Measured radiographs and simulated ones: compared, registered, and what is left between them."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pyopencl.array import Array

from clra.methods.alignment.reprojection import register, registration_for
from clra.methods.reconstruction.osem_tr import OrderedSubsets
from clra.model.motion import Motion
from clra.model.scan import Scan
from clra.ops.images.warp import Warp
from clra.ops.registration.gauss_newton import ESTIMATE_FIELDS
from clra.ops.streaming.memory import Store
from clra.ops.streaming.multigrid import Residual
from clra.ops.streaming.radiographs import KeptRadiographs, Radiographs
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
    """Subtract simulated radiographs from the measured ones, in place.

    Parameters
    ----------
    stream, radiographs, used, moved
        As for :func:`residual_chunks`.
    simulated : Store
        Line integrals (views, rows, columns) of a volume; replaced by the result.

    Returns
    -------
    Radiographs
        Measured minus simulated line integrals.
    """
    for views, lacking in residual_chunks(stream, radiographs, simulated, used, moved=moved):
        simulated.write(views.start, lacking)
    return Radiographs.of(simulated, radiographs.level)


def residual_chunks(
    stream: Stream,
    radiographs: Radiographs,
    simulated: KeptRadiographs,
    used: NDArray[np.bool_],
    *,
    moved: Floats | None = None,
) -> Iterator[tuple[slice, NDArray[np.float32]]]:
    """Subtract simulated radiographs from the measured ones, in the frame of the measured ones.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    radiographs : Radiographs
        As measured.
    simulated : KeptRadiographs
        Line integrals (views, rows, columns) of a volume.
    used : ndarray of bool, (rows, columns)
        Pixels that count; the result is 0 elsewhere.
    moved : ndarray, (views, 3), optional
        By what features of the simulated radiographs lie elsewhere in the measured ones, as of
        :func:`between`. The simulated one is resampled to lie there too: a shift and a
        magnification of the detector leave rays as they are, so that but for the interpolation, by
        splines in an image without noise, it is what a projection with the detector moved would
        give.

    Yields
    ------
    views : slice
        In their order.
    lacking : ndarray of float32, (n, rows, columns)
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
        yield views, stream.download(made)


@dataclass(frozen=True)
class RadiographComparison:
    """How radiographs are compared with those that are simulated.

    Parameters
    ----------
    osem : OrderedSubsets
        Statistics of the photons.
    used : ndarray of bool, (rows, columns)
        Pixels of the binned detector that count.
    registering : bool
        Whether to register the measured radiographs with the simulated ones.
    first : bool
        Whether nothing is known of the motion yet.
    magnification : bool
        Whether to estimate it.
    """

    osem: OrderedSubsets
    used: NDArray[np.bool_]
    registering: bool
    first: bool
    magnification: bool

    def __call__(
        self,
        stream: Stream,
        scan: Scan,
        radiographs: Radiographs,
        pairs: Iterable[tuple[slice, Array, Array]],
        known: Floats,
        keep: Callable[[int, NDArray[np.float32]], None],
    ) -> tuple[float, Floats | None]:
        """Compare.

        Parameters
        ----------
        stream : Stream
            Device and memory budget.
        scan : Scan
            At full resolution, with its mask.
        radiographs : Radiographs
            As measured.
        pairs : iterable
            These and simulated ones, as :func:`clra.methods.alignment.reprojection.reprojected`
            yields them.
        known : ndarray, (views,)
            Magnification that the simulation was made with.
        keep : callable
            Takes the simulated radiographs (n, rows, columns) with the number of the first of them,
            in their order.

        Returns
        -------
        deviance : float
            Poisson deviance of a ray, a mean over the pixels used and a sum over views.
        table : ndarray, (views, fields), or None
            What registration found, see ``ESTIMATE_FIELDS``.
        """
        statistics = self.osem.statistics(stream, self.used, radiographs.level)
        registration = registration_for(
            stream,
            scan,
            radiographs,
            first=self.first,
            magnification=self.magnification,
        ) if self.registering else None  # fmt: skip
        table = np.empty((radiographs.shape[0], len(ESTIMATE_FIELDS))) if self.registering else None
        for views, measured, made in pairs:
            statistics.deviance(stream.queue, made, measured)
            keep(views.start, stream.download(made))
            if registration is not None and table is not None:
                table[views] = register(stream, registration, measured, made, known[views])
        return statistics.misfit(stream.queue, 1), table
