"""What a device has to build and compute before it is trusted, run in a process of its own.

A compiler that aborts, or kernels that crash, so end a child process and not the user's.
:mod:`clra.ops.runtime.self_test` starts it with one JSON object as its argument and reads one from
its output. All answers are known in closed form.
"""

import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
from numpy.typing import NDArray

from clra.errors import KernelBuildError
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.trajectory import circular
from clra.ops.projection.projector import BackProjector, ForwardProjector
from clra.ops.registration.gauss_newton import ESTIMATE_FIELDS, Registration
from clra.ops.runtime import build, devices, pocl, self_test
from clra.ops.runtime.kernel import work_group_size

# Of the largest value: float32 rounding stays below 1e-6; a registration is exact to 1.6e-3.
TOLERANCE, REGISTRATION_TOLERANCE = 1e-4, 3e-3

# Vectors of 8 and 16, conversions between types, built-in functions, local memory and barriers.
_BASICS = """
kernel void vectors(global float *out, global const int *in)
{
    const int i = get_global_id(0);
    const float16 x = convert_float16(vload16(i, in));
    const float8 y = convert_float8(convert_long8(vload8(2 * i, in)));
    const float8 z = convert_float8(convert_uchar8_sat(vload8(2 * i + 1, in)));
    vstore16(fma(x, (float16)(0.5f), floor(x * 0.3f)), 2 * i, out);
    vstore16((float16)(convert_float8(convert_int8_rtz(y * 0.7f)), z), 2 * i + 1, out);
}
kernel void running_sums(global float *out, global const int *in, local float *sums)
{
    const int i = get_local_id(0), n = get_local_size(0);
    sums[i] = in[get_global_id(0)];
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int step = 1; step < n; step *= 2) {
        const float before = i >= step ? sums[i - step] : 0.0f;
        barrier(CLK_LOCAL_MEM_FENCE);
        sums[i] += before;
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    out[get_global_id(0)] = sums[i];
}
"""
_VIEWS, _SHAPE = 6, (37, 41)
_GRID = VolumeGrid(shape=(33, 32, 32), voxel_size=0.5)
_SHIFT = (2.0, -1.0)

Floats = NDArray[np.float64]
Case = Callable[[cl.CommandQueue], tuple[Floats, Floats]]


def vectors(queue: cl.CommandQueue) -> tuple[Floats, Floats]:
    """Conversions and arithmetic in vectors of 8 and 16, and numpy's."""
    numbers = np.random.default_rng(0).integers(-500, 500, (64, 16), np.int32)
    program = _program(queue)
    out = cl_array.empty(queue, (64, 32), np.float32)
    given = cl_array.to_device(queue, numbers)
    kernel: Any = cl.Kernel(program, "vectors")
    kernel(queue, (64,), None, out.data, given.data)
    single = numbers.astype(np.float32)
    sums = single.astype(np.float64) * 0.5 + np.floor(single * np.float32(0.3))
    truncated = np.trunc(single[:, :8] * np.float32(0.7))
    clipped = np.clip(numbers[:, 8:], 0, 255)
    return out.get().astype(np.float64), np.hstack([sums, truncated, clipped])


def running_sums(queue: cl.CommandQueue) -> tuple[Floats, Floats]:
    """Cumulative sums over work-groups, through local memory."""
    kernel: Any = cl.Kernel(_program(queue), "running_sums")
    (size,) = work_group_size(kernel, queue.device, (32,))
    numbers = np.arange(3 * size, dtype=np.int32) % 7
    out = cl_array.empty(queue, numbers.shape, np.float32)
    given = cl_array.to_device(queue, numbers)
    kernel(queue, numbers.shape, (size,), out.data, given.data, cl.LocalMemory(4 * size))
    return out.get().astype(np.float64), numbers.reshape(3, size).cumsum(axis=1).ravel() * 1.0


def forward_projection(queue: cl.CommandQueue) -> tuple[Floats, Floats]:
    """Line integrals through a sphere, R^2 - r^2, where rays cross the whole grid."""
    geometry = _geometry()
    z, y, x = np.meshgrid(*map(_centres, _GRID.shape), indexing="ij")
    radius_squared = 3 * (0.5 * 33 * _GRID.voxel_size) ** 2
    volume = (radius_squared - x**2 - y**2 - z**2).astype(np.float32)
    projections = cl_array.empty(queue, (_VIEWS, *_SHAPE), np.float32)
    forward = ForwardProjector(queue.context, geometry, _GRID)
    forward(queue, projections, cl_array.to_device(queue, volume))
    found = projections.get().astype(np.float64)
    expected, known = _line_integrals(geometry, radius_squared)
    return found[known], expected[known]


