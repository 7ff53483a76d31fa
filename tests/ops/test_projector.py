"""Forward projection, its adjoint and back-projection against float64 and closed forms."""

import itertools
import math

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pytest
from geometries import upside_down

from clra import ConeBeamGeometry, Motion, VolumeGrid, circular, helix, space_filling
from clra.model.phantom import Ellipsoids
from clra.ops import layout, projector
from clra.ops.projector import BackProjector, ForwardProjector

ROUNDING = 2e-5  # of the largest value: float32 along a line of some tens of samples
ADJOINT = 1e-5  # of the inner product
SPHERE = 5e-3  # root mean square over the largest line integral
UNITS = 1e-5  # of the largest value

# The form for columns where views allow it; the general one, vectorised; the one for GPUs.
FORMS = {"columns": {}, "tilted": {"_tilted": True}, "gpu": {"_lanes": 1}}
forms = pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
# Vectors of eight, which only CPUs without AVX-512 take by themselves.
NARROW = {"narrow columns": {"_lanes": 8}, "narrow tilted": {"_lanes": 8, "_tilted": True}}
all_forms = pytest.mark.parametrize("form", [*FORMS.values(), *NARROW.values()], ids=FORMS | NARROW)

PANEL = {
    "source_to_axis": 60.0,
    "source_to_detector": 100.0,
    "pixel_size": 2.3,
    "shape": (15, 19),
}
GRID = VolumeGrid(shape=(19, 11, 14), voxel_size=1.3, centre=(1.1, -0.7, 0.6))


def perturbed(geometry: ConeBeamGeometry, size: float, seed: int = 3) -> ConeBeamGeometry:
    """Source, panel and its sides moved at random by up to `size` pixels a view."""
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


def turned(geometry: ConeBeamGeometry, roll: float, pitch: float) -> ConeBeamGeometry:
    """Panels rolled in their plane and tipped towards the source [degrees]."""
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
    "circle": circular(8, start=0.1, **PANEL),  # an axis tied at 45 degrees has two right answers
    "helix": helix(7, angle_step=0.9, z_step=2.1, **PANEL),
    "space-filling": space_filling(7, z_step=0.9, angle_step=2.4, **PANEL),
    "v down": upside_down(helix(5, angle_step=1.1, z_step=1.3, **PANEL)),
    "off centre": off_centre(circular(6, start=0.3, **PANEL)),
    "fine pixels": circular(3, start=0.2, **PANEL | {"pixel_size": 0.4, "shape": (47, 41)}),
    "coarse pixels": circular(5, start=0.2, **PANEL | {"pixel_size": 9.0, "shape": (5, 4)}),
    "one row": circular(4, start=0.4, **PANEL | {"shape": (1, 19)}),
    "one column": circular(4, start=0.4, **PANEL | {"shape": (15, 1)}),
    "little tilt": perturbed(circular(6, **PANEL), 0.1),
    "tilted": perturbed(helix(6, angle_step=1.1, z_step=1.3, **PANEL), 1.0),
    "from above": from_above(4),
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


def joseph(geometry: ConeBeamGeometry, grid: VolumeGrid) -> np.ndarray:
    """Matrix of the forward projection, (pixels, voxels), in float64."""
    column = np.arange(geometry.columns) - (geometry.columns - 1) / 2
    row = np.arange(geometry.rows) - (geometry.rows - 1) / 2
    source, detector, u, v = (a[:, None, None] for a in np.split(geometry.to_astra(), 4, axis=1))
    panel = detector + row[:, None, None] * v + column[:, None] * u
    first = np.array([axis[0] for axis in grid.coordinates()])
    start = np.broadcast_to((source - first) / grid.voxel_size, panel.shape).reshape(-1, 3)
    direction = (panel - source).reshape(-1, 3)
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


def numbers(*shape: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).random(shape, np.float32)


def assert_close(found: np.ndarray, expected: np.ndarray, tolerance: float = ROUNDING) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


