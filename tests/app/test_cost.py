from dataclasses import replace

import numpy as np
import pytest

from clra.app.cost import costs_of, costs_table, size
from clra.app.simulation import paper_like
from clra.app.speed import Speed, measure
from clra.model.grid import default_grid
from clra.model.trajectory import double_helix
from clra.ops.runtime.devices import choose_device
from clra.ops.streaming.memory import Budgets

SPEED = Speed("a device", None, back=1e-9, forward=2e-9, filtering=1e-8, registering=3e-8)


def test_costs_follow_from_shapes():
    geometry = paper_like("circular", 100, (64, 48))
    full, half, quarter = costs_of(geometry, SPEED)
    assert (full.level, half.level, quarter.level) == ("FR", "HR", "QR")
    assert full.radiograph_bytes == 4 * 100 * 64 * 48
    assert full.volume_shape == default_grid(geometry).shape
    assert quarter.detector == (16, 12)
    assert half.radiograph_bytes == full.radiograph_bytes / 4
    # on a circle the axis is seen from everywhere
    voxels = np.prod(full.volume_shape)
    assert full.voxel_views == pytest.approx(100 * voxels, rel=0.05)
    pixels = 100 * 64 * 48
    assert full.reconstruction_s == pytest.approx(full.voxel_views * 1e-9 + pixels * 1e-8)
    assert full.iteration_s == pytest.approx(full.voxel_views * 3e-9 + pixels * 4e-8)
    assert np.isnan(full.exact_s)  # no helix


def test_a_long_scan_sees_a_voxel_in_part_of_its_views():
    geometry = paper_like("helix", 400, (64, 48))
    full = costs_of(geometry, SPEED)[0]
    part = full.voxel_views / np.prod(full.volume_shape) / 400
    assert 0.5 < part < 0.8  # the detector is 0.74 of the travel high


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
    speed = replace(SPEED, budgets=Budgets.of(choose_device(), 1 << 30, 4 << 30))
    text = costs_table(costs_of(geometry, speed), speed)
    assert "FR" in text and "48 x 48" not in text.splitlines()[0] and "a device" in text
    assert "4 GiB on the host" in text
    assert text.count("imgr") == 1


def test_a_device_is_measured_in_a_moment():
    speed = measure(paper_like("helix", 200, (200, 128)))
    for seconds in (speed.back, speed.forward, speed.filtering, speed.registering):
        assert 1e-12 < seconds < 1e-4


def _wood(scale):
    """The paper's double helix of wood, or a smaller one."""
    views, voxel = 7068 // scale, 0.139 * 2.8823 / 315.5
    z_step = 5240 * voxel / views
    return double_helix(
        views,
        angle_step=2 * np.pi * z_step / 3.4,
        z_step=z_step,
        source_to_axis=2.8823,
        source_to_detector=315.5,
        pixel_size=0.139 * scale,
        shape=(3040 // scale, 3040 // scale),
    )


def test_the_papers_double_helix():
    geometry, small = _wood(1), _wood(16)
    speed = measure(geometry, max_host_memory=8 << 30)
    full = costs_of(geometry, speed)[0]
    assert geometry.views == 14136 and full.detector == (3040, 3040)
    assert full.volume_shape == (5240, 2526, 2526)
    assert full.radiograph_bytes == 4 * 14136 * 3040**2
    for need in (full.reconstruction, full.iteration, full.exact):
        assert need.host < 8 << 30
        assert need.device < 4 << 30
    # Volumes, and what the radiographs have beyond the re-projections; the radiographs themselves
    # are read again and again at full resolution.
    most = 3 * full.volume_bytes + full.radiograph_bytes
    assert full.volume_bytes + full.radiograph_bytes <= full.iteration.disk < most
    assert full.exact.disk == 0
    text = costs_table([full], speed)
    assert "487 GiB" in text and "125 GiB" in text and text.count("katsevich") == 2
    # All sizes scaled alike, back-projection goes with the fourth power, apart from rounding.
    back = [
        cost.exact_s - cost.radiograph_bytes / 4 * speed.exact_filtering
        for cost in (full, costs_of(small, speed)[0])
    ]
    assert back[0] / back[1] == pytest.approx(16**4, rel=0.1)
