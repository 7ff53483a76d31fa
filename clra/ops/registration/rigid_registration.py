"""Normal equations for a small rigid motion of the sample in each view."""

from collections.abc import Sequence

import numpy as np
import pyopencl as cl
from numpy.typing import ArrayLike, NDArray
from pyopencl.array import Array

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.rigid.rigid_motion import turning_axes, view_axes
from clra.ops.images.bandpass import Bandpass
from clra.ops.registration.windows import box, registration_window
from clra.ops.runtime.buffers import (
    Allocator,
    Scratch,
    check_array,
    check_images,
    check_queue,
    to_device,
)
from clra.ops.runtime.kernel import Step
from clra.ops.runtime.profile import profile_of

Floats = NDArray[np.float64]

# As in rigid_registration.cl.
IMAGES = 8
PRODUCTS = IMAGES * (IMAGES + 1) // 2
_BLOCK_ROWS = 8


class RigidRegistration:
    r"""Which rigid motion of the sample brings simulated radiographs closer to measured ones.

    With the derivatives :math:`J_k` of the simulated radiograph p by the six parameters of
    :class:`~clra.model.rigid.rigid_motion.RigidMotion`, the band-pass D and weights W, the normal
    equations of

    .. math:: \sum_q W(q) \left[ D(m - p) - \sum_k x_k D J_k - g D p \right]^2(q)

    in the motion x and a gain g are summed up for each view. The derivatives follow from image
    gradients of p and of the integrals over the depth, which
    :class:`~clra.ops.projection.moment_projector.MomentProjector` gives: no further projection.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    shape : (int, int)
        Rows and columns.
    views : int
        Most views of a call.
    low_pass, high_pass : float
        Sigmas of the band-pass [pixel].
    margin : float
        Part of height and width without weight at the border, as for `registration_window`.
    mask : array_like of bool, optional
        (rows, columns), True where pixels count.
    allocator : callable, optional
        Gives the scratch memory, see :class:`clra.ops.runtime.buffers.Scratch`.

    Attributes
    ----------
    scratch_bytes : int
        Of scratch memory.
    total_weight : float
        Sum of W.
    blocks : int
        Bands of rows whose sums are kept apart.
    """

    def __init__(
        self,
        context: cl.Context,
        shape: tuple[int, int],
        *,
        views: int,
        low_pass: float = 0.7,
        high_pass: float = 8.0,
        margin: float = 0.12,
        mask: ArrayLike | None = None,
        allocator: Allocator | None = None,
    ) -> None:
        if views < 1:
            raise InputError(f"views: found {views}, expected 1 or more")
        self.shape, self._context, self._views = shape, context, views
        self.low_pass = low_pass
        cpu = profile_of(context).on_cpu
        self._strands = 1 if cpu else 64
        memory = Scratch(context, allocator)
        self._band = Bandpass(
            context,
            shape,
            views=IMAGES * views,
            low_pass=low_pass,
            high_pass=high_pass,
            mask=mask,
            allocator=memory,
        )
        weights = registration_window(shape, margin, low_pass, mask)
        self.total_weight = float(weights.sum())
        self._weights = to_device(context, weights)
        self._box = box(weights)
        self.blocks = -(-(self._box[1] - self._box[0]) // _BLOCK_ROWS)
        self._images, self._banded = (memory.empty((views, IMAGES, *shape)) for _ in range(2))
        self._sums = memory.empty((views, self.blocks, self._strands, PRODUCTS))
        defines = {"LANES": 8 if cpu else 1}
        self._derivatives, self._products, self._totals = (
            Step(context, "rigid_registration.cl", name, local, defines)
            for name, local in (
                ("rigid_derivatives", (64, 1, 1)),
                ("rigid_products", (1 if cpu else 64, 1, 1)),
                ("rigid_totals", (PRODUCTS, 1)),
            )
        )
        self.scratch_bytes = memory.bytes
        self._last: list[cl.Event] = []

    def __call__(
        self,
        queue: cl.CommandQueue,
        totals_out: Array,
        measured: Array,
        simulated: Array,
        over_depth: Array,
        views: Array,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Sum up the products of every two images of each view.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        totals_out : cl.array.Array
            float32 (n, blocks, 36), overwritten: the upper triangle, row by row, of the products of
            the six derivatives [attenuation per mm or rad], the simulated radiograph and the
            difference, summed up over each band of rows.
        measured, simulated, over_depth : cl.array.Array
            float32 (n, rows, columns): measured and simulated line integrals, and integrals of the
            volume over the depth.
        views : cl.array.Array
            float32 (n, 80), rows of :func:`rigid_table`.
        wait_for : sequence of cl.Event, optional
            What has to be done before.

        Returns
        -------
        cl.Event

        Raises
        ------
        TypeError, InputError
            If an array is none of the above.
        """
        check_queue(queue, self._context)
        n = check_images("measured", measured, self.shape, self._context)
        if n > self._views:
            raise InputError(f"measured: found {n} views, expected 1 to {self._views}")
        for name, array in (("simulated", simulated), ("over_depth", over_depth)):
            check_array(name, array, (n, *self.shape), context=self._context)
        check_array("views", views, (n, TABLE), context=self._context)
        check_array("totals_out", totals_out, (n, self.blocks, PRODUCTS), context=self._context)
        rows, columns = self.shape
        event = self._derivatives(
            queue,
            (columns, rows, n),
            *(self._images, measured, simulated, over_depth, views, columns, rows, n),
            wait_for=[*(wait_for or ()), *self._last],
        )
        flat = (n * IMAGES, rows, columns)
        event = self._band(
            queue,
            self._banded[:n].reshape(flat),
            self._images[:n].reshape(flat),
            wait_for=[event],
        )
        event = self._products(
            queue,
            (self._strands, self.blocks, n),
            *(self._sums, self._banded, self._weights, columns, rows),
            *self._box,
            *(_BLOCK_ROWS, self.blocks, self._strands, n),
            wait_for=[event],
        )
        event = self._totals(
            queue,
            (PRODUCTS, n * self.blocks),
            *(totals_out, self._sums, self._strands, n * self.blocks),
            wait_for=[event],
        )
        self._last = [event]
        return event


TABLE = 80


def rigid_table(geometry: ConeBeamGeometry) -> NDArray[np.float32]:
    """Compose in float64 what rigid_registration.cl calls a view, (views, 80).

    Raises
    ------
    InputError
        If rows and columns of a detector are not perpendicular.
    """
    axes = view_axes(geometry)
    turning = turning_axes(axes)
    far, near = geometry.source_to_detector, geometry.source_to_axis
    normal = geometry.normal / far[:, None]
    to_centre = geometry.detector - geometry.source
    u, v = geometry.u, geometry.v
    dual_u, dual_v = (a / np.sum(a**2, axis=1, keepdims=True) for a in (u, v))
    centre_from_source = geometry.normal * near[:, None]

    def dot(a: Floats, b: Floats) -> Floats:
        return np.asarray(np.sum(a * b, axis=1))

    table = np.zeros((geometry.views, TABLE))
    table[:, 0], table[:, 1] = dot(to_centre, dual_u), dot(to_centre, dual_v)
    table[:, 2:8] = np.stack(
        [
            dot(to_centre, to_centre),
            2 * dot(to_centre, u),
            2 * dot(to_centre, v),
            dot(u, u),
            dot(v, v),
            2 * dot(u, v),
        ],
        axis=1,
    )
    for k in range(6):
        numbers = table[:, 8 + 12 * k : 20 + 12 * k]
        if k < 3:
            velocity = axes[:, :, k]
        else:
            axis = turning[:, :, k - 3]
            velocity = -np.cross(axis, centre_from_source)
            across = [np.cross(axis, a) for a in (to_centre, u, v)]
            for part, direction in enumerate((dual_u, dual_v, normal)):
                for power, vector in enumerate(across):
                    numbers[:, 3 + 3 * part + power] = dot(vector, direction)
        for part, direction in enumerate((dual_u, dual_v, normal)):
            numbers[:, part] = dot(velocity, direction)
    return table.astype(np.float32)
