"""Where points land, and what motion and binning do to that."""

import dataclasses

import numpy as np
import pytest
from geometries import tilted
from hypothesis import given, settings
from hypothesis import strategies as st

from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion

# Rounding of float64 in pixels of a detector of 1e3, with room for ill-conditioned tilts.
PIXEL = 1e-8
SHAPE = (37, 51)


def pixel_centre(geometry, column, row):
    i, j = column - (geometry.columns - 1) / 2, row - (geometry.rows - 1) / 2
    return geometry.detector + i * geometry.u + j * geometry.v


def points(seed=1, count=9, unit=1.0):
    return unit * np.random.default_rng(seed).normal(size=(count, 3))


@given(st.floats(-0.5, 50.5), st.floats(-0.5, 36.5), st.floats(0.05, 3.0))
@settings(max_examples=30, deadline=None)
def test_points_on_a_ray_land_on_its_pixel(column, row, depth):
    geometry = tilted()
    on_ray = geometry.source + depth * (pixel_centre(geometry, column, row) - geometry.source)
    for view in range(geometry.views):
        found = geometry.project(on_ray[view : view + 1])[view, 0]
        np.testing.assert_allclose(found, [column, row], atol=PIXEL)
        homogeneous = geometry.projection_matrices()[view] @ [*on_ray[view], 1]
        np.testing.assert_allclose(homogeneous, depth * np.array([column, row, 1]), atol=PIXEL)


def test_projection_agrees_with_the_determinants_of_astra():
    geometry = tilted(seed=3)
    found = geometry.project(points()) - [(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2]
    s, d, u, v = np.split(geometry.to_astra(), 4, axis=1)
    for view in range(geometry.views):
        for n, x in enumerate(points()):
            ray, axis = x - s[view], d[view] - s[view]
            depth = np.linalg.det([u[view], v[view], ray])
            column = np.linalg.det([ray, v[view], axis]) / depth
            row = np.linalg.det([u[view], ray, axis]) / depth
            np.testing.assert_allclose(found[view, n], [column, row], atol=PIXEL)


def test_points_behind_the_source_have_no_pixel():
    geometry = tilted()
    behind = geometry.source[:1] - (geometry.detector - geometry.source)[:1]
    assert np.isnan(geometry.project(behind)[0]).all()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_absorbed_motion_is_motion_of_the_pixels(seed):
    geometry, random = tilted(seed=4), np.random.default_rng(seed)
    motion = Motion(
        shift_u=random.uniform(-20, 20, 5),
        shift_v=random.uniform(-20, 20, 5),
        magnification=random.uniform(0.9, 1.1, 5),
    )
    centre = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2])
    shift = np.stack([motion.shift_u, motion.shift_v], axis=1)[:, None]
    magnification = motion.magnification[:, None, None]
    expected = centre + magnification * (geometry.project(points()) - centre) + shift
    found = geometry.with_motion(motion).project(points())
    np.testing.assert_allclose(found, expected, atol=PIXEL)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_a_moved_source_moves_the_pixels_of_what_lies_at_the_depth_of_the_axis(seed):
    geometry, random = tilted(seed=4), np.random.default_rng(seed)
    motion = Motion(
        shift_u=random.uniform(-20, 20, 5),
        shift_v=random.uniform(-20, 20, 5),
        magnification=random.uniform(0.9, 1.1, 5),
        cause="source",
    )
    moved = geometry.with_motion(motion)
    for name in ("detector", "u", "v"):
        np.testing.assert_array_equal(getattr(moved, name), getattr(geometry, name))
    np.testing.assert_allclose(
        moved.source - geometry.source, geometry.source_displacement(motion), atol=1e-12
    )
    across, along = random.uniform(-9, 9, 2)
    centre = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2])
    for view in range(5):
        at_axis = (
            geometry.source[view]
            + geometry.source_to_axis[view] * geometry.normal[view]
            + across * geometry.u[view]
            + along * geometry.v[view]
        )
        before, after = (g.project(at_axis[None])[view, 0] for g in (geometry, moved))
        shift = np.array([motion.shift_u[view], motion.shift_v[view]])
        expected = centre + motion.magnification[view] * (before - centre) + shift
        np.testing.assert_allclose(after, expected, atol=PIXEL)


