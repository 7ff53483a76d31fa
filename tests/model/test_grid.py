"""The voxel grid and the one that fits a scan."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clra.model.grid import VolumeGrid, default_grid, volume_grid
from clra.model.motion import Motion
from clra.model.trajectory import PAPER, circular, helix, space_filling

ROUNDING = 1e-12

GRID = VolumeGrid(shape=(7, 5, 6), voxel_size=0.3, centre=(1.0, -2.0, 0.5))
CIRCLE = {
    "source_to_axis": 40.0,
    "source_to_detector": 100.0,
    "pixel_size": 0.5,
    "shape": (31, 41),
}


def test_coordinates_are_the_centres_of_the_voxels():
    x, y, z = GRID.coordinates()
    np.testing.assert_allclose(x, 1.0 + 0.3 * (np.arange(6) - 2.5), atol=ROUNDING)
    np.testing.assert_allclose(y, -2.0 + 0.3 * (np.arange(5) - 2), atol=ROUNDING)
    np.testing.assert_allclose(z, 0.5 + 0.3 * (np.arange(7) - 3), atol=ROUNDING)
    corner = GRID.index_to_world() @ [5, 4, 6, 1]
    np.testing.assert_allclose(corner, [x[5], y[4], z[6], 1], atol=ROUNDING)


def test_slab_keeps_its_planes():
    z = GRID.coordinates()[2]
    slab = GRID.slab(2, 5)
    np.testing.assert_allclose(slab.coordinates()[2], z[2:5], atol=ROUNDING)
    assert slab.centre[:2] == GRID.centre[:2]
    for start, stop in ((-1, 3), (3, 3), (0, 8)):
        with pytest.raises(ValueError, match="expected 0 <= start < stop <= 7"):
            GRID.slab(start, stop)


def test_padding_adds_planes_at_both_ends():
    padded = GRID.padded(3)
    assert padded.shape == (13, 5, 6)
    np.testing.assert_allclose(padded.slab(3, 10).centre, GRID.centre, atol=ROUNDING)
    assert padded.padded(-3).shape == GRID.shape
    with pytest.raises(ValueError, match="planes: found -4"):
        GRID.padded(-4)


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_binned_voxels_are_means_of_blocks(factor):
    binned = GRID.binned(factor)
    assert binned.voxel_size == pytest.approx(0.3 * factor)
    for fine, coarse in zip(GRID.coordinates(), binned.coordinates(), strict=True):
        blocks = fine[: len(fine) // factor * factor].reshape(-1, factor).mean(axis=1)
        np.testing.assert_allclose(coarse, blocks, atol=ROUNDING)
    with pytest.raises(ValueError, match="factor: found 6, expected at most 5"):
        GRID.binned(6)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"shape": (2, 3)}, ValueError, r"shape: found \(2, 3\), expected \(nz, ny, nx\)"),
        ({"shape": (2, 0, 3)}, ValueError, "shape: found 0, expected at least 1"),
        ({"shape": (2, 1.5, 3)}, TypeError, "shape: found 1.5, expected a whole number"),
        ({"voxel_size": 0.0}, ValueError, "voxel_size: found 0.0, expected a positive"),
        ({"voxel_size": np.inf}, ValueError, "voxel_size: found inf, expected a positive"),
        ({"centre": (0, 0)}, ValueError, r"centre: found \(0, 0\)"),
        ({"centre": (0, 0, np.nan)}, ValueError, "centre: found"),
    ],
)
def test_wrong_values_are_refused(change, error, message):
    with pytest.raises(error, match=message):
        VolumeGrid(**({"shape": (2, 3, 4), "voxel_size": 1.0} | change))


def test_default_grid_of_a_circle():
    grid = default_grid(circular(8, **CIRCLE))
    assert grid.voxel_size == pytest.approx(0.5 * 40 / 100)
    half_fan = np.arctan(41 / 2 * 0.5 / 100)
    assert grid.shape[1] == grid.shape[2] == np.ceil(2 * 40 * np.sin(half_fan) / 0.2)
    # At the axis a row is a voxel high, so that there are as many planes as rows.
    assert grid.shape[0] == 31
    assert grid.centre == (0, 0, 0)


@pytest.mark.parametrize(("arc", "shift", "edge"), [(1, 1.5, -1), (0.7, 7, -1), (1, 7, 1)])
def test_default_grid_takes_the_farther_side_of_an_offset_detector_only(arc, shift, edge):
    geometry = circular(80, arc=arc * 2 * np.pi, **CIRCLE)
    moved = Motion(shift_u=np.full(80, float(shift)), shift_v=np.zeros(80))
    shifted = geometry.with_motion(moved)
    half_fan = np.arctan((41 / 2 + edge * shift) * 0.5 / 100)
    assert default_grid(shifted).shape[2] == np.ceil(2 * 40 * np.sin(half_fan) / 0.2)


def test_default_grid_of_the_paper():
    grid = default_grid(space_filling(3456, **PAPER))
    assert grid.voxel_size == pytest.approx(0.004544, rel=1e-4)
    # The paper's phantom is 480 x 480 x 1248 voxels.
    assert 480 <= grid.shape[2] < 510
    assert 1248 <= grid.shape[0] <= 1250


def test_default_grid_of_a_helix_ends_where_half_the_views_see_the_axis():
    geometry = helix(400, angle_step=0.1, z_step=0.05, **CIRCLE)
    grid = default_grid(geometry)
    z = grid.coordinates()[2]
    axis = np.stack([0 * z, 0 * z, z], axis=1)
    seen = (np.abs(geometry.project(axis)[..., 1] - 15) < 31 / 2).sum(axis=0)
    best = 31 * 0.2 / 0.05
    assert seen.min() >= best / 2 - 2
    # One more plane at either end would be seen by fewer than half.
    beyond = np.array([[0, 0, z[0] - 0.2], [0, 0, z[-1] + 0.2]])
    assert (
        (np.abs(geometry.project(beyond)[..., 1] - 15) < 31 / 2).sum(axis=0) < best / 2 + 1
    ).all()


@given(st.sampled_from([1e-6, 1e-3, 1e3]), st.sampled_from([(31, 41), (30, 40), (1, 1)]))
@settings(max_examples=9, deadline=None)
def test_default_grid_does_not_depend_on_the_unit_of_length(unit, shape):
    lengths = {k: v * unit for k, v in CIRCLE.items() if k != "shape"}
    small = default_grid(helix(60, angle_step=0.3, z_step=0.1 * unit, shape=shape, **lengths))
    grid = default_grid(helix(60, angle_step=0.3, z_step=0.1, **(CIRCLE | {"shape": shape})))
    assert small.shape == grid.shape
    assert small.voxel_size == pytest.approx(grid.voxel_size * unit)


def test_default_grid_of_a_far_source_is_that_of_parallel_rays():
    far = {"source_to_axis": 20e6, "source_to_detector": 20e6 + 10, "pixel_size": 0.5}
    grid = default_grid(circular(5, shape=(31, 41), **far))
    assert grid.shape == (31, 41, 41)
    assert grid.voxel_size == pytest.approx(0.5, rel=1e-6)


def test_default_grid_of_one_view_whose_rows_run_downward():
    geometry = circular(1, **CIRCLE)
    down = type(geometry)(
        source=geometry.source,
        detector=geometry.detector,
        u=geometry.u,
        v=-geometry.v,
        shape=geometry.shape,
    )
    assert default_grid(down) == default_grid(geometry)


def test_scans_without_a_field_of_view_are_refused():
    geometry = circular(3, **CIRCLE)
    aside = Motion(shift_u=[0, 21, 0], shift_v=np.zeros(3))
    with pytest.raises(ValueError, match="view 1 does not see the rotation axis"):
        default_grid(geometry.with_motion(aside))
    lying = type(geometry)(
        source=geometry.source,
        detector=geometry.detector,
        u=geometry.v,
        v=geometry.u,
        shape=geometry.shape,
    )
    with pytest.raises(ValueError, match="give a grid"):
        default_grid(lying)
    behind = type(geometry)(
        source=geometry.source + 2 * (geometry.detector - geometry.source),
        detector=geometry.detector + 2 * (geometry.detector - geometry.source),
        u=geometry.u,
        v=geometry.v,
        shape=geometry.shape,
    )
    with pytest.raises(ValueError, match="the axis lies behind the source"):
        default_grid(behind)


def test_a_region_has_the_voxels_of_the_whole_grid():
    geometry = circular(80, **CIRCLE)
    whole = default_grid(geometry)
    part = volume_grid(geometry, roi=((-1.1, 2.03), (None, 0.0), (0.7, None)))
    for axis, all_of_it, (low, high) in zip(
        part.coordinates(),
        whole.coordinates(),
        ((-1.1, 2.03), (-np.inf, 0.0), (0.7, np.inf)),
        strict=True,
    ):
        half = 0.5 * whole.voxel_size
        inside = all_of_it[(all_of_it + half > low + 1e-6) & (all_of_it - half < high - 1e-6)]
        assert axis == pytest.approx(inside)


def test_another_voxel_covers_the_same_field_of_view():
    geometry = circular(80, **CIRCLE)
    whole, fine = default_grid(geometry), volume_grid(geometry, voxel_size=0.07)
    assert fine.voxel_size == 0.07
    assert fine.centre == whole.centre
    for n, m in zip(fine.shape, whole.shape, strict=True):
        assert m * whole.voxel_size <= n * 0.07 < m * whole.voxel_size + 0.07


@pytest.mark.parametrize("ends", [(1.0, 1.0), (2.0, 1.0)])
def test_a_region_is_not_empty(ends):
    with pytest.raises(ValueError, match="roi: found y"):
        volume_grid(circular(8, **CIRCLE), roi=((None, None), ends, (None, None)))
