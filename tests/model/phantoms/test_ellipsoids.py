"""Closed-form line integrals against chords, brute force, and the volume."""

import numpy as np
import pytest
from geometries import tilted
from hypothesis import given, settings
from hypothesis import strategies as st

from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.phantoms.ellipsoids import Ellipsoids, porous, three_spheres
from clra.model.trajectory import PAPER, circular

# float32 rounding of line integrals of a few.
ROUNDING = 1e-6


def rays(geometry, view):
    """Unit directions of the rays to all pixels, (rows, columns, 3)."""
    i = np.arange(geometry.columns) - (geometry.columns - 1) / 2
    j = np.arange(geometry.rows)[:, None, None] - (geometry.rows - 1) / 2
    detector = geometry.detector[view] + i[:, None] * geometry.u[view] + j * geometry.v[view]
    ray = detector - geometry.source[view]
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def sphere_chords(geometry, view, centre, radius):
    """Chords of a sphere from the distance of each ray to its centre."""
    offset = np.asarray(centre) - geometry.source[view]
    missed = np.linalg.norm(np.cross(rays(geometry, view), offset), axis=-1)
    return 2 * np.sqrt(np.maximum(radius**2 - missed**2, 0))


def test_central_ray_of_a_sphere_is_its_diameter():
    geometry = circular(3, source_to_axis=10, source_to_detector=20, pixel_size=0.5, shape=(5, 7))
    sphere = Ellipsoids([[0, 0, 0]], [1.5], [0.7])
    np.testing.assert_allclose(sphere.line_integrals(geometry)[:, 2, 3], 2.1, rtol=ROUNDING)


@given(
    st.tuples(*[st.floats(-4, 4)] * 3),  # in front of every source, tilted as it is
    st.floats(0.01, 2.5),
    st.integers(0, 9),
)
@settings(max_examples=60, deadline=None)
def test_spheres_anywhere_have_their_chords_in_every_pixel(centre, radius, seed):
    geometry = tilted(seed)
    found = Ellipsoids([centre], [radius], [1.0]).line_integrals(geometry)
    for view in range(geometry.views):
        expected = sphere_chords(geometry, view, centre, radius)
        # The square root at the rim turns rounding of 1e-15 into 1e-7.
        np.testing.assert_allclose(found[view], expected, atol=3e-6)


def test_ellipsoids_agree_with_sums_along_the_rays():
    geometry = tilted(2)
    phantom = Ellipsoids(
        [[0.3, -0.2, 0.5], [-0.8, 0.4, 0.1]], [[1.5, 0.5, 1.0], [0.4, 1.2, 0.7]], [1.0, -0.4]
    )
    found = phantom.line_integrals(geometry)
    step = 0.002
    along = np.arange(4.0, 16.0, step)[:, None]
    for view, row, column in [(0, 9, 11), (1, 7, 13), (1, 12, 8), (2, 9, 9), (2, 0, 0)]:
        points = geometry.source[view] + along * rays(geometry, view)[row, column]
        inside = [
            np.sum(((points - c) / a) ** 2, axis=1) < 1
            for c, a in zip(phantom.centres, phantom.semi_axes, strict=True)
        ]
        expected = step * (phantom.attenuation @ np.sum(inside, axis=1))
        assert found[view, row, column] == pytest.approx(expected, abs=3 * step)
    assert np.count_nonzero(found) > 200


def test_overlapping_ellipsoids_add():
    geometry, cloud = tilted(3), porous(2.0, 3.0, seed=1, count=40)
    total = sum(
        Ellipsoids([c], [a], [m]).line_integrals(geometry)
        for c, a, m in zip(cloud.centres, cloud.semi_axes, cloud.attenuation, strict=True)
    )
    np.testing.assert_allclose(cloud.line_integrals(geometry), total, atol=10 * ROUNDING)


def test_a_range_of_views_is_that_part_of_all():
    geometry, cloud = tilted(1, views=6), porous(2.0, 3.0, seed=2, count=9)
    np.testing.assert_array_equal(
        cloud.line_integrals(geometry, 2, 5), cloud.line_integrals(geometry)[2:5]
    )


@pytest.mark.parametrize("oversample", [2, 3])
def test_oversampling_is_the_mean_of_a_finer_detector(oversample):
    geometry, cloud = tilted(4), porous(3.0, 6.0, seed=2, count=30)
    rows, columns = geometry.shape
    fine = ConeBeamGeometry(
        source=geometry.source,
        detector=geometry.detector,
        u=geometry.u / oversample,
        v=geometry.v / oversample,
        shape=(rows * oversample, columns * oversample),
    )
    blocks = cloud.line_integrals(fine).reshape(-1, rows, oversample, columns, oversample)
    found = cloud.line_integrals(geometry, oversample=oversample)
    np.testing.assert_allclose(found, blocks.mean(axis=(2, 4)), atol=5 * ROUNDING)


@pytest.mark.parametrize("far", [1e3, 1e6, 1e9])
def test_far_sources_lose_no_precision(far):
    pixel = 0.1 * (far + 5) / far
    geometry = circular(
        1, source_to_axis=far, source_to_detector=far + 5, pixel_size=pixel, shape=(21, 25)
    )
    found = Ellipsoids([[0.2, 0.3, -0.1]], [1.0], [1.0]).line_integrals(geometry)[0]
    x = 0.1 * (np.arange(25) - 12) - 0.2
    z = 0.1 * (np.arange(21)[:, None] - 10) + 0.1
    expected = 2 * np.sqrt(np.maximum(1 - x**2 - z**2, 0))
    # Rays are not parallel but at angles of the order of 1 / far; the rim is a square root.
    np.testing.assert_allclose(found, expected, atol=max(1e-5, 4 * np.sqrt(0.2 / far)))