def back_projection(queue: cl.CommandQueue) -> tuple[Floats, Floats]:
    """Radiographs that are linear in row and column, which interpolation gives exactly."""
    geometry = _geometry()
    row, column = np.meshgrid(*map(np.arange, _SHAPE), indexing="ij")
    image = (1 + 0.02 * row - 0.03 * column).astype(np.float32)
    radiographs = cl_array.to_device(queue, np.tile(image, (_VIEWS, 1, 1)))
    volume = cl_array.empty(queue, _GRID.shape, np.float32)
    BackProjector(queue.context, geometry, _GRID)(queue, volume, radiographs)
    z, y, x = np.meshgrid(*map(_centres, _GRID.shape), indexing="ij")
    points = np.stack([x, y, z], axis=-1)
    expected = np.zeros(_GRID.shape)
    inside = np.ones(_GRID.shape, bool)
    rows, columns = _SHAPE
    for view in range(_VIEWS):
        basis = np.stack(
            [geometry.u[view], geometry.v[view], geometry.detector[view] - geometry.source[view]]
        )
        across, along, depth = np.moveaxis(
            (points - geometry.source[view]) @ np.linalg.inv(basis), -1, 0
        )
        j = across / depth + (columns - 1) / 2
        i = along / depth + (rows - 1) / 2
        inside &= (i > 0) & (i < rows - 1) & (j > 0) & (j < columns - 1)
        expected += (1 + 0.02 * i - 0.03 * j) / depth**2
    return volume.get()[inside].astype(np.float64), expected[inside]


def adjoint(queue: cl.CommandQueue) -> tuple[Floats, Floats]:
    """Inner products <A x, y> and <x, A' y> of the projector A and its transpose."""
    geometry, random = _geometry(), np.random.default_rng(1)
    shape = (_VIEWS, *_SHAPE)
    x = cl_array.to_device(queue, random.random(_GRID.shape, np.float32))
    y = cl_array.to_device(queue, random.random(shape, np.float32))
    projected = cl_array.empty(queue, shape, np.float32)
    ForwardProjector(queue.context, geometry, _GRID)(queue, projected, x)
    back = cl_array.empty(queue, _GRID.shape, np.float32)
    BackProjector(queue.context, geometry, _GRID, matched=True)(queue, back, y)
    left, right = (
        np.vdot(a.get().astype(np.float64), b.get().astype(np.float64))
        for a, b in ((projected, y), (x, back))
    )
    return np.array([left]), np.array([right])


def registration(queue: cl.CommandQueue) -> tuple[Floats, Floats]:
    """Shift between two images of the same Gaussians, in pixels."""
    shape = (48, 64)
    measured, simulated = (
        cl_array.to_device(queue, _gaussians(shape, shift).astype(np.float32)[np.newaxis])
        for shift in (_SHIFT, (0.0, 0.0))
    )
    estimates = cl_array.empty(queue, (1, len(ESTIMATE_FIELDS)), np.float32)
    register = Registration(queue.context, shape, views=1, magnification=False)
    register(queue, estimates, measured, simulated).wait()
    return estimates.get()[0, :2].astype(np.float64), np.array(_SHIFT)


# Those first that end soonest where PoCL's compiler is given the wrong CPU: it aborts in the
# projectors, while the vectors take it minutes.
CASES: dict[str, tuple[Case, float]] = {
    "back-projection": (back_projection, TOLERANCE),
    "forward projection": (forward_projection, TOLERANCE),
    "adjoint": (adjoint, TOLERANCE),
    "registration": (registration, REGISTRATION_TOLERANCE),
    "local memory": (running_sums, TOLERANCE),
    "vectors": (vectors, TOLERANCE),
}


def failure(queue: cl.CommandQueue) -> str:
    """Return what a device does wrong, in one line; empty if nothing.

    Parameters
    ----------
    queue : cl.CommandQueue
        Of the device.

    Returns
    -------
    str
    """
    for name, (case, tolerance) in CASES.items():
        try:
            found, expected = case(queue)
        except (cl.Error, KernelBuildError) as error:
            return f"{name}: {str(error).partition(chr(10))[0]}"
        error_found = np.abs(found - expected).max() / np.abs(expected).max()
        if not error_found <= tolerance:  # NaN as well
            return f"{name}: wrong numbers, off by {error_found:.1g} of the largest"
    return ""