@all_forms
@geometries
def test_forward_and_adjoint_are_josephs_matrix_and_its_transpose(queue, geometry, form):
    matrix = joseph(geometry, GRID)
    volume, projections = numbers(*GRID.shape), numbers(geometry.views, *geometry.shape)
    found = forward(queue, geometry, GRID, volume, **form)
    assert_close(found, (matrix @ volume.ravel()).reshape(found.shape))
    found = back(queue, geometry, GRID, projections, matched=True, **form)
    assert_close(found, (matrix.T @ projections.ravel()).reshape(found.shape))


@all_forms
@geometries
def test_back_projection_is_bilinear_interpolation(queue, geometry, form):
    projections = numbers(geometry.views, *geometry.shape)
    found = back(queue, geometry, GRID, projections, **form)
    assert_close(found, bilinear(geometry, GRID, projections))


@forms
@pytest.mark.parametrize("shape", [(1, 11, 14), (3, 1, 8), (5, 9, 1), (16, 3, 2), (41, 3, 4)])
def test_volumes_of_any_shape(queue, shape, form):
    grid = VolumeGrid(shape=shape, voxel_size=1.7, centre=(0.3, 0.2, -0.4))
    geometry = GEOMETRIES["off centre"]
    matrix = joseph(geometry, grid)
    volume, projections = numbers(*shape), numbers(geometry.views, *geometry.shape)
    found = forward(queue, geometry, grid, volume, **form)
    assert_close(found, (matrix @ volume.ravel()).reshape(found.shape))
    found = back(queue, geometry, grid, projections, matched=True, **form)
    assert_close(found, (matrix.T @ projections.ravel()).reshape(shape))
    found = back(queue, geometry, grid, projections, **form)
    assert_close(found, bilinear(geometry, grid, projections))


@pytest.mark.parametrize("form", [FORMS["tilted"], NARROW["narrow tilted"]], ids=["", "narrow"])
@pytest.mark.parametrize("pixel", [0.4, 0.9, 1.6])
@pytest.mark.parametrize("roll, pitch", [(0, 15), (2, 0), (12, -5), (40, 0), (181, 1)])
def test_panels_turned_any_way(queue, roll, pitch, pixel, form):
    # lines long enough for whole vectors, which pass from none to many columns of the panel
    panel = PANEL | {"pixel_size": pixel, "shape": (round(70 / pixel), 9)}
    geometry = turned(circular(2, start=0.3, **panel), roll, pitch)
    grid = VolumeGrid(shape=(75, 5, 6), voxel_size=0.6, centre=(0.7, -0.4, 1.1))
    matrix = joseph(geometry, grid)
    volume, projections = numbers(*grid.shape), numbers(geometry.views, *geometry.shape)
    found = forward(queue, geometry, grid, volume, **form)
    assert_close(found, (matrix @ volume.ravel()).reshape(found.shape))
    found = back(queue, geometry, grid, projections, matched=True, **form)
    assert_close(found, (matrix.T @ projections.ravel()).reshape(grid.shape))
    found = back(queue, geometry, grid, projections, **form)
    assert_close(found, bilinear(geometry, grid, projections))


@forms
def test_lines_of_several_blocks(queue, monkeypatch, form):
    monkeypatch.setattr(projector, "_LINE", 64)
    monkeypatch.setattr(projector, "_ADJOINT_LINE", 64)
    panel = PANEL | {"pixel_size": 1.9, "shape": (75, 7)}
    geometry = perturbed(circular(3, start=0.5, **panel), 1.0 if "_tilted" in form else 0.0)
    grid = VolumeGrid(shape=(131, 4, 3), voxel_size=0.7)
    matrix = joseph(geometry, grid)
    volume, projections = numbers(*grid.shape), numbers(3, *geometry.shape)
    found = forward(queue, geometry, grid, volume, **form)
    assert_close(found, (matrix @ volume.ravel()).reshape(found.shape))
    found = back(queue, geometry, grid, projections, matched=True, **form)
    assert_close(found, (matrix.T @ projections.ravel()).reshape(grid.shape))
    found = back(queue, geometry, grid, projections, **form)
    assert_close(found, bilinear(geometry, grid, projections))


