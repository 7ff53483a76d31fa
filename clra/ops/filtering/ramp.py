"""Ramp filter of radiographs, for filtered back-projection along any trajectory."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pyopencl as cl
from numpy.typing import ArrayLike, NDArray
from pyopencl.array import Array

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.sampling.ray_weights import RayWeights, widened
from clra.ops.filtering.fft import RealFFT, fast_length
from clra.ops.filtering.ramp_transform import RampTransform, ramp_spectrum, transform_length
from clra.ops.projection.view_arguments import check_geometry, successive, view_weights
from clra.ops.runtime.buffers import Allocator, Scratch, check_array, check_queue, to_device, within
from clra.ops.runtime.kernel import Step
from clra.ops.runtime.profile import profile_of

WINDOWS = ("ram-lak", "shepp-logan", "hann")

# Part of the rows at the top and at the bottom over which a view fades out. Without it the border
# of each detector leaves an edge in the volume; a tenth smooths it and costs few rays.
FADE = 0.1

# Some drivers take no more than 65535 work-groups along a range's second and third axes.
_MOST_LINES = 1 << 15

# Past this part of its columns a row is not continued: padded lines would only grow.
_MOST_EXTENSION = 4.0


def taper(rows: int, fraction: float) -> NDArray[np.float32]:
    """Weights of detector rows that fall off towards the top and the bottom of the detector.

    They keep the borders of cone-beam data, where views end abruptly, from showing in a
    reconstruction that is divided by the summed weights.

    Parameters
    ----------
    rows : int
        Rows of the detector.
    fraction : float
        Part of the rows, at each end, over which the weight falls as a squared cosine; 0 to 0.5.

    Returns
    -------
    ndarray, (rows,)
        float32, symmetric, above 0, at most 1.

    Raises
    ------
    InputError
        If the fraction is out of range.
    """
    if not 0 <= fraction <= 0.5:
        raise InputError(f"fraction: found {fraction}, expected 0 to 0.5")
    row = np.arange(rows)
    depth = np.minimum(row, rows - 1 - row) + 0.5
    roll = np.minimum(1.0, depth / max(fraction * rows, 0.5))
    return (np.sin(np.pi / 2 * roll) ** 2).astype(np.float32)


class RampFilter:
    """Cosine weight, ramp filter along u, and the scale that back-projection needs.

    Of radiographs p of line integrals it makes ``q = R / (SDD |u'|) (p w r) * h`` with R the
    distance from source to axis, SDD that to the detector, u' what of u is across the way to the
    axis (all of it, if the detector faces the axis), w SDD over the length of the ray, r the row,
    ray and view weights, and h the band-limited ramp, ``h[0] = 1/4``, ``h[n] = -1 / (pi n)^2`` for
    odd n, 0 for even n. With depth fractions g(x) and summed row weights W(x) the attenuation is
    ``f(x) = pi / W(x) sum_i q_i(x) / g_i(x)^2`` for views around the whole circle. [1]_

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    geometry : ConeBeamGeometry
        Of all views.
    row_weight : array_like, optional
        (rows,) weights of the detector's rows, see :func:`taper`; 1 by default.
    view_weight : array_like, optional
        (views,) weights of the radiographs as a whole; 1 by default.
    ray_weights : RayWeights, optional
        Of redundant rays; 1 by default. Past the near side of an offset detector rays weigh
        nothing, but the filter's tails count: filtered radiographs are wider there.
    window : {"ram-lak", "shepp-logan", "hann"}
        What the ramp's spectrum is multiplied by: nothing, a sinc, or a raised cosine that is 0 at
        the Nyquist frequency.
    extend : float
        Continue each row past the detector, by this part of its columns on each side, from its
        outermost value to 0 as the chords of a circle do: for samples that are wider than the
        detector.
    backend : {"scipy", "reikna"}, optional
        As for :class:`clra.ops.filtering.fft.RealFFT`; with "scipy" a call blocks the host.
    allocator : callable, optional
        Gives the scratch memory, see :class:`clra.ops.runtime.buffers.Scratch`.
    scratch_limit : int, optional
        Bytes of scratch: fewer lines are treated at a time.

    Attributes
    ----------
    window : str
        As given.
    geometry : ConeBeamGeometry
        Of the filtered radiographs.
    padded : int
        Columns of a line in the transforms, at least twice those of the detector.
    scratch_bytes : int
        Of scratch memory.

    Raises
    ------
    InputError
        If an argument is none of the above.

    References
    ----------
    .. [1] A. C. Kak and M. Slaney, "Principles of Computerized Tomographic Imaging", IEEE Press,
       1988, sections 3.3.3 and 3.6.2.
    """

    def __init__(
        self,
        context: cl.Context,
        geometry: ConeBeamGeometry,
        *,
        row_weight: ArrayLike | None = None,
        view_weight: ArrayLike | None = None,
        ray_weights: RayWeights | None = None,
        window: str = "ram-lak",
        extend: float = 0.0,
        backend: str | None = None,
        allocator: Allocator | None = None,
        scratch_limit: int | None = None,
    ) -> None:
        if not 0 <= extend <= _MOST_EXTENSION:
            raise InputError(f"extend: found {extend}, expected 0 to {_MOST_EXTENSION:g}")
        if window not in WINDOWS:
            raise InputError(f"window: found {window!r}, expected one of {', '.join(WINDOWS)}")
        self.window = window
        self._context = context
        self._views, self._rows, self._columns = geometry.views, geometry.rows, geometry.columns
        margin = math.ceil(extend * self._columns)
        self._wider = (0, 0) if ray_weights is None else ray_weights.beyond
        least = 2 * (self._columns + margin + max(self._wider))
        length = transform_length(context, least) if backend is None else None
        self.padded = length or fast_length(context, least, backend)
        self._row_weight = to_device(context, _row_weights(row_weight, self._rows))
        self._view_weight = view_weights(view_weight, self._views)
        self._ray_weights = ray_weights
        self._alike = to_device(context, np.ones(self._columns))
        self._roll = to_device(context, _roll(self.padded - self._columns, margin, self._columns))
        self._last: list[cl.Event] = []
        self.set_geometry(geometry)
        spectrum = ramp_spectrum(self.padded, window)
        self._transform = RampTransform(context, spectrum) if length else None
        self.scratch_bytes = 0
        if length is None:
            self._in_steps(context, spectrum, backend, allocator, scratch_limit)

    def _in_steps(
        self,
        context: cl.Context,
        spectrum: NDArray[np.float32],
        backend: str | None,
        allocator: Allocator | None,
        scratch_limit: int | None,
    ) -> None:
        """Prepare to weigh lines, to transform them and to cut them out."""
        self._lanes = profile_of(context).image_lanes
        most = within(profile_of(context).filter_bytes, scratch_limit) // (4 * self.padded)
        lines = (min(self._views * self._rows, max(1, most), _MOST_LINES), 1, self.padded)
        memory = Scratch(context, allocator)
        self._lines = memory.empty(lines)
        self._fft = RealFFT(context, lines, (2,), backend, allocator=memory)
        self.scratch_bytes = self._lines.nbytes + self._fft.scratch_bytes
        defines = {"LANES": self._lanes}
        self._weight = Step(context, "ramp.cl", "weight_lines", (64, 2), defines)
        self._cut = Step(context, "ramp.cl", "cut_lines", (64, 2), defines)
        self._ramp = to_device(context, spectrum)

    def filtered_geometry(self, geometry: ConeBeamGeometry) -> ConeBeamGeometry:
        """Return the geometry of the filtered radiographs of a geometry that is to be set."""
        return widened(geometry, *self._wider)

    def set_geometry(self, geometry: ConeBeamGeometry) -> None:
        """Take a geometry of the same views and shape, for example with another motion.

        Raises
        ------
        InputError
            If views or shape differ.
        """
        check_geometry(geometry, (self._views, self._rows, self._columns))
        self.geometry = self.filtered_geometry(geometry)
        if self._ray_weights is not None:
            self._ray_weights = replace(self._ray_weights, geometry=geometry)
        self._view_table = to_device(self._context, _view_table(geometry, self._view_weight))

    def __call__(
        self,
        queue: cl.CommandQueue,
        filtered_out: Array,
        projections: Array,
        *,
        views: slice | None = None,
        rows: slice | None = None,
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Filter radiographs, or some rows of them.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        filtered_out : cl.array.Array
            float32 (n, rows, columns) of :attr:`geometry` [1/mm], overwritten, but for other rows;
            may be `projections` itself if that has the same shape.
        projections : cl.array.Array
            float32 (n, rows, columns), line integrals.
        views : slice, optional
            The n successive views of the geometry that these are; all by default.
        rows : slice, optional
            The successive rows of the detector that `projections` has; all by default.
        wait_for : sequence of cl.Event, optional
            What has to be done before.

        Returns
        -------
        cl.Event

        Raises
        ------
        TypeError, InputError
            If an argument is none of the above.
        """
        check_queue(queue, self._context)
        start, stop = successive(views, self._views)
        top, bottom = successive(rows, self._rows, "rows")
        shape = (stop - start, bottom - top, self._columns)
        check_array("projections", projections, shape, context=self._context)
        filtered_shape = (shape[0], *self.geometry.shape)
        check_array("filtered_out", filtered_out, filtered_shape, context=self._context)
        total = shape[0] * shape[1]
        events = [*(wait_for or ()), *self._last]
        sizes = (self._columns, self.padded)
        rays, stride = self._alike, 0
        if self._ray_weights is not None:
            table = self._ray_weights.at(np.arange(self._columns), slice(start, stop))
            rays, stride = to_device(self._context, table), self._columns
        if self._transform is not None:
            tables = self._view_table[start:], self._row_weight, rays, self._roll
            event = self._transform(
                queue, filtered_out, projections, tables, stride, self._wider[0], top, events
            )
            self._last = [event]
            return event
        for first in range(0, total, len(self._lines)):
            count = min(len(self._lines), total - first)
            part = self._lines[:count]
            event = self._weight(
                queue,
                (-(-self.padded // self._lanes), count),
                part,
                projections,
                self._view_table[start:],
                self._row_weight,
                rays,
                self._roll,
                first,
                count,
                shape[1],
                top,
                *sizes,
                stride,
                wait_for=events,
            )
            event = self._fft.apply(queue, part, part, self._ramp, [event])
            event = self._cut(
                queue,
                (-(-self.geometry.columns // self._lanes), count),
                filtered_out,
                part,
                first,
                count,
                shape[1],
                top,
                self._rows,
                self.geometry.columns,
                self.padded,
                self._wider[0],
                wait_for=[event],
            )
            events = [event]
        self._last = events
        return event


def _row_weights(row_weight: ArrayLike | None, rows: int) -> NDArray[np.float32]:
    if row_weight is None:
        return np.ones(rows, np.float32)
    weights = np.ascontiguousarray(row_weight, np.float32)
    if weights.shape != (rows,) or not np.all(np.isfinite(weights)):
        raise InputError(f"row_weight: found shape {weights.shape}, expected {rows} finite numbers")
    return weights


def _view_table(
    geometry: ConeBeamGeometry, view_weight: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Make the table (views, 6) that ramp.cl reads."""
    distance = geometry.source_to_detector
    u, v = geometry.u / distance[:, None], geometry.v / distance[:, None]
    # Of a detector that does not face the axis, columns are closer as the axis sees them.
    radius = np.hypot(*geometry.source[:, :2].T)
    to_axis = -geometry.source[:, :2] / np.maximum(radius, np.finfo(float).tiny)[:, None]
    along = np.sum(geometry.u[:, :2] * to_axis, axis=1)
    pitch = np.sqrt(np.maximum(np.sum(geometry.u**2, axis=1) - along**2, 0.0))
    columns = [
        geometry.principal[:, 0],
        geometry.principal[:, 1],
        np.sum(u * u, axis=1),
        np.sum(v * v, axis=1),
        2 * np.sum(u * v, axis=1),
        view_weight * radius / (distance * pitch),
    ]
    return np.stack(columns, axis=1).astype(np.float32)


def _roll(length: int, margin: int, columns: int) -> NDArray[np.float64]:
    """Weights between the end of a row and, cyclically, its start: down to 0, and up again."""
    weights = np.zeros(length)
    radius, edge = columns / 2 + margin, columns / 2
    distance = edge + np.arange(margin) + 0.5
    if margin:
        weights[:margin] = np.sqrt((radius**2 - distance**2) / (radius**2 - edge**2))
    return np.maximum(weights, weights[::-1])
