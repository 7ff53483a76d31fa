import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pytest

from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion
from clra.model.sampling.ray_weights import ray_weights, widened
from clra.model.trajectory import circular
from clra.ops.filtering import ramp as ramp_module
from clra.ops.filtering.ramp import RampFilter, taper
from clra.ops.runtime.profile import CPU, GPU

RELATIVE = 2e-6  # of the largest magnitude: float32 transforms
ALIASING = 5e-4  # of kernels that go on beyond the padded line
INTENSITY = 0.01  # of a reconstructed sphere


def scanner(views: int = 3, shape: tuple[int, int] = (5, 13)) -> ConeBeamGeometry:
    """Circle with a wide cone, every view with a detector of its own, off its principal point."""
    rng = np.random.default_rng(5)
    ideal = circular(
        views, source_to_axis=20.0, source_to_detector=60.0, pixel_size=1.5, shape=shape
    )
    motion = Motion(
        shift_u=rng.uniform(-4, 4, views),
        shift_v=rng.uniform(-4, 4, views),
        magnification=rng.uniform(0.9, 1.1, views),
    )
    moved = ideal.with_motion(motion)
    skewed = moved.v + rng.uniform(-0.1, 0.1, (views, 1)) * moved.u
    return ConeBeamGeometry(
        source=moved.source, detector=moved.detector, u=moved.u, v=1.2 * skewed, shape=shape
    )


def image_of(geometry: ConeBeamGeometry, seed: int = 0) -> np.ndarray:
    shape = (geometry.views, *geometry.shape)
    return np.random.default_rng(seed).uniform(0, 2, shape).astype(np.float32)


def ramp(length: int, window: str = "ram-lak") -> np.ndarray:
    """Band-limited ramp h[n], n = -length..length, by quadrature of its defining integral."""
    f = (np.arange(20000) + 0.5) / 40000  # 0 to 1/2 cycles a column
    weight = {
        "ram-lak": np.ones_like(f),
        "shepp-logan": np.sinc(f),
        "hann": np.cos(np.pi * f) ** 2,
    }[window]
    n = np.arange(-length, length + 1)
    return 2 * np.mean(f * weight * np.cos(2 * np.pi * np.outer(n, f)), axis=1) * 0.5


def filtered(
    geometry: ConeBeamGeometry,
    image: np.ndarray,
    row_weight: np.ndarray,
    window: str = "ram-lak",
    margin: int = 0,
) -> np.ndarray:
    """Float64 reference from pixel positions and a direct convolution."""
    rows, columns = geometry.shape
    j, i = np.mgrid[:rows, :columns]
    pixel = (
        geometry.detector[:, None, None]
        + (i - (columns - 1) / 2)[..., None] * geometry.u[:, None, None]
        + (j - (rows - 1) / 2)[..., None] * geometry.v[:, None, None]
    )
    ray = np.linalg.norm(pixel - geometry.source[:, None, None], axis=-1)
    distance, reach = geometry.source_to_detector, geometry.source_to_axis
    weighted = image * distance[:, None, None] / ray * row_weight[:, None]
    h = ramp(columns + margin, window)
    beyond = np.arange(margin) + 0.5
    edge, radius = columns / 2, columns / 2 + margin
    roll = np.sqrt((radius**2 - (edge + beyond) ** 2) / max(radius**2 - edge**2, 1e-9))
    result = np.empty(image.shape)
    for index in np.ndindex(image.shape[:2]):
        line = weighted[index]
        line = np.concatenate([line[0] * roll[::-1], line, line[-1] * roll])
        whole = np.convolve(line, h)
        result[index] = whole[columns + 2 * margin :][:columns]
    return result * (reach / distance / np.linalg.norm(geometry.u, axis=1))[:, None, None]


def run(context, queue, geometry, image, **options) -> np.ndarray:
    out = cl_array.zeros(queue, image.shape, np.float32)
    RampFilter(context, geometry, **options)(queue, out, cl_array.to_device(queue, image))
    return out.get()


def assert_close(found: np.ndarray, expected: np.ndarray, relative: float = RELATIVE) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=relative * np.abs(expected).max())


@pytest.mark.parametrize("form", [CPU, GPU], ids=["cpu", "gpu"], indirect=True)
@pytest.mark.parametrize("shape", [(5, 13), (1, 64), (7, 37), (3, 1), (2, 600)])
def test_filter_is_the_direct_convolution(context, queue, shape, form):
    geometry = scanner(shape=shape)
    image, row_weight = image_of(geometry), np.linspace(0.5, 1, shape[0])
    view_weight = np.array([1.0, 1.75, 0.5])
    options = {"row_weight": row_weight, "view_weight": view_weight}
    found = run(context, queue, geometry, image, **options)
    weighted = view_weight[:, None, None] * image
    assert_close(found, filtered(geometry, weighted, row_weight))


