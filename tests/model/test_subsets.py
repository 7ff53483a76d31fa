"""Ordered subsets: a partition, well spread, that sees the whole sample."""

import numpy as np
import pytest

import clra
from clra.model.grid import default_grid
from clra.model.subsets import bit_reversed, ordered_subsets

COMMON = {
    "source_to_axis": 7.068,
    "source_to_detector": 335.6,
    "pixel_size": 0.139 * 24,
    "shape": (96, 96),
}
VOXEL = 0.139 * 24 * 7.068 / 335.6


@pytest.mark.parametrize("count", [1, 2, 7, 13, 40, 101])
@pytest.mark.parametrize("views", [101, 240])
def test_each_view_is_in_one_subset(views, count):
    geometry = clra.circular(views, **COMMON)
    subsets = ordered_subsets(geometry, default_grid(geometry), count)
    assert len(subsets) == count
    assert sorted(np.concatenate(subsets).tolist()) == list(range(views))
    assert max(map(len, subsets)) - min(map(len, subsets)) <= 1
    assert all((np.diff(subset) > 0).all() for subset in subsets)


def test_views_of_a_circle_are_evenly_spread_and_directions_not_repeated():
    geometry = clra.circular(240, **COMMON)
    subsets = ordered_subsets(geometry, default_grid(geometry), 8)
    assert all((np.diff(subset) == 8).all() for subset in subsets)
    assert [subset[0] for subset in subsets] == [0, 4, 2, 6, 1, 5, 3, 7]


@pytest.mark.parametrize("count", [1, 2, 3, 8, 11, 40])
def test_bits_are_reversed_for_any_count(count):
    order = bit_reversed(count)
    assert sorted(order) == list(range(count))
    if count == 8:
        assert order == [0, 4, 2, 6, 1, 5, 3, 7]


def directions(geometry, subset):
    """0 for directions spread evenly over half a turn, 1 for a single one."""
    angle = np.arctan2(geometry.source[subset, 0], -geometry.source[subset, 1])
    return abs(np.exp(2j * angle).mean())


def test_angles_that_nearly_repeat_do_not_leave_a_subset_one_sided():
    # 47 steps of 15.264 degrees are two turns less 2.6 degrees: every 47th view looks the same way.
    geometry = clra.space_filling(
        470, z_step=96 * VOXEL / 470, angle_step=np.radians(15.264), **COMMON
    )
    every = [np.arange(k, 470, 47) for k in range(47)]
    assert max(directions(geometry, subset) for subset in every) > 0.9
    subsets = ordered_subsets(geometry, default_grid(geometry), 47)
    assert np.median([directions(geometry, subset) for subset in subsets]) < 0.5


@pytest.mark.parametrize("turns", [3, 11])
def test_every_subset_of_a_helix_covers_every_height(turns):
    views = 400
    geometry = clra.helix(
        views,
        angle_step=2 * np.pi * turns / views,
        z_step=3 * 96 * VOXEL / views,
        **COMMON,
    )
    grid = default_grid(geometry)
    subsets = ordered_subsets(geometry, grid)
    assert len(subsets) > 1
    heights = np.linspace(*grid.coordinates()[2][[0, -1]], 50)
    row = geometry.project(np.column_stack([np.zeros((50, 2)), heights]))[..., 1]
    seen = (row >= 0) & (row <= geometry.rows - 1)
    for subset in subsets:
        assert seen[subset].sum(axis=0).min() > 0
    with pytest.raises(ValueError, match=r"subsets: found 200, expected fewer"):
        ordered_subsets(geometry, grid, 200)


def test_the_number_of_subsets_is_checked():
    geometry = clra.circular(20, **COMMON)
    with pytest.raises(ValueError, match=r"subsets: found 21, expected at most 20"):
        ordered_subsets(geometry, default_grid(geometry), 21)
    with pytest.raises(ValueError, match=r"subsets: found 0, expected at least 1"):
        ordered_subsets(geometry, default_grid(geometry), 0)
    assert len(ordered_subsets(geometry, default_grid(geometry))) == 1
