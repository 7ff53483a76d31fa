"""Projection and its adjoint as a linear operator on the host, for iterative solvers."""

from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray
from pyopencl.array import Array
from scipy.sparse.linalg import LinearOperator

from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.ops.projection.projector import BackProjector, ForwardProjector

Floats = NDArray[np.float32]


def as_linear_operator(
    geometry: ConeBeamGeometry, grid: VolumeGrid, queue: cl.CommandQueue
) -> LinearOperator:
    """Return the matrix A of the forward projection, for LSQR and its like.

    It is made of `ForwardProjector` and its exact adjoint, so that
    solvers that need both converge. ``A @ x`` copies to the device and back, and so blocks; it uses
    the queue, which stays the caller's. What takes a scipy operator takes this one, for example the
    solvers of scipy and of pylops.

    Parameters
    ----------
    geometry : ConeBeamGeometry
        Of the projections.
    grid : VolumeGrid
        Of the volume.
    queue : cl.CommandQueue
        In order or out of order.

    Returns
    -------
    scipy.sparse.linalg.LinearOperator
        Shape (views rows columns, nz ny nx), float32: of a volume (z, y, x) [1/mm], flattened, it
        makes projections (view, row, column), flattened. Not to be used by two threads at a time.

    Raises
    ------
    InputError
        If the grid reaches behind a source.

    Examples
    --------
    >>> A = as_linear_operator(geometry, grid, queue)  # doctest: +SKIP
    >>> volume = lsqr(A, projections.ravel(), iter_lim=20)[0].reshape(grid.shape)  # doctest: +SKIP
    """
    pair = _Pair(geometry, grid, queue)
    shape = (pair.projections.size, pair.volume.size)
    return LinearOperator(shape, matvec=pair.forward, rmatvec=pair.adjoint, dtype=np.float32)


class _Pair:
    """Both projectors with device arrays for what they read and write."""

    def __init__(
        self, geometry: ConeBeamGeometry, grid: VolumeGrid, queue: cl.CommandQueue
    ) -> None:
        context = queue.context
        self._queue = queue
        self._project = ForwardProjector(context, geometry, grid)
        self._back_project = BackProjector(context, geometry, grid, matched=True)
        self.volume = Array(context, grid.shape, np.float32)
        self.projections = Array(context, (geometry.views, *geometry.shape), np.float32)

    def forward(self, volume: NDArray[Any]) -> Floats:
        return self._run(self._project, self.projections, self.volume, volume)

    def adjoint(self, projections: NDArray[Any]) -> Floats:
        return self._run(self._back_project, self.volume, self.projections, projections)

    def _run(
        self,
        operator: ForwardProjector | BackProjector,
        out: Array,
        source: Array,
        values: NDArray[Any],
    ) -> Floats:
        """Host to device, operator, device to host."""
        host = np.ascontiguousarray(values, np.float32).reshape(-1)
        result = np.empty(out.size, np.float32)
        written: Any = source.base_data
        read: Any = out.base_data
        copied = cl.enqueue_copy(self._queue, written, host)
        done = operator(self._queue, out, source, wait_for=[copied])
        cl.enqueue_copy(self._queue, result, read, wait_for=[done])
        return result