@pytest.mark.parametrize("window", ramp_module.WINDOWS)
def test_windows_shape_the_ramp(context, queue, window):
    geometry = scanner(shape=(3, 41))
    image = image_of(geometry)
    found = run(context, queue, geometry, image, window=window)
    assert_close(found, filtered(geometry, image, np.ones(3), window), ALIASING)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("form", [CPU, GPU], ids=["cpu", "gpu"], indirect=True)
def test_filtered_radiographs_of_an_offset_detector_are_wider(context, queue, side, form):
    """As if the rays past its near side had been measured as 0."""
    distances = {"source_to_axis": 20.0, "source_to_detector": 60.0, "pixel_size": 1.5}
    centred = circular(40, shape=(3, 37), **distances)
    geometry = widened(centred, *((-14, 0) if side > 0 else (0, -14)))
    rays = ray_weights(geometry)
    image = image_of(geometry)
    ramp_filter = RampFilter(context, geometry, ray_weights=rays)
    assert np.allclose(ramp_filter.geometry.to_astra(), centred.to_astra(), atol=1e-12)
    out = cl_array.zeros(queue, (40, 3, 37), np.float32)
    ramp_filter(queue, out, cl_array.to_device(queue, image))
    beyond = (14, 0) if side > 0 else (0, 14)
    weighted = np.pad(image * rays.at(np.arange(23))[:, None], ((0, 0), (0, 0), beyond))
    assert_close(out.get(), filtered(centred, weighted, np.ones(3)), ALIASING)


@pytest.mark.parametrize("form", [CPU, GPU], ids=["cpu", "gpu"], indirect=True)
def test_extension_continues_truncated_rows(context, queue, form):
    geometry = scanner(shape=(3, 40))
    image = image_of(geometry)
    found = run(context, queue, geometry, image, extend=0.2)
    assert_close(found, filtered(geometry, image, np.ones(3), margin=8))


def test_extension_flattens_a_truncated_object(context, queue):
    """The ramp of a constant is 0; a sharp end of the row makes a bowl of it."""
    geometry = circular(
        1, source_to_axis=1e4, source_to_detector=2e4, pixel_size=1.0, shape=(1, 99)
    )
    constant = np.ones((1, 1, 99), np.float32)
    sharp, extended = (
        np.abs(run(context, queue, geometry, constant, extend=extend)[0, 0])
        for extend in (0.0, 0.2)
    )
    assert extended[0] < 0.1 * sharp[0]
    assert extended[49] < sharp[49]