def test_a_source_that_moves_aside_shows_parallax():
    # Twice as near to the source as the axis: magnified 20 times instead of 10.
    geometry = ConeBeamGeometry(
        source=[[0, -10, 0]], detector=[[0, 90, 0]], u=[[1, 0, 0]], v=[[0, 0, 1]], shape=SHAPE
    )
    moved = geometry.with_motion(Motion(shift_u=[-9], shift_v=[0], cause="source"))
    np.testing.assert_allclose(moved.source, [[1, -10, 0]], atol=1e-12)
    points = np.array([[0.0, 0.0, 0.0], [0.0, -5.0, 0.0]])
    shift = moved.project(points) - geometry.project(points)
    np.testing.assert_allclose(shift[0, :, 0], [-9, -19], atol=PIXEL)


def test_motions_absorbed_one_after_the_other_are_one_motion():
    geometry, random = tilted(), np.random.default_rng(5)
    first, second = (
        Motion(
            shift_u=random.normal(size=5),
            shift_v=random.normal(size=5),
            magnification=random.uniform(0.9, 1.1, 5),
        )
        for _ in range(2)
    )
    np.testing.assert_allclose(
        geometry.with_motion(first).with_motion(second).to_astra(),
        geometry.with_motion(first.then(second)).to_astra(),
        atol=1e-12,
    )