@forms
@pytest.mark.parametrize("name", ["circle", "helix", "space-filling", "little tilt", "tilted"])
def test_adjoint_by_inner_products(queue, name, form):
    geometry, grid = GEOMETRIES[name], VolumeGrid(shape=(37, 29, 31), voxel_size=1.01)
    volume, projections = numbers(*grid.shape), numbers(geometry.views, *geometry.shape)
    left = np.vdot(forward(queue, geometry, grid, volume, **form), projections)
    right = np.vdot(volume, back(queue, geometry, grid, projections, matched=True, **form))
    assert abs(left - right) < ADJOINT * left


@forms
def test_rays_at_45_degrees_go_the_same_way_in_both_directions(queue, form):
    geometry = circular(8, **PANEL)  # the middle column's rays advance alike along x and y
    volume, projections = numbers(*GRID.shape), numbers(8, *geometry.shape)
    left = np.vdot(forward(queue, geometry, GRID, volume, **form), projections)
    right = np.vdot(volume, back(queue, geometry, GRID, projections, matched=True, **form))
    assert abs(left - right) < ADJOINT * left


SPHERES = Ellipsoids([[0, 0, 0], [9, -5, 4]], np.array([[20, 20, 20], [6, 6, 6]]), [0.02, 0.03])


@forms
@pytest.mark.parametrize("tilt", [0.0, 1.0], ids=["axial", "tilted"])
def test_spheres_have_their_line_integrals(queue, form, tilt):
    panel = PANEL | {"pixel_size": 1.3, "shape": (60, 60)}
    geometry = perturbed(helix(5, angle_step=1.3, z_step=3.0, **panel), tilt)
    grid = VolumeGrid(shape=(69, 68, 67), voxel_size=0.65)
    found = forward(queue, geometry, grid, SPHERES.volume(grid, oversample=3), **form)
    expected = SPHERES.line_integrals(geometry, oversample=3)
    assert np.sqrt(np.mean((found - expected) ** 2)) < SPHERE * expected.max()


@pytest.mark.parametrize("form", [FORMS["tilted"], FORMS["gpu"]], ids=["tilted", "gpu"])
def test_all_forms_agree_on_axial_geometries(queue, form):
    geometry, grid = GEOMETRIES["helix"], VolumeGrid(shape=(40, 33, 31), voxel_size=0.9)
    volume, projections = numbers(*grid.shape), numbers(geometry.views, *geometry.shape)
    for run, values, options in (
        (forward, volume, {}),
        (back, projections, {}),
        (back, projections, {"matched": True}),
    ):
        expected = run(queue, geometry, grid, values, **options)
        assert_close(run(queue, geometry, grid, values, **options, **form), expected)


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
    geometry = circular(3, start=0.2, **PANEL)
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
        assert operator(queue.context, geometry, GRID, _lanes=8)._layout.columnar


def test_set_geometry_is_a_new_operator(queue):
    before, after = GEOMETRIES["circle"], off_centre(GEOMETRIES["circle"])
    tilted = perturbed(before, 0.5)
    volume, projections = numbers(*GRID.shape), numbers(before.views, *before.shape)
    out = cl_array.empty(queue, projections.shape, np.float32)
    operator = ForwardProjector(queue.context, before, GRID)
    backward = BackProjector(queue.context, before, GRID)
    image = cl_array.empty(queue, GRID.shape, np.float32)
    for geometry in after, tilted, before:
        operator.set_geometry(geometry)
        operator(queue, out, on_device(queue, volume))
        assert np.array_equal(out.get(), forward(queue, geometry, GRID, volume))
        backward.set_geometry(geometry)
        backward(queue, image, on_device(queue, projections))
        assert np.array_equal(image.get(), back(queue, geometry, GRID, projections))


@forms
def test_a_view_that_misses_the_volume_gives_nothing(queue, form):
    geometry = circular(1, **PANEL)
    grid = VolumeGrid(shape=(9, 8, 7), voxel_size=1.0, centre=(0.0, 0.0, 60.0))
    assert not forward(queue, geometry, grid, numbers(*grid.shape), **form).any()
    projections = numbers(1, *geometry.shape)
    assert not back(queue, geometry, grid, projections, **form).any()
    assert not back(queue, geometry, grid, projections, matched=True, **form).any()


