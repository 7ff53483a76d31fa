"""One iteration of re-projection alignment as an operator, for scans that fit on the device."""

import math
from collections.abc import Sequence
from typing import Any

import pyopencl as cl
from numpy.typing import ArrayLike
from pyopencl.array import Array

from clra.methods.alignment.reprojection import band_of
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.sampling.ray_weights import ray_weights
from clra.ops.filtering.ramp import FADE, RampFilter, taper
from clra.ops.projection.coverage import Coverage
from clra.ops.projection.layout import volume_shape
from clra.ops.projection.projector import BackProjector, ForwardProjector
from clra.ops.registration.gauss_newton import ESTIMATE_FIELDS, Registration
from clra.ops.runtime.buffers import Allocator, Scratch, check_array, check_queue, within
from clra.ops.runtime.profile import profile_of


class AlignmentStep:
    """Reconstruct, project forward, register: steps 2 to 4 of re-projection alignment [1]_.

    Of radiographs it makes the volume by ramp-filtered back-projection, divided by how many views
    see each voxel, and the residual motion of each radiograph against its re-projection. Append
    what it finds to the motion that the geometry has absorbed, :meth:`set_geometry`, and call
    again.

    It is the paper's iteration for somebody who keeps radiographs and volume on the device and
    writes the loop; :func:`clra.align` cuts both to fit the memory, goes through resolutions, takes
    off the bias of small detectors, and deals with outliers and with the gauge.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    geometry : ConeBeamGeometry
        Of the radiographs, with the motion known so far absorbed.
    grid : VolumeGrid
        Of the volume, which should hold the sample.
    row_weight : array_like, optional
        (rows,) weights of the detector's rows in the reconstruction; by default they fade out over
        a tenth of the rows at the top and at the bottom, see :func:`clra.ops.filtering.ramp.taper`.
    volume_order : {"zyx", "yxz"}
        Axes of the volume. "yxz" is the kernels' own order and takes two scratch volumes less.
    positive : bool
        Raise negative attenuations to zero before the volume is projected, as :func:`clra.align`
        does.
    low_pass, high_pass : float, optional
        Sigmas of the band-pass [pixel]; by default those of :func:`clra.align`.
    mask, magnification, spread
        As :class:`clra.ops.registration.gauss_newton.Registration` takes them.
    allocator : callable, optional
        Gives the scratch memory, see :class:`clra.ops.runtime.buffers.Scratch`.
    scratch_limit : int, optional
        Bytes of scratch of each operation and of what passes between them: fewer radiographs are
        treated at a time, at least one.

    Attributes
    ----------
    scratch_bytes : int
        Most bytes of scratch memory that it takes.

    Raises
    ------
    InputError
        If an argument is none of the above.

    References
    ----------
    .. [1] "Multi-resolution radiograph alignment for motion correction in X-ray micro-tomography",
       Algorithm 1.
    """

    def __init__(
        self,
        context: cl.Context,
        geometry: ConeBeamGeometry,
        grid: VolumeGrid,
        *,
        row_weight: ArrayLike | None = None,
        volume_order: str = "zyx",
        positive: bool = True,
        low_pass: float | None = None,
        high_pass: float | None = None,
        mask: ArrayLike | None = None,
        magnification: bool = True,
        spread: float = 0.0,
        allocator: Allocator | None = None,
        scratch_limit: int | None = None,
    ) -> None:
        self._context, self._order = context, volume_order
        self._shape = (geometry.views, *geometry.shape)
        weights = taper(geometry.rows, FADE) if row_weight is None else row_weight
        memory = Scratch(context, allocator)
        most = within(profile_of(context).step_bytes, scratch_limit)
        views = min(geometry.views, max(1, most // (4 * geometry.rows * geometry.columns)))
        within_limits: dict[str, Any] = {"allocator": memory, "scratch_limit": scratch_limit}
        rays = ray_weights(geometry)
        self._scale = math.pi if rays is None else rays.covered / geometry.views
        self._ramp = RampFilter(
            context, geometry, row_weight=weights, ray_weights=rays, **within_limits
        )
        wide = self._ramp.geometry
        self._between = memory.empty((views, *geometry.shape))
        self._filtered = self._between
        if wide.shape != geometry.shape:
            self._filtered = memory.empty((views, *wide.shape))
        self._coverage = Coverage(
            context, geometry, grid, weights, ray_weights=rays, allocator=memory
        )
        self._back = BackProjector(context, wide, grid, volume_order=volume_order, **within_limits)
        self._forward = ForwardProjector(
            context, geometry, grid, volume_order=volume_order, **within_limits
        )
        usual_low, usual_high = band_of(geometry.shape)
        self._registration = Registration(
            context,
            geometry.shape,
            views=views,
            low_pass=usual_low if low_pass is None else low_pass,
            high_pass=usual_high if high_pass is None else high_pass,
            mask=mask,
            magnification=magnification,
            spread=spread,
            **within_limits,
        )
        self._lowest = 0.0 if positive else -math.inf
        self._volume_shape = volume_shape(grid, volume_order)
        operations = (
            self._ramp,
            self._coverage,
            self._back,
            self._forward,
            self._registration,
        )
        between = {id(one): one.nbytes for one in (self._between, self._filtered)}
        self.scratch_bytes = sum(between.values()) + sum(one.scratch_bytes for one in operations)
        self._last: list[cl.Event] = []

    def set_geometry(self, geometry: ConeBeamGeometry) -> None:
        """Take other vectors for the same views and detector: the next motion.

        Raises
        ------
        InputError
            If views or detector differ, or the grid reaches behind a source.
        """
        # The projectors first: only they may refuse the grid, and then nothing has changed.
        self._back.set_geometry(self._ramp.filtered_geometry(geometry))
        for operation in (self._forward, self._ramp, self._coverage):
            operation.set_geometry(geometry)

    def __call__(
        self,
        queue: cl.CommandQueue,
        estimates_out: Array,
        volume_out: Array,
        radiographs: Array,
        known: Array | None = None,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Run one iteration.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        estimates_out : cl.array.Array
            float32 (views, 10), overwritten, columns in the order of
            :data:`clra.ops.registration.gauss_newton.ESTIMATE_FIELDS`, as
            `Registration` gives them: shifts in pixels of these
            radiographs and magnification, to append by :meth:`clra.Motion.then`.
        volume_out : cl.array.Array
            float32 (nz, ny, nx), or (ny, nx, nz) if so constructed, overwritten [1/mm].
        radiographs : cl.array.Array
            float32 (views, rows, columns), line integrals.
        known : cl.array.Array, optional
            float32 (views,): logarithm of the magnification that the geometry has absorbed.
        wait_for : sequence of cl.Event, optional
            What has to be done before.

        Returns
        -------
        cl.Event
            Of the last of it: volume and estimates are there.

        Raises
        ------
        TypeError, InputError
            If an argument is none of the above.
        """
        check_queue(queue, self._context)
        views = self._shape[0]
        for name, array, shape in (
            ("estimates_out", estimates_out, (views, len(ESTIMATE_FIELDS))),
            ("volume_out", volume_out, self._volume_shape),
            ("radiographs", radiographs, self._shape),
        ):
            check_array(name, array, shape, context=self._context)
        if known is not None:
            check_array("known", known, (views,), context=self._context)
        event = cl.enqueue_marker(queue, [*(wait_for or ()), *self._last])
        event = self._reconstruct(queue, volume_out, radiographs, event)
        for part in self._parts():
            simulated = self._between[: part.stop - part.start]
            event = self._forward(queue, simulated, volume_out, views=part, wait_for=[event])
            event = self._registration(
                queue,
                estimates_out[part],
                radiographs[part],
                simulated,
                None if known is None else known[part],
                wait_for=[event],
            )
        self._last = [event]
        return event

    def _reconstruct(
        self, queue: cl.CommandQueue, volume: Array, radiographs: Array, event: cl.Event
    ) -> cl.Event:
        for part in self._parts():
            filtered = self._filtered[: part.stop - part.start]
            event = self._ramp(queue, filtered, radiographs[part], views=part, wait_for=[event])
            event = self._back(
                queue, volume, filtered, views=part, accumulate=part.start > 0, wait_for=[event]
            )
        event = self._coverage.compute(queue, [event])
        return self._coverage.normalise(
            queue,
            volume,
            self._scale,
            lowest=self._lowest,
            volume_order=self._order,
            wait_for=[event],
        )

    def _parts(self) -> list[slice]:
        """Cut the views into runs that fit between two operations."""
        views, most = self._shape[0], len(self._between)
        return [slice(start, min(views, start + most)) for start in range(0, views, most)]