@pytest.mark.parametrize("shape", [(37, 51), (36, 51), (37, 50), (36, 50)])
@pytest.mark.parametrize("factor", [1, 2, 3, 4])
def test_binning_keeps_every_pixel_where_it_was(shape, factor):
    geometry = tilted(shape=shape)
    binned = geometry.binned(factor)
    assert binned.shape == (shape[0] // factor, shape[1] // factor)
    # Pixel k of the binned detector is the mean of the pixels factor k to factor k + factor - 1.
    expected = (geometry.project(points()) - (factor - 1) / 2) / factor
    np.testing.assert_allclose(binned.project(points()), expected, atol=PIXEL)


def test_binning_by_two_twice_is_binning_by_four():
    geometry = tilted(shape=(39, 53))
    np.testing.assert_allclose(
        geometry.binned().binned().to_astra(), geometry.binned(4).to_astra(), atol=1e-12
    )


def test_binning_away_the_detector_is_refused():
    with pytest.raises(ValueError, match="factor: found 40, expected at most 37"):
        tilted().binned(40)


def test_matrices_do_not_depend_on_the_unit_of_length():
    for unit in (1e-6, 1e3):
        found = tilted(unit=unit).project(points(unit=unit))
        np.testing.assert_allclose(found, tilted().project(points()), atol=PIXEL)


def test_far_source_loses_no_precision():
    far = 1e6
    geometry = ConeBeamGeometry(
        source=[[0, -far, 0]], detector=[[0, 1, 0]], u=[[1, 0, 0]], v=[[0, 0, 1]], shape=(5, 5)
    )
    found = geometry.project([[0.25, 0, -0.5]])[0, 0]
    np.testing.assert_allclose(found, 2 + np.array([0.25, -0.5]) * (far + 1) / far, atol=1e-9)


def test_distances_and_principal_point_of_an_offset_detector():
    geometry = ConeBeamGeometry(
        source=[[0, -4, 2]],
        detector=[[1.5, 6, 2.2]],
        u=[[0.5, 0, 0]],
        v=[[0, 0, -0.1]],
        shape=(9, 7),
    )
    np.testing.assert_allclose(geometry.source_to_axis, 4)
    np.testing.assert_allclose(geometry.source_to_detector, 10)
    np.testing.assert_allclose(geometry.principal, [[3 - 3, 4 + 2]])
    assert geometry.axial


def test_distances_of_tilted_detectors():
    geometry = tilted()
    foot = pixel_centre(geometry, *geometry.principal.T[..., None])
    ray = foot - geometry.source
    np.testing.assert_allclose(np.linalg.norm(ray, axis=1), geometry.source_to_detector)
    np.testing.assert_allclose(np.sum(ray * geometry.u, axis=1), 0, atol=1e-10)
    np.testing.assert_allclose(np.sum(ray * geometry.v, axis=1), 0, atol=1e-10)
    height = np.stack([0 * ray[:, 0], 0 * ray[:, 0], geometry.source[:, 2]], axis=1)
    along = np.sum((height - geometry.source) * ray, axis=1) / np.linalg.norm(ray, axis=1)
    np.testing.assert_allclose(along, geometry.source_to_axis)
    assert not geometry.axial


def test_subset_keeps_the_chosen_views():
    geometry = tilted()
    odd = np.array([False, True, False, True, False])
    for index in (slice(1, None, 2), [1, 3], odd):
        assert geometry.subset(index) == ConeBeamGeometry.from_astra(
            geometry.to_astra()[1::2], SHAPE
        )
    assert geometry.subset(3).views == 1
    with pytest.raises(ValueError, match=r"source: found shape \(0, 3\)"):
        geometry.subset([])


def test_values_are_immutable_copies():
    source = np.array([[0.0, -1, 0]])
    geometry = ConeBeamGeometry(
        source=source, detector=[[0, 1, 0]], u=[[1, 0, 0]], v=[[0, 0, 1]], shape=(3, 3)
    )
    source[:] = 7
    assert geometry.source[0, 1] == -1
    with pytest.raises(ValueError, match="read-only"):
        geometry.source[0] = 0
    with pytest.raises(dataclasses.FrozenInstanceError):
        geometry.shape = (1, 1)


def test_equality_is_exact():
    assert tilted() == tilted()
    assert tilted() != tilted(shape=(36, 51))
    moved = tilted().to_astra()
    moved[2, 5] = np.nextafter(moved[2, 5], np.inf)
    assert tilted() != ConeBeamGeometry.from_astra(moved, SHAPE)
    assert tilted() != "geometry"


def test_repr_tells_the_size():
    assert "5 views of 37 x 51 pixels" in repr(tilted())
    assert len(tilted()) == 5


GOOD = {
    "source": [[0, -1, 0]],
    "detector": [[0, 1, 0]],
    "u": [[1, 0, 0]],
    "v": [[0, 0, 1]],
    "shape": (3, 3),
}


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"source": [0, -1, 0]}, ValueError, r"source: found shape \(3,\), expected \(views, 3\)"),
        ({"u": [[1, 0, 0]] * 2}, ValueError, "u: found 2 views, expected 1"),
        ({"detector": [[0, np.nan, 0]]}, ValueError, "detector: found .* at 0 of the views"),
        ({"v": [[2, 0, 0]]}, ValueError, "u and v: parallel or zero in view 0"),
        ({"v": [[0, 0, 0]]}, ValueError, "u and v: parallel or zero in view 0"),
        ({"source": [[5, 1, -4]]}, ValueError, "source: in the detector's plane in view 0"),
        ({"shape": (3, 0)}, ValueError, "shape: found 0, expected at least 1"),
        ({"shape": (3.0, 3)}, TypeError, "shape: found 3.0, expected a whole number"),
        ({"shape": 3}, ValueError, r"shape: found 3, expected \(rows, columns\)"),
    ],
)
def test_wrong_values_are_refused(change, error, message):
    with pytest.raises(error, match=message):
        ConeBeamGeometry(**(GOOD | change))


def test_wrong_arguments_are_refused():
    geometry = tilted()
    with pytest.raises(ValueError, match="motion: found 3 views, expected 5"):
        geometry.with_motion(Motion.identity(3))
    with pytest.raises(ValueError, match=r"points: found shape \(3,\)"):
        geometry.project([0, 0, 0])
    with pytest.raises(ValueError, match=r"vectors: found shape \(5, 11\)"):
        ConeBeamGeometry.from_astra(geometry.to_astra()[:, :11], SHAPE)