@pytest.mark.parametrize("small", [False, True], ids=["at once", "in parts"])
@forms
def test_views_may_come_in_chunks(queue, monkeypatch, form, small):
    if small:  # scratch for two views, parts of two planes
        monkeypatch.setattr(layout, "_CPU_BYTES", 0)
        monkeypatch.setattr(layout, "_GPU_BYTES", 0)
        monkeypatch.setattr(layout, "_LEAST_VIEWS", 2)
        monkeypatch.setattr(projector, "_PART_BYTES", 0)
        monkeypatch.setattr(projector, "_LEAST_PLANES", 2)
    geometry = GEOMETRIES["space-filling"]
    volume, projections = numbers(*GRID.shape), numbers(geometry.views, *geometry.shape)
    chunks = [slice(0, 3), slice(3, None)]
    operator = ForwardProjector(queue.context, geometry, GRID, **form)
    for chunk in chunks:
        out = cl_array.empty(queue, projections[chunk].shape, np.float32)
        operator(queue, out, on_device(queue, volume), views=chunk)
        assert_close(out.get(), forward(queue, geometry, GRID, volume, **form)[chunk])
    for matched in False, True:
        options = {"matched": matched, **form}
        operator = BackProjector(queue.context, geometry, GRID, **options)
        out = on_device(queue, np.full(GRID.shape, np.nan))
        for chunk in chunks:
            part = on_device(queue, projections[chunk])
            operator(queue, out, part, views=chunk, accumulate=chunk is not chunks[0])
        assert_close(out.get(), back(queue, geometry, GRID, projections, **options))


@forms
def test_accumulating_adds(queue, form):
    geometry = GEOMETRIES["circle"]
    volume, projections = numbers(*GRID.shape), numbers(geometry.views, *geometry.shape)
    out = on_device(queue, projections)
    operator = ForwardProjector(queue.context, geometry, GRID, **form)
    operator(queue, out, on_device(queue, volume), accumulate=True)
    assert_close(out.get(), projections + forward(queue, geometry, GRID, volume, **form))
    for order, axes in ("zyx", (0, 1, 2)), ("yxz", (1, 2, 0)):
        for matched in False, True:
            operator = BackProjector(
                queue.context, geometry, GRID, matched=matched, volume_order=order, **form
            )
            out = on_device(queue, volume.transpose(axes))
            operator(queue, out, on_device(queue, projections), accumulate=True)
            added = back(queue, geometry, GRID, projections, matched=matched, **form)
            assert_close(out.get(), (volume + added).transpose(axes))


def test_slabs_of_a_volume_add_up(queue):
    geometry, volume = GEOMETRIES["helix"], numbers(*GRID.shape)
    expected = forward(queue, geometry, GRID, volume)
    parts = [
        forward(queue, geometry, GRID.slab(start, stop), volume[start:stop])
        for start, stop in [(0, 5), (5, 17), (17, 19)]
    ]
    assert_close(sum(parts), expected)


@forms
def test_the_devices_own_order(queue, form):
    geometry = GEOMETRIES["off centre"]
    volume, projections = numbers(*GRID.shape), numbers(geometry.views, *geometry.shape)
    columns = on_device(queue, volume.transpose(1, 2, 0))
    out = cl_array.empty(queue, projections.shape, np.float32)
    ForwardProjector(queue.context, geometry, GRID, volume_order="yxz", **form)(queue, out, columns)
    assert np.array_equal(out.get(), forward(queue, geometry, GRID, volume, **form))
    for matched in False, True:
        BackProjector(queue.context, geometry, GRID, matched=matched, volume_order="yxz", **form)(
            queue, columns, on_device(queue, projections)
        )
        expected = back(queue, geometry, GRID, projections, matched=matched, **form)
        assert np.array_equal(columns.get(), expected.transpose(1, 2, 0))


def test_arrays_may_begin_within_their_buffers(queue):
    geometry = GEOMETRIES["off centre"]
    volume, projections = numbers(3, *GRID.shape), numbers(9, *geometry.shape)
    volumes, radiographs = on_device(queue, volume), on_device(queue, projections)
    ForwardProjector(queue.context, geometry, GRID)(queue, radiographs[2:8], volumes[1])
    expected = projections.copy()
    expected[2:8] = forward(queue, geometry, GRID, volume[1])
    assert np.array_equal(radiographs.get(), expected)
    BackProjector(queue.context, geometry, GRID)(queue, volumes[1], radiographs[2:8])
    volume[1] = back(queue, geometry, GRID, expected[2:8])
    assert np.array_equal(volumes.get(), volume)


