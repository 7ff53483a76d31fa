"""Forward projection, its adjoint and back-projection against float64 and closed forms."""

import itertools
import math

import numpy as np
import pyopencl.array as cl_array
import pytest
from arrays import with_offset
from geometries import upside_down
from projector_cases import (
    DETECTOR,
    FORMS,
    GEOMETRIES,
    GRID,
    NARROW,
    all_forms,
    assert_close,
    back,
    forms,
    forward,
    geometries,
    numbers,
    perturbed,
)

from clra import ConeBeamGeometry, Motion, VolumeGrid, circular, helix
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.ops.projection import cpu_forms
from clra.ops.projection.projector import BackProjector, ForwardProjector
from clra.ops.runtime.profile import CPU, forced

ADJOINT = 1e-5  # of the inner product
SPHERE = 5e-3  # root mean square over the largest line integral
UNITS = 1e-5  # of the largest value


def turned(geometry: ConeBeamGeometry, roll: float, pitch: float) -> ConeBeamGeometry:
    """Detectors rolled in their plane and tipped towards the source [degrees]."""
    a, b = np.radians([roll, pitch])
    u = math.cos(a) * geometry.u + math.sin(a) * geometry.v
    v = math.cos(a) * geometry.v - math.sin(a) * geometry.u
    normal = np.cross(u, v) / np.linalg.norm(u, axis=1, keepdims=True)
    return ConeBeamGeometry(
        source=geometry.source,
        detector=geometry.detector,
        u=u,
        v=math.cos(b) * v + math.sin(b) * normal,
        shape=geometry.shape,
    )


def joseph(geometry: ConeBeamGeometry, grid: VolumeGrid, *, over_depth: bool = False) -> np.ndarray:
    """Matrix of the forward projection, (pixels, voxels), in float64."""
    column = np.arange(geometry.columns) - (geometry.columns - 1) / 2
    row = np.arange(geometry.rows) - (geometry.rows - 1) / 2
    source, detector, u, v = (a[:, None, None] for a in np.split(geometry.to_astra(), 4, axis=1))
    detector = detector + row[:, None, None] * v + column[:, None] * u
    first = np.array([axis[0] for axis in grid.coordinates()])
    start = np.broadcast_to((source - first) / grid.voxel_size, detector.shape).reshape(-1, 3)
    direction = (detector - source).reshape(-1, 3)
    sizes = np.array(grid.shape[::-1])
    matrix = np.zeros((len(start), *grid.shape))
    for p, q, w in (0, 1, 2), (1, 0, 2), (2, 0, 1):
        rays = np.flatnonzero(np.argmax(np.abs(direction), axis=1) == p)
        step = direction[rays] / direction[rays, p : p + 1]
        for plane, a, b in itertools.product(range(sizes[p]), (0, 1), (0, 1)):
            at = start[rays] + (plane - start[rays, p : p + 1]) * step
            voxel = np.floor(at).astype(int)
            voxel[:, p] = plane
            voxel[:, q] += a
            voxel[:, w] += b
            weight = (1 - np.abs(at - voxel))[:, [q, w]].prod(axis=1)
            if over_depth:
                weight *= direction[rays, p] / ((plane - start[rays, p]) * grid.voxel_size)
            on = ((voxel >= 0) & (voxel < sizes)).all(axis=1)
            matrix[rays[on], *voxel[on, ::-1].T] += weight[on]
        matrix[rays] *= np.linalg.norm(step, axis=1)[:, None, None, None] * grid.voxel_size
    return matrix.reshape(len(start), -1)


def bilinear(geometry: ConeBeamGeometry, grid: VolumeGrid, projections: np.ndarray) -> np.ndarray:
    """Back-projection, view by view in float64."""
    x, y, z = grid.coordinates()
    points = np.stack([*np.meshgrid(z, y, x, indexing="ij")[::-1], np.ones(grid.shape)])
    volume = np.zeros(grid.shape)
    for matrix, image in zip(geometry.projection_matrices(), projections, strict=True):
        a, b, g = np.tensordot(matrix, points, 1)
        column, row = a / g, b / g
        on = (column >= 0) & (column <= geometry.columns - 1)
        on &= (row >= 0) & (row <= geometry.rows - 1)
        padded = np.pad(image.astype(np.float64), ((0, 1), (0, 1)))
        c, r = (np.where(on, q, 0).astype(int) for q in (column, row))
        fc, fr = column - c, row - r
        upper = (1 - fc) * padded[r, c] + fc * padded[r, c + 1]
        lower = (1 - fc) * padded[r + 1, c] + fc * padded[r + 1, c + 1]
        volume += np.where(on, ((1 - fr) * upper + fr * lower) / g**2, 0)
    return volume