def test_a_centred_sphere_has_its_attenuation(context, queue):
    """Whole chain in float64 but for the filter: f = pi / W sum q / g^2 in the plane z = 0."""
    views, radius, attenuation = 90, 2.0, 0.7
    geometry = circular(
        views, source_to_axis=20.0, source_to_detector=60.0, pixel_size=0.15, shape=(5, 112)
    )
    rows, columns = geometry.shape
    j, i = np.mgrid[:rows, :columns]
    direction = (
        (geometry.detector - geometry.source)[:, None, None]
        + (i - (columns - 1) / 2)[..., None] * geometry.u[:, None, None]
        + (j - (rows - 1) / 2)[..., None] * geometry.v[:, None, None]
    )
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    along = np.einsum("vrcx,vx->vrc", direction, geometry.source)
    closest = np.sum(geometry.source**2, axis=1)[:, None, None] - along**2
    chord = 2 * np.sqrt(np.maximum(0, radius**2 - closest))
    q = run(context, queue, geometry, (attenuation * chord).astype(np.float32))

    x, y = np.mgrid[-1.4:1.5:0.2, -1.4:1.5:0.2].reshape(2, -1)
    x, y = (axis[x**2 + y**2 < (0.75 * radius) ** 2] for axis in (x, y))
    points = np.stack([x, y, np.zeros_like(x), np.ones_like(x)])
    a, _, g = np.moveaxis(geometry.projection_matrices() @ points, 1, 0)
    total = np.zeros(len(x))
    for view in range(views):
        column = a[view] / g[view]
        total += np.interp(column, np.arange(columns), q[view, rows // 2]) / g[view] ** 2
    found = np.pi / views * total
    np.testing.assert_allclose(found, attenuation, rtol=INTENSITY)


@pytest.mark.parametrize("form", [CPU, GPU], ids=["cpu", "gpu"], indirect=True)
def test_any_chunk_gives_the_same(context, queue, form):
    geometry = scanner(views=5)
    image = image_of(geometry)
    expected = run(context, queue, geometry, image)
    ramp_filter = RampFilter(context, geometry)
    three_lines = 4 * ramp_filter.padded * 3
    ramp_filter = RampFilter(context, geometry, scratch_limit=three_lines)
    whole = cl_array.to_device(queue, image)
    for start, stop in [(1, 2), (0, 1), (2, 5)]:
        part = slice(start, stop)
        ramp_filter(queue, whole[part], whole[part], views=part)  # in place, with an offset
    np.testing.assert_array_equal(whole.get(), expected)


@pytest.mark.parametrize("form", [CPU, GPU], ids=["cpu", "gpu"], indirect=True)
def test_rows_are_filtered_alone(context, queue, form):
    geometry = scanner(views=5, shape=(11, 37))
    image = image_of(geometry)
    weights = {"row_weight": np.linspace(0.5, 1, 11)}
    expected = run(context, queue, geometry, image, **weights)
    ramp_filter = RampFilter(context, geometry, **weights)
    views, rows = slice(1, 4), slice(4, 8)  # GPUs filter pairs of rows
    out = cl_array.to_device(queue, np.full((3, 11, 37), np.nan, np.float32))
    part = cl_array.to_device(queue, np.ascontiguousarray(image[views, rows]))
    ramp_filter(queue, out, part, views=views, rows=rows)
    found = out.get()
    np.testing.assert_array_equal(found[:, rows], expected[views, rows])
    assert np.isnan(np.delete(found, np.r_[rows], axis=1)).all()


def test_length_unit_does_not_matter(context, queue):
    geometry = scanner()
    image = image_of(geometry)
    expected = run(context, queue, geometry, image)
    for scale in (1e-3, 1e3):
        vectors = geometry.to_astra() * scale
        scaled = ConeBeamGeometry.from_astra(vectors, geometry.shape)
        assert_close(run(context, queue, scaled, image) * scale, expected)


def test_set_geometry(context, queue):
    geometry = scanner()
    image = image_of(geometry)
    moved = geometry.with_motion(Motion(shift_u=[3, -2, 1], shift_v=[0, 5, 1]))
    ramp_filter = RampFilter(context, geometry)
    out = cl_array.zeros(queue, image.shape, np.float32)
    ramp_filter.set_geometry(moved)
    ramp_filter(queue, out, cl_array.to_device(queue, image))
    assert_close(out.get(), filtered(moved, image, np.ones(5)))
    with pytest.raises(ValueError, match="geometry: found"):
        ramp_filter.set_geometry(geometry.binned(2))


@pytest.mark.parametrize("backend", ["scipy", "reikna"])
def test_out_of_order_queue(context, unordered, backend):
    geometry = scanner()
    first, second = image_of(geometry), image_of(geometry, seed=1)
    ramp_filter = RampFilter(context, geometry, backend=backend)
    found = np.empty((2, *first.shape), np.float32)
    for image, result in zip((first, second), found, strict=True):
        device = cl_array.Array(context, image.shape, np.float32)
        out = cl_array.Array(context, image.shape, np.float32)
        uploaded = cl.enqueue_copy(unordered, device.base_data, image, is_blocking=False)
        done = ramp_filter(unordered, out, device, wait_for=[uploaded])
        cl.enqueue_copy(unordered, result, out.base_data, wait_for=[done])
    assert_close(found[0], filtered(geometry, first, np.ones(5)))
    assert_close(found[1], filtered(geometry, second, np.ones(5)))


def test_what_is_refused(context, queue):
    geometry = scanner()
    image = cl_array.zeros(queue, (3, 5, 13), np.float32)
    ramp_filter = RampFilter(context, geometry)
    with pytest.raises(TypeError, match="projections: found ndarray"):
        ramp_filter(queue, image, image.get())
    with pytest.raises(ValueError, match=r"filtered_out: found shape \(2, 5, 13\)"):
        ramp_filter(queue, image[:2], image)
    with pytest.raises(ValueError, match="projections: found shape"):
        ramp_filter(queue, image, image, views=slice(0, 2))
    with pytest.raises(ValueError, match="views: found"):
        ramp_filter(queue, image, image, views=slice(0, 3, 2))
    with pytest.raises(ValueError, match="window: found 'box'"):
        RampFilter(context, geometry, window="box")
    with pytest.raises(ValueError, match="row_weight: found"):
        RampFilter(context, geometry, row_weight=np.ones(4))
    with pytest.raises(ValueError, match="view_weight: found"):
        RampFilter(context, geometry, view_weight=np.ones(4))


@pytest.mark.parametrize("rows", [1, 10, 11])
@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.5])
def test_taper_is_symmetric_and_positive(rows, fraction):
    weight = taper(rows, fraction)
    assert weight.shape == (rows,) and weight.dtype == np.float32
    np.testing.assert_array_equal(weight, weight[::-1])
    assert weight.min() > 0 and weight.max() <= 1
    assert np.all(np.diff(weight[: (rows + 1) // 2]) >= 0)
    assert np.sum(weight < 1 - 1e-6) <= 2 * np.ceil(fraction * rows)


def test_taper_reaches_half_in_the_middle_of_the_roll():
    assert taper(105, 0.2)[10] == pytest.approx(0.5, abs=1e-6)
    with pytest.raises(ValueError, match=r"fraction: found 0\.6"):
        taper(10, 0.6)
