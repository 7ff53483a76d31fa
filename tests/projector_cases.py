"""The projectors' geometries and forms, and how tests call them."""

import math
from dataclasses import replace

import numpy as np
import pyopencl.array as cl_array
import pytest
from geometries import upside_down

from clra import ConeBeamGeometry, Motion, VolumeGrid, circular, helix, space_filling
from clra.ops.projection.projector import BackProjector, ForwardProjector
from clra.ops.runtime.profile import CPU, GPU, WIDE_CPU

ROUNDING = 2e-5  # of the largest value: float32 along a line of some tens of samples

# The kernels for v parallel to z, where views allow them, and those for any pose.
FORMS = {
    "columns": WIDE_CPU,
    "tilted": replace(WIDE_CPU, columns=False),
    "gpu": GPU,
    "gpu tilted": replace(GPU, columns=False),
}
# Vectors of eight, which only CPUs without AVX-512 take by themselves.
NARROW = {"narrow columns": CPU, "narrow tilted": replace(CPU, columns=False)}
# A test that asks for `form` runs with the device's profile so forced, see conftest.py.
forms = pytest.mark.parametrize("form", FORMS.values(), ids=FORMS, indirect=True)
all_forms = pytest.mark.parametrize(
    "form", [*FORMS.values(), *NARROW.values()], ids=FORMS | NARROW, indirect=True
)

DETECTOR = {
    "source_to_axis": 60.0,
    "source_to_detector": 100.0,
    "pixel_size": 2.3,
    "shape": (15, 19),
}
GRID = VolumeGrid(shape=(19, 11, 14), voxel_size=1.3, centre=(1.1, -0.7, 0.6))


def perturbed(geometry: ConeBeamGeometry, size: float, seed: int = 3) -> ConeBeamGeometry:
    """Source, detector and its sides moved at random by up to `size` pixels a view."""
    random = np.random.default_rng(seed)

    def moved(vectors: np.ndarray, by: float) -> np.ndarray:
        return vectors + random.uniform(-by, by, vectors.shape) * np.linalg.norm(geometry.u[0])

    return ConeBeamGeometry(
        source=moved(geometry.source, size),
        detector=moved(geometry.detector, size),
        u=moved(geometry.u, 0.1 * size),
        v=moved(geometry.v, 0.1 * size),
        shape=geometry.shape,
    )


def from_above(views: int) -> ConeBeamGeometry:
    """Sources over the sample, whose rays advance fastest along z."""
    angle = np.linspace(0, 2 * math.pi, views, endpoint=False)
    c, s, one = np.cos(angle), np.sin(angle), np.ones(views)
    down = np.stack([0.4 * c, 0.4 * s, -one], axis=1)
    u = np.stack([-s, c, 0 * one], axis=1)
    return ConeBeamGeometry(
        source=-60 * down, detector=40 * down, u=2 * u, v=2 * np.cross(down, u), shape=(16, 17)
    )


def off_centre(geometry: ConeBeamGeometry) -> ConeBeamGeometry:
    motion = Motion(
        shift_u=np.linspace(-7, 6, geometry.views),
        shift_v=np.linspace(4, -9, geometry.views),
        magnification=np.linspace(0.97, 1.04, geometry.views),
    )
    return geometry.with_motion(motion)


GEOMETRIES = {
    "circle": circular(
        8, start=0.1, **DETECTOR
    ),  # an axis tied at 45 degrees has two right answers
    "helix": helix(7, angle_step=0.9, z_step=2.1, **DETECTOR),
    "space-filling": space_filling(7, z_step=0.9, angle_step=2.4, **DETECTOR),
    "v down": upside_down(helix(5, angle_step=1.1, z_step=1.3, **DETECTOR)),
    "off centre": off_centre(circular(6, start=0.3, **DETECTOR)),
    "fine pixels": circular(3, start=0.2, **DETECTOR | {"pixel_size": 0.4, "shape": (47, 41)}),
    "coarse pixels": circular(5, start=0.2, **DETECTOR | {"pixel_size": 9.0, "shape": (5, 4)}),
    "one row": circular(4, start=0.4, **DETECTOR | {"shape": (1, 19)}),
    "one column": circular(4, start=0.4, **DETECTOR | {"shape": (15, 1)}),
    "little tilt": perturbed(circular(6, **DETECTOR), 0.1),
    "tilted": perturbed(helix(6, angle_step=1.1, z_step=1.3, **DETECTOR), 1.0),
    "from above": from_above(4),
    "wide cone": circular(4, start=0.2, **DETECTOR | {"shape": (120, 9)}),
}
geometries = pytest.mark.parametrize("geometry", GEOMETRIES.values(), ids=GEOMETRIES)


def on_device(queue, values: np.ndarray) -> cl_array.Array:
    return cl_array.to_device(queue, np.ascontiguousarray(values, np.float32))


def forward(queue, geometry, grid, volume, **options) -> np.ndarray:
    out = cl_array.empty(queue, (geometry.views, *geometry.shape), np.float32)
    ForwardProjector(queue.context, geometry, grid, **options)(queue, out, on_device(queue, volume))
    return out.get().astype(np.float64)


def back(queue, geometry, grid, projections, **options) -> np.ndarray:
    out = cl_array.empty(queue, grid.shape, np.float32)
    operator = BackProjector(queue.context, geometry, grid, **options)
    operator(queue, out, on_device(queue, projections))
    return out.get().astype(np.float64)


def numbers(*shape: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).random(shape, np.float32)


def assert_close(found: np.ndarray, expected: np.ndarray, tolerance: float = ROUNDING) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())
