from dataclasses import replace

import numpy as np
import pytest

from clra.app.estimate import Speed, costs_of, costs_table, measure, size
from clra.app.simulate import paper_like
from clra.model.grid import default_grid
from clra.ops import opencl
from clra.ops.memory import Budgets

SPEED = Speed("a device", None, back=1e-9, forward=2e-9, filtering=1e-8, registering=3e-8)


def test_costs_follow_from_shapes():
    geometry = paper_like("circular", 100, (64, 48))
    full, half, quarter = costs_of(geometry, SPEED)
    assert (full.level, half.level, quarter.level) == ("FR", "HR", "QR")
    assert full.radiograph_bytes == 4 * 100 * 64 * 48
    assert full.volume_shape == default_grid(geometry).shape
    assert quarter.panel == (16, 12)
    assert half.radiograph_bytes == full.radiograph_bytes / 4
    # on a circle the axis is seen from everywhere
    voxels = np.prod(full.volume_shape)
    assert full.voxel_views == pytest.approx(100 * voxels, rel=0.05)
    pixels = 100 * 64 * 48
    assert full.reconstruction_s == pytest.approx(full.voxel_views * 1e-9 + pixels * 1e-8)
    assert full.iteration_s == pytest.approx(full.voxel_views * 3e-9 + pixels * 4e-8)


def test_a_long_scan_sees_a_voxel_in_part_of_its_views():
    geometry = paper_like("helix", 400, (64, 48))
    full = costs_of(geometry, SPEED)[0]
    part = full.voxel_views / np.prod(full.volume_shape) / 400
    assert 0.5 < part < 0.8  # the panel is 0.74 of the travel high


def test_levels_stop_before_nothing_is_left():
    assert len(costs_of(paper_like("circular", 3, (3, 3)), SPEED)) == 2


def test_sizes_and_table():
    assert [size(n) for n in (999, 1024, 1 << 20, 1500 << 20, 2000 << 40)] == [
        "999 B",
        "1 KiB",
        "1 MiB",
        "1.46 GiB",
        "2000 TiB",
    ]
    geometry = paper_like("circular", 100, (64, 48))
    speed = replace(SPEED, budgets=Budgets.of(opencl.choose_device(), 1 << 30, 4 << 30))
    text = costs_table(costs_of(geometry, speed), speed)
    assert "FR" in text and "48 x 48" not in text.splitlines()[0] and "a device" in text
    assert "4 GiB on the host" in text


def test_a_device_is_measured_in_a_moment():
    speed = measure(paper_like("helix", 200, (200, 128)))
    for seconds in (speed.back, speed.forward, speed.filtering, speed.registering):
        assert 1e-12 < seconds < 1e-4