def assert_all_exact(queue, geometry: ConeBeamGeometry, grid: VolumeGrid) -> None:
    """Forward projection, adjoint and back-projection agree with the references above."""
    matrix = joseph(geometry, grid)
    volume, projections = numbers(*grid.shape), numbers(geometry.views, *geometry.shape)
    found = forward(queue, geometry, grid, volume)
    assert_close(found, (matrix @ volume.ravel()).reshape(found.shape))
    found = back(queue, geometry, grid, projections, matched=True)
    assert_close(found, (matrix.T @ projections.ravel()).reshape(grid.shape))
    found = back(queue, geometry, grid, projections)
    assert_close(found, bilinear(geometry, grid, projections))


@all_forms
@geometries
def test_josephs_matrix_its_transpose_and_bilinear_interpolation(queue, geometry, form):
    assert_all_exact(queue, geometry, GRID)


@forms
@pytest.mark.parametrize("shape", [(1, 11, 14), (3, 1, 8), (5, 9, 1), (16, 3, 2), (41, 3, 4)])
def test_volumes_of_any_shape(queue, shape, form):
    grid = VolumeGrid(shape=shape, voxel_size=1.7, centre=(0.3, 0.2, -0.4))
    geometry = GEOMETRIES["off centre"]
    assert_all_exact(queue, geometry, grid)


@pytest.mark.parametrize(
    "form",
    [FORMS["tilted"], NARROW["narrow tilted"], FORMS["gpu tilted"]],
    ids=["", "narrow", "gpu"],
    indirect=True,
)
@pytest.mark.parametrize("pixel", [0.4, 0.9, 1.6])
@pytest.mark.parametrize("roll, pitch", [(0, 15), (2, 0), (12, -5), (40, 0), (181, 1)])
def test_detectors_turned_any_way(queue, roll, pitch, pixel, form):
    # lines long enough for whole vectors, which pass from none to many columns of the detector
    detector = DETECTOR | {"pixel_size": pixel, "shape": (round(70 / pixel), 9)}
    geometry = turned(circular(2, start=0.3, **detector), roll, pitch)
    grid = VolumeGrid(shape=(75, 5, 6), voxel_size=0.6, centre=(0.7, -0.4, 1.1))
    assert_all_exact(queue, geometry, grid)


@forms
def test_lines_of_several_blocks(queue, monkeypatch, form):
    monkeypatch.setattr(cpu_forms, "_LINE", 64)
    monkeypatch.setattr(cpu_forms, "_ADJOINT_LINE", 64)
    detector = DETECTOR | {"pixel_size": 1.9, "shape": (75, 7)}
    geometry = perturbed(circular(3, start=0.5, **detector), 0.0 if form.columns else 1.0)
    grid = VolumeGrid(shape=(131, 4, 3), voxel_size=0.7)
    assert_all_exact(queue, geometry, grid)


@forms
@pytest.mark.parametrize("name", ["circle", "helix", "space-filling", "little tilt", "tilted"])
def test_adjoint_by_inner_products(queue, name, form):
    geometry, grid = GEOMETRIES[name], VolumeGrid(shape=(37, 29, 31), voxel_size=1.01)
    volume, projections = numbers(*grid.shape), numbers(geometry.views, *geometry.shape)
    left = np.vdot(forward(queue, geometry, grid, volume), projections)
    right = np.vdot(volume, back(queue, geometry, grid, projections, matched=True))
    assert abs(left - right) < ADJOINT * left


@all_forms
@pytest.mark.parametrize("roll", [-7.0, 0.0, 7.0])
def test_rays_along_the_very_edge_read_nothing_beyond_the_volume(queue, roll, form):
    """A ray on the line beside the last one counts for nothing; rounding may take it farther."""
    geometry = turned(
        circular(1, start=1.8, **DETECTOR | {"shape": (37, 9), "pixel_size": 1.1}), roll, 0
    )
    shape, size = (40, 60, 60), 0.6
    values = with_offset(queue, numbers(60, 60, 40), skip=4096)
    sums = cl_array.empty(queue, (1, *geometry.shape), np.float32)
    rows = np.arange(geometry.rows)
    pixels = geometry.detector + np.outer(rows - 18, geometry.v)  # of the middle column
    ways = pixels - geometry.source
    at = (21 - 29.5) * size - geometry.source[0, 0]  # a plane of voxels; rays run along x
    beside = geometry.source[0, 1] + ways[:, 1] / ways[:, 0] * at
    for row, offset in itertools.product(rows, (-3e-6, -1e-6, 0.0, 1e-6)):
        aside = beside[row] - (30.5 + offset) * size  # the last line is 29.5 from the middle
        grid = VolumeGrid(shape=shape, voxel_size=size, centre=(0, aside, 0))
        project = ForwardProjector(queue.context, geometry, grid, volume_order="yxz")
        project(queue, sums, values)
        assert np.isfinite(sums.get()).all(), (row, offset)