def rate(queue: cl.CommandQueue) -> float:
    """Speed of back-projection, 1e9 voxels times views a second."""
    geometry = circular(
        32, source_to_axis=100.0, source_to_detector=150.0, pixel_size=0.6, shape=(128, 128)
    )
    grid = VolumeGrid(shape=(96, 96, 96), voxel_size=0.5)
    back = BackProjector(queue.context, geometry, grid, volume_order="yxz")
    radiographs = cl_array.zeros(queue, (32, 128, 128), np.float32)
    volume = cl_array.empty(queue, grid.shape, np.float32)
    back(queue, volume, radiographs).wait()
    started = time.perf_counter()
    back(queue, volume, radiographs).wait()
    return 32 * float(np.prod(grid.shape)) / (time.perf_counter() - started) / 1e9


def main(request: str) -> None:
    """Run the trial that a JSON object asks for, and print the outcome as another."""
    asked: dict[str, Any] = json.loads(request)
    _leave_no_core()
    warnings.simplefilter("ignore")
    device = devices.device_at(asked["index"])
    if self_test.identity(device) != asked["identity"]:
        raise LookupError(f"device {asked['index']} is another one here")
    pocl.prefer_cpu(asked["cpu"])
    pocl.build_options([device])
    context = cl.Context([device])  # kept: Intel's queues do not keep theirs
    queue = cl.CommandQueue(context)
    found = failure(queue)
    speed = rate(queue) if asked["rate"] and not found else None
    print(json.dumps({"failure": found, "rate": speed}), flush=True)


def _program(queue: cl.CommandQueue) -> Any:
    options = [*build.BUILD_OPTIONS, *pocl.build_options([queue.device])]
    program = cl._cl._Program(queue.context, _BASICS)
    program.build(" ".join(options).encode())
    return cl.Program(program)


def _geometry() -> ConeBeamGeometry:
    return circular(
        _VIEWS,
        source_to_axis=100.0,
        source_to_detector=150.0,
        pixel_size=0.6,
        shape=_SHAPE,
        start=0.2,
    )


def _centres(n: int) -> Floats:
    return np.asarray((np.arange(n) - (n - 1) / 2) * _GRID.voxel_size, np.float64)


def _line_integrals(
    geometry: ConeBeamGeometry, radius_squared: float
) -> tuple[Floats, NDArray[np.bool_]]:
    """Joseph's sums in closed form, and which rays stay in the grid from one side to the other."""
    h = _GRID.voxel_size
    rows, columns = _SHAPE
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    expected = np.zeros((_VIEWS, rows, columns))
    known = np.zeros(expected.shape, bool)
    half = np.array([(n - 1) / 2 * h for n in _GRID.shape[::-1]])
    for view in range(_VIEWS):
        pixels = (
            geometry.detector[view]
            + (j - (columns - 1) / 2)[..., np.newaxis] * geometry.u[view]
            + (i - (rows - 1) / 2)[..., np.newaxis] * geometry.v[view]
        )
        ray = pixels - geometry.source[view]
        axis = int(np.abs(ray[rows // 2, columns // 2]).argmax())
        along = ray[..., axis]
        same = np.abs(ray).argmax(axis=-1) == axis
        planes = _centres(_GRID.shape[2 - axis])
        t = (planes[:, np.newaxis, np.newaxis] - geometry.source[view][axis]) / along
        points = geometry.source[view] + t[..., np.newaxis] * ray
        inside = (np.abs(points) <= half + 1e-9).all(axis=(0, -1))
        values = radius_squared - (points**2).sum(axis=-1)
        for other in {0, 1, 2} - {axis}:
            # Linear interpolation lies below x^2 by this much between two voxels.
            place = (points[..., other] + half[other]) / h
            fraction = place - np.floor(place)
            values -= h**2 * fraction * (1 - fraction)
        expected[view] = values.sum(axis=0) * h * np.linalg.norm(ray, axis=-1) / np.abs(along)
        known[view] = inside & same
    return expected, known


def _gaussians(shape: tuple[int, int], shift: tuple[float, float]) -> Floats:
    i, j = np.meshgrid(*map(np.arange, shape), indexing="ij")
    places = np.random.default_rng(2).uniform(0.4, 0.6, (12, 2)) * shape

    def spot(row: float, column: float) -> Floats:
        distance = (i - row - shift[1]) ** 2 + (j - column - shift[0]) ** 2
        return np.asarray(np.exp(-distance / (2 * 2.5**2)))

    spots: Iterator[Floats] = (spot(row, column) for row, column in places)
    return sum(spots, start=np.zeros(shape))


def _leave_no_core() -> None:
    try:
        import resource
    except ImportError:  # not on Windows
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


if __name__ == "__main__":
    main(sys.argv[1])