def test_a_queue_may_be_out_of_order(context, queue, unordered):
    geometry = GEOMETRIES["helix"]
    volume, projections = numbers(*GRID.shape), numbers(geometry.views, *geometry.shape)
    device = on_device(queue, volume)
    out = cl_array.empty(queue, projections.shape, np.float32)
    one = ForwardProjector(context, geometry, GRID)
    other = BackProjector(context, geometry, GRID, matched=True)
    expected = volume
    event = None
    for _ in range(4):
        event = one(unordered, out, device, wait_for=event and [event])
        event = other(unordered, device, out, wait_for=[event])
        projected = forward(queue, geometry, GRID, expected)
        expected = back(queue, geometry, GRID, projected, matched=True)
    event.wait()
    assert np.array_equal(device.get(queue=queue), expected.astype(np.float32))


def test_the_same_input_gives_the_same_bits(queue):
    geometry = GEOMETRIES["little tilt"]
    projections = numbers(geometry.views, *geometry.shape)
    first, second = (back(queue, geometry, GRID, projections, matched=True) for _ in range(2))
    assert np.array_equal(first, second)


def test_what_is_not_an_array_of_the_device_is_refused(queue):
    geometry = GEOMETRIES["circle"]
    operator = ForwardProjector(queue.context, geometry, GRID)
    out = cl_array.empty(queue, (geometry.views, *geometry.shape), np.float32)
    volume = numbers(*GRID.shape)
    with pytest.raises(TypeError, match=r"volume: found ndarray, expected a pyopencl.array.Array"):
        operator(queue, out, volume)
    with pytest.raises(ValueError, match=r"projections: found float64, expected float32"):
        BackProjector(queue.context, geometry, GRID)(
            queue, on_device(queue, volume), out.astype(np.float64)
        )
    with pytest.raises(ValueError, match=r"volume: found shape \(11, 19, 14\), expected \(19, 1"):
        operator(queue, out, on_device(queue, volume.transpose(1, 0, 2)))
    with pytest.raises(ValueError, match=r"projections_out: found shape .* expected \(3, 15, 19\)"):
        operator(queue, out, on_device(queue, volume), views=slice(1, 4))


def test_another_context_is_refused(queue):
    geometry = GEOMETRIES["circle"]
    other = cl.Context([queue.device])  # Intel's queues do not keep their context
    foreign = cl.CommandQueue(other)
    operator = ForwardProjector(queue.context, geometry, GRID)
    out = cl_array.empty(queue, (geometry.views, *geometry.shape), np.float32)
    volume = on_device(queue, numbers(*GRID.shape))
    with pytest.raises(ValueError, match=r"queue: its context .* is not the operator's"):
        operator(foreign, out, volume)
    with pytest.raises(ValueError, match=r"volume: its context .* is not the operator's"):
        operator(queue, out, on_device(foreign, numbers(*GRID.shape)))


def test_geometries_that_do_not_fit_are_refused(queue):
    geometry = GEOMETRIES["circle"]
    with pytest.raises(ValueError, match="volume_order: found 'xyz', expected 'zyx' or 'yxz'"):
        BackProjector(queue.context, geometry, GRID, volume_order="xyz")
    with pytest.raises(ValueError, match="grid: it reaches behind the source of view 1"):
        ForwardProjector(queue.context, geometry, VolumeGrid(shape=(3, 99, 99), voxel_size=1.5))
    operator = ForwardProjector(queue.context, geometry, GRID)
    with pytest.raises(ValueError, match=r"geometry: found \(3, 15, 19\), expected \(8, 15, 19\)"):
        operator.set_geometry(geometry.subset(slice(3)))
    out = cl_array.empty(queue, (4, *geometry.shape), np.float32)
    with pytest.raises(ValueError, match=r"views: found slice.*, expected successive ones of 8"):
        operator(queue, out, on_device(queue, numbers(*GRID.shape)), views=slice(0, 8, 2))