def test_line_integrals_do_not_depend_on_the_unit_of_length():
    cloud = porous(2.0, 3.0, seed=5, count=20)
    expected = cloud.line_integrals(tilted())
    for unit in (1e-6, 1e3):
        scaled = ConeBeamGeometry.from_astra(tilted().to_astra() * unit, tilted().shape)
        found = cloud.scaled(unit).line_integrals(scaled)
        np.testing.assert_allclose(found, expected, atol=5 * ROUNDING)


def test_ellipsoids_at_the_source_are_refused():
    geometry = circular(1, source_to_axis=2, source_to_detector=4, pixel_size=1, shape=(3, 3))
    for centre in ([0, -2, 5], [0, -4, 0], [0, -1.5, 0]):
        with pytest.raises(ValueError, match="reaches the plane of a source"):
            Ellipsoids([centre], [1.0], [1.0]).line_integrals(geometry)


def test_volume_averages_over_voxels():
    grid = VolumeGrid(shape=(9, 10, 11), voxel_size=0.3, centre=(0.1, 0.2, -0.1))
    phantom = Ellipsoids([[0.2, 0.1, 0.1], [1.6, 0.2, 0]], [[0.8, 1.1, 0.9], [0.5] * 3], [1.0, 2.0])
    fine = 24
    x, y, z = (
        (c[:, None] + 0.3 * ((np.arange(fine) + 0.5) / fine - 0.5)).ravel()
        for c in grid.coordinates()
    )
    expected = np.zeros(grid.shape)
    for (cx, cy, cz), (ax, ay, az), m in zip(
        phantom.centres, phantom.semi_axes, phantom.attenuation, strict=True
    ):
        inside = (
            ((x - cx) / ax) ** 2
            + ((y[:, None] - cy) / ay) ** 2
            + ((z[:, None, None] - cz) / az) ** 2
        ) < 1
        expected += m * inside.reshape(9, fine, 10, fine, 11, fine).mean(axis=(1, 3, 5))
    np.testing.assert_allclose(phantom.volume(grid, oversample=24), expected, atol=0.02)
    rough = phantom.volume(grid)
    assert np.abs(rough - expected).max() < 0.3
    assert rough.dtype == np.float32


def test_volume_holds_the_mass():
    cloud = porous(2.0, 3.0, seed=0, count=50)
    grid = VolumeGrid(shape=(31, 41, 41), voxel_size=0.1)
    mass = np.sum(cloud.attenuation * 4 / 3 * np.pi * cloud.semi_axes[:, 0] ** 3)
    found = cloud.volume(grid, oversample=4).sum(dtype=np.float64) * 0.1**3
    assert found == pytest.approx(mass, rel=1e-3)


def test_volume_and_radiographs_are_the_same_way_up():
    far = 1e6
    geometry = circular(
        1, source_to_axis=far, source_to_detector=far, pixel_size=0.1, shape=(31, 41)
    )
    cloud = porous(1.9, 3.0, seed=3, count=60)
    volume = cloud.volume(VolumeGrid(shape=(31, 41, 41), voxel_size=0.1), oversample=16)
    found = cloud.line_integrals(geometry, oversample=16)[0]
    # Source at -y, u along +x, v along +z.
    np.testing.assert_allclose(found, 0.1 * volume.sum(axis=1), atol=0.03)


def test_three_spheres_fit_the_papers_cylinder():
    radius, height = 240 * 0.004544, 1248 * 0.004544
    phantom = three_spheres(radius, height)
    assert len(phantom) == 6
    assert np.hypot(phantom.centres[:, 0], phantom.semi_axes[:, 0]).max() < radius
    assert (np.abs(phantom.centres[:, 2]) + phantom.semi_axes[:, 2]).max() < height / 2
    paper = {k: v for k, v in PAPER.items() if k != "z_step"} | {"shape": (33, 65)}
    geometry = circular(1, **(paper | {"pixel_size": 0.4544 * 8}))
    lines = phantom.line_integrals(
        ConeBeamGeometry(
            source=np.repeat(geometry.source, 3, axis=0) + phantom.centres[:3],
            detector=np.repeat(geometry.detector, 3, axis=0) + phantom.centres[:3],
            u=np.repeat(geometry.u, 3, axis=0),
            v=np.repeat(geometry.v, 3, axis=0),
            shape=geometry.shape,
        )
    )
    assert lines.max() == pytest.approx(2, rel=0.02)
    assert lines.min() == 0
    # Three compositions: the lines through the middles differ.
    middle = lines[:, 16, 32]
    assert np.abs(np.diff(np.sort(middle))).min() > 0.05


def test_porous_fills_its_cylinder_and_keeps_to_it():
    cloud = porous(2.0, 3.0, seed=7, count=300)
    size = cloud.semi_axes[:, 0]
    assert len(cloud) == 300
    assert (np.hypot(*cloud.centres[:, :2].T) + size).max() <= 2.0
    assert (np.abs(cloud.centres[:, 2]) + size).max() <= 1.5
    assert np.array_equal(cloud.centres, porous(2.0, 3.0, seed=7, count=300).centres)
    assert not np.array_equal(cloud.centres, porous(2.0, 3.0, seed=8, count=300).centres)
    assert "300 in " in repr(cloud)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[0, 0]], [1.0], [1.0]), r"centres: found shape \(1, 2\)"),
        (([[0, 0, 0]], [1.0, 2.0], [1.0]), "semi_axes: found 2 ellipsoids, expected 1"),
        (([[0, 0, 0]], [0.0], [1.0]), "semi_axes: found 0.0, expected positive"),
        (([[0, 0, 0]], [1.0], [np.nan]), "attenuation: found nan at 0 of the ellipsoids"),
    ],
)
def test_wrong_values_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Ellipsoids(*arguments)
