"""How many views see each voxel, and volumes divided by that number."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pyopencl as cl
from numpy.typing import ArrayLike
from pyopencl.array import Array

from clra.errors import InputError
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.sampling.angular_coverage import is_circle
from clra.model.sampling.field_of_view import field_radii
from clra.model.sampling.ray_weights import RayWeights
from clra.ops.filtering.ramp import FADE
from clra.ops.projection.view_arguments import check_geometry, view_weights
from clra.ops.runtime.buffers import Allocator, Scratch, check_array, check_queue, to_device
from clra.ops.runtime.kernel import Step

# Voxels in a coarse one, across the axis and along it, where a view fades out over a tenth of its
# rows. At twice the size the error of W doubles, to 1 %; at half the size W costs as much as a
# twentieth of a back-projection. Where that tenth is less than _ALONG voxels, half or a quarter are
# in a coarse one: with 4, a detector of 5 rows would see its middle plane 14 % too bright.
_ACROSS, _ALONG = 8, 4
# Coarse voxels in that tenth for circles, whose views all fade out at the same height: with one,
# end planes of a detector of 48 rows are 60 % too dark, others 23 % too bright.
_IN_FADE = 4
# A voxel with less than this part of the most views that see the axis is set to zero: a handful of
# views gives streaks, not a reconstruction.
_LEAST = 0.02
# Part of the views that may fail to see a voxel to the side. All views have to, but a few that are
# moved far must not narrow the field of view.
_BLIND = 0.02
_HEIGHTS = 256
# Columns at which ray weights are sampled.
_SAMPLES = 64


def around(planes: slice, of: int) -> slice:
    """Planes of a grid on which W is the same at `planes` as on the whole grid of `of` planes."""
    low = max(0, planes.start // _ALONG - 1) * _ALONG
    return slice(low, min(of, (-(-planes.stop // _ALONG) + 1) * _ALONG))


class Coverage:
    """W(x): the sum, over the views that see x, of their weight and that of the row x falls on.

    Parameters
    ----------
    context : cl.Context
        Where the arrays live.
    geometry : ConeBeamGeometry
        Of the views.
    grid : VolumeGrid
        Of the volume.
    row_weight : array_like, (rows,)
        By which the rows of each projection were multiplied.
    view_weight : array_like, (views,), optional
        By which each projection was multiplied as a whole; 1 by default.
    ray_weights : RayWeights, optional
        By which the rays were multiplied, of these views. W is then the part of the weights that
        falls on the detector's rows: 1 where all views see x.
    circle : bool
        Whether volumes are set to zero outside the circle that all views see.
    allocator : callable, optional
        Gives the scratch memory, see :class:`clra.ops.runtime.buffers.Scratch`.

    Attributes
    ----------
    scratch_bytes : int
        Of scratch memory, which holds W.
    radius : float
        Of the circle outside which volumes are set to zero [mm]; infinite if there is none.

    Raises
    ------
    InputError
        If there is not a weight for each row and view.
    """

    def __init__(
        self,
        context: cl.Context,
        geometry: ConeBeamGeometry,
        grid: VolumeGrid,
        row_weight: ArrayLike,
        *,
        view_weight: ArrayLike | None = None,
        ray_weights: RayWeights | None = None,
        circle: bool = True,
        allocator: Allocator | None = None,
    ) -> None:
        weights = np.asarray(row_weight, np.float64)
        if weights.shape != (geometry.rows,):
            raise InputError(f"row_weight: found {weights.shape}, expected ({geometry.rows},)")
        self._view_weight = view_weights(view_weight, geometry.views)
        self._context = context
        self._grid = grid
        self._counted = (geometry.views, geometry.rows, geometry.columns)
        # One row or column is as good as two alike.
        self._detector = (max(geometry.columns, 2), max(geometry.rows, 2))
        pixel = np.linalg.norm(geometry.v, axis=1) * geometry.source_to_axis
        fade = FADE * geometry.rows * abs(np.median(pixel / geometry.source_to_detector))
        finest = _IN_FADE if is_circle(geometry) else 1
        along = next((n for n in (_ALONG, _ALONG // 2) if fade >= finest * n * grid.voxel_size), 1)
        sizes = self._blocks = np.array([_ACROSS, _ACROSS, along])
        voxels = np.array(grid.shape[::-1])
        coarse = -(-voxels // sizes)
        self._coarse = (int(coarse[0]), int(coarse[1]), int(coarse[2]))
        # The last one ends where the grid does: beyond that there may be no view at all.
        middles = 0.5 * ((coarse - 1) * sizes + voxels - 1)
        self._last_middles = ((middles - 0.5 * (sizes - 1)) / sizes).tolist()
        self._row_weight, self._circle = weights, circle
        self._weights = to_device(context, np.resize(weights, self._detector[1]))
        self._weights_of_views = to_device(context, self._view_weight)
        self._rays = ray_weights
        self._seen = Scratch(context, allocator).empty(self._coarse[1::-1] + self._coarse[2:])
        self.scratch_bytes = self._seen.nbytes
        self._count = Step(context, "coverage.cl", "coverage", (16, 8, 1))
        self._normalise = Step(context, "coverage.cl", "normalise", (64, 1, 1))
        self._last: list[cl.Event] = []
        self.set_geometry(geometry)

    def set_geometry(self, geometry: ConeBeamGeometry) -> None:
        """Take other vectors for the same views and detector; :meth:`compute` counts anew.

        Raises
        ------
        InputError
            If views or detector differ.
        """
        check_geometry(geometry, self._counted)
        self._matrices = to_device(self._context, self._coarse_matrices(geometry))
        sampled = np.ones((1, 2))
        if self._rays is not None:
            self._rays = replace(self._rays, geometry=geometry)
            sampled = self._rays.at(np.linspace(0, self._detector[0] - 1, _SAMPLES))
        self._ray_weight = to_device(self._context, sampled)
        most = _most_views(geometry, self._row_weight, self._view_weight)
        self._least = _LEAST * (most if self._rays is None else 1.0)
        radius = max(0.0, float(np.quantile(field_radii(geometry), _BLIND)))
        self.radius = radius if self._circle else math.inf

    def _coarse_matrices(self, geometry: ConeBeamGeometry) -> np.ndarray:
        """Projection matrices from the middles of coarse voxels."""
        to_fine = np.diag([*self._blocks, 1.0])
        to_fine[:3, 3] = (self._blocks - 1) / 2
        whole = self._grid.whole  # of all slabs the same, so that all count the same views
        matrices = geometry.projection_matrices() @ whole.index_to_world() @ to_fine
        return np.asarray(matrices.reshape(-1, 12))

    def compute(
        self, queue: cl.CommandQueue, wait_for: Sequence[cl.Event] | None = None
    ) -> cl.Event:
        """Count the views.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        wait_for : sequence of cl.Event, optional
            What has to be done before.

        Returns
        -------
        cl.Event
        """
        check_queue(queue, self._context)
        nx, ny, nz = self._coarse
        event = self._count(
            queue,
            (nz, nx, ny),
            self._seen,
            self._matrices,
            self._weights_of_views,
            self._weights,
            self._ray_weight,
            *self._coarse,
            *self._last_middles,
            self._grid.first / float(self._blocks[2]),
            *self._detector,
            self._counted[0],
            0 if self._rays is None else _SAMPLES,
            wait_for=[*(wait_for or ()), *self._last],
        )
        self._last = [event]
        return event

    def normalise(
        self,
        queue: cl.CommandQueue,
        volume: Array,
        scale: float,
        *,
        first: int = 0,
        lowest: float = -math.inf,
        volume_order: str = "zyx",
        wait_for: Sequence[cl.Event] | None = None,
    ) -> cl.Event:
        """Multiply a volume by ``scale / W``, after :meth:`compute`.

        Voxels that hardly any view sees become zero, and so do those outside the circle about the
        axis that all views see: what lies there was measured in some directions only, and would
        come back in re-projections as streaks.

        Parameters
        ----------
        queue : cl.CommandQueue
            In order or out of order.
        volume : Array
            float32 (planes, ny, nx), or (ny, nx, planes) with ``volume_order="yxz"``: the grid's
            volume or a slab of it; changed in place.
        scale : float
            Factor.
        first : int
            Plane of the grid with which the volume begins.
        lowest : float
            Smaller results are raised to it, such as 0 for an attenuation; not above 0.
        volume_order : {"zyx", "yxz"}
            Axes of the volume.
        wait_for : sequence of cl.Event, optional
            What has to be done before.

        Returns
        -------
        cl.Event

        Raises
        ------
        TypeError, InputError
            If the volume is not of this grid.
        """
        check_queue(queue, self._context)
        planes, ny, nx = self._grid.shape
        slices = volume_order == "zyx"
        if getattr(volume, "ndim", 0) == 3:
            planes = min(planes - first, volume.shape[0 if slices else 2])
        shape = (planes, ny, nx) if slices else (ny, nx, planes)
        check_array("volume", volume, shape, context=self._context)
        x, y, _ = self._grid.coordinates()
        size = self._grid.voxel_size
        event = self._normalise(
            queue,
            shape[::-1],
            volume,
            self._seen,
            nx,
            ny,
            planes,
            first,
            *self._coarse,
            *self._last_middles,
            1.0 / _ACROSS,
            1.0 / float(self._blocks[2]),
            float(-x[0] / size),
            float(-y[0] / size),
            self.radius / self._grid.voxel_size,
            self._least,
            float(scale),
            float(lowest),
            int(slices),
            wait_for=[*(wait_for or ()), *self._last],
        )
        self._last = [event]
        return event


def _most_views(
    geometry: ConeBeamGeometry, row_weight: np.ndarray, view_weight: np.ndarray
) -> float:
    """W where it is largest on the axis."""
    low, high = geometry.source[:, 2].min(), geometry.source[:, 2].max()
    heights = np.linspace(low, high, _HEIGHTS if high > low else 1)
    axis = np.column_stack([np.zeros((len(heights), 2)), heights])
    row = geometry.project(axis)[..., 1]
    on = (row >= 0) & (row <= geometry.rows - 1)
    weight = np.interp(row, np.arange(geometry.rows), row_weight)
    return float((view_weight @ np.where(on, weight, 0.0)).max())