@forms
def test_rays_at_45_degrees_go_the_same_way_in_both_directions(queue, form):
    geometry = circular(8, **DETECTOR)  # the middle column's rays advance alike along x and y
    volume, projections = numbers(*GRID.shape), numbers(8, *geometry.shape)
    left = np.vdot(forward(queue, geometry, GRID, volume), projections)
    right = np.vdot(volume, back(queue, geometry, GRID, projections, matched=True))
    assert abs(left - right) < ADJOINT * left


SPHERES = Ellipsoids([[0, 0, 0], [9, -5, 4]], np.array([[20, 20, 20], [6, 6, 6]]), [0.02, 0.03])


@forms
@pytest.mark.parametrize("tilt", [0.0, 1.0], ids=["axial", "tilted"])
def test_spheres_have_their_line_integrals(queue, form, tilt):
    detector = DETECTOR | {"pixel_size": 1.3, "shape": (60, 60)}
    geometry = perturbed(helix(5, angle_step=1.3, z_step=3.0, **detector), tilt)
    grid = VolumeGrid(shape=(69, 68, 67), voxel_size=0.65)
    found = forward(queue, geometry, grid, SPHERES.volume(grid, oversample=3))
    expected = SPHERES.line_integrals(geometry, oversample=3)
    assert np.sqrt(np.mean((found - expected) ** 2)) < SPHERE * expected.max()


@forms
def test_all_forms_agree_on_axial_geometries(queue, form):
    geometry, grid = GEOMETRIES["helix"], VolumeGrid(shape=(40, 33, 31), voxel_size=0.9)
    volume, projections = numbers(*grid.shape), numbers(geometry.views, *geometry.shape)
    for run, values, options in (
        (forward, volume, {}),
        (back, projections, {}),
        (back, projections, {"matched": True}),
    ):
        with forced(CPU):
            expected = run(queue, geometry, grid, values, **options)
        assert_close(run(queue, geometry, grid, values, **options), expected)


def test_a_hardly_tilted_geometry_gives_what_an_axial_one_gives(queue):
    geometry = GEOMETRIES["helix"]
    tilted = perturbed(geometry, 1e-7)
    assert geometry.axial
    assert not tilted.axial
    volume, projections = numbers(*GRID.shape), numbers(geometry.views, *geometry.shape)
    assert_close(forward(queue, tilted, GRID, volume), forward(queue, geometry, GRID, volume))
    expected = back(queue, geometry, GRID, projections, matched=True)
    assert_close(back(queue, tilted, GRID, projections, matched=True), expected)


@pytest.mark.parametrize("unit", [1e3, 1e-3], ids=["um", "m"])
def test_units_do_not_matter(queue, unit):
    geometry = GEOMETRIES["off centre"]
    scaled = ConeBeamGeometry.from_astra(geometry.to_astra() * unit, geometry.shape)
    centre = tuple(unit * c for c in GRID.centre)
    grid = VolumeGrid(shape=GRID.shape, voxel_size=GRID.voxel_size * unit, centre=centre)
    volume, projections = numbers(*GRID.shape), numbers(geometry.views, *geometry.shape)
    found = forward(queue, scaled, grid, volume / unit)
    assert_close(found, forward(queue, geometry, GRID, volume), UNITS)
    found = back(queue, scaled, grid, projections)
    assert_close(found, back(queue, geometry, GRID, projections), UNITS)
    found = back(queue, scaled, grid, projections, matched=True) / unit
    assert_close(found, back(queue, geometry, GRID, projections, matched=True), UNITS)


def test_rows_upward_are_rows_downward_reversed(queue):
    geometry = GEOMETRIES["helix"]
    volume, projections = numbers(*GRID.shape), numbers(geometry.views, *geometry.shape)
    down = upside_down(geometry)
    found = forward(queue, down, GRID, volume)[:, ::-1]
    assert_close(found, forward(queue, geometry, GRID, volume))
    found = back(queue, down, GRID, projections[:, ::-1])
    assert_close(found, back(queue, geometry, GRID, projections))


def test_motion_in_the_geometry_moves_the_projections(queue):
    geometry = circular(3, start=0.2, **DETECTOR)
    shifts = Motion(shift_u=[2, -1, 0], shift_v=[1, 0, -3])
    volume = numbers(*GRID.shape)
    still = forward(queue, geometry, GRID, volume)
    moved = forward(queue, geometry.with_motion(shifts), GRID, volume)
    for view, (u, v) in enumerate([(2, 1), (-1, 0), (0, -3)]):
        expected = np.roll(still[view], (v, u), (0, 1))[3:-3, 2:-2]
        assert_close(moved[view][3:-3, 2:-2], expected)


@pytest.mark.parametrize("name", ["circle", "helix", "space-filling", "v down"])
def test_motion_in_the_geometry_costs_nothing(queue, name):
    motion = Motion(shift_u=[1.5, -2], shift_v=[-3, 0.5], magnification=[1.002, 0.998])
    geometry = GEOMETRIES[name].subset(slice(2)).with_motion(motion).binned(2)
    for operator in ForwardProjector, BackProjector:
        assert operator(queue.context, geometry, GRID)._layout.columnar
