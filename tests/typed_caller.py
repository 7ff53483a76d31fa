"""A program that uses clra, for a strict type checker: nothing may be untyped or of another type.

``mypy --strict tests/typed_caller.py``; it is not run.
"""

from typing import Any, assert_type

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array

import clra
from clra.methods.alignment.result import AlignmentResult
from clra.ops.images.warp import Warp
from clra.ops.registration.gauss_newton import ESTIMATE_FIELDS
from clra.ops.runtime.devices import DeviceInfo

geometry = clra.circular(
    360, source_to_axis=20.0, source_to_detector=50.0, pixel_size=0.1, shape=(64, 64)
)
grid = clra.VolumeGrid(shape=(64, 64, 64), voxel_size=0.05)
assert_type(geometry, clra.ConeBeamGeometry)
assert_type(geometry.with_motion(clra.Motion.identity(360)), clra.ConeBeamGeometry)
assert_type(clra.devices(), list[DeviceInfo])
assert_type(clra.kernels.source("warp.cl"), str)


def reconstruct(path: str) -> np.ndarray[Any, np.dtype[np.float32]]:
    scan = clra.read_scan(path)
    assert_type(scan, clra.Scan)
    result = clra.align(scan, schedule="1QR-1HR")
    assert_type(result, AlignmentResult)
    assert_type(result.motion, clra.Motion)
    assert_type(result.warnings, tuple[clra.Finding, ...])
    assert_type(clra.correct(scan, result), clra.Scan)
    clra.write_alignment("motion.h5", result)
    result = clra.read_alignment("motion.h5")
    options = clra.Multigrid(levels="HR-FR", i0=4000)
    clra.reconstruct(scan, "imgr", alignment=result, options=options, checkpoint="kept")
    clra.reconstruct(scan, "osem-tr", options=clra.OrderedSubsets(passes=2), resume=True)
    return clra.reconstruct(scan, motion=result.motion)


def embed(queue: cl.CommandQueue, radiographs: cl_array.Array, volume: cl_array.Array) -> cl.Event:
    forward = clra.ForwardProjector(queue.context, geometry, grid)
    back = clra.BackProjector(queue.context, geometry, grid, matched=True)
    step = clra.AlignmentStep(queue.context, geometry, grid)
    assert_type(forward.scratch_bytes, int)
    assert_type(back(queue, volume, radiographs, accumulate=True), cl.Event)
    assert_type(step(queue, radiographs, volume, radiographs, wait_for=[]), cl.Event)
    assert_type(ESTIMATE_FIELDS, tuple[str, str, str, str, str, str, str, str, str, str])
    assert_type(Warp(queue.context, (64, 64)).shape, tuple[int, int])
    return forward(queue, radiographs, volume, views=slice(0, 10))
