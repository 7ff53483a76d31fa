"""The memory that methods are said to take is what they take."""

import numpy as np
import pytest

import clra
from clra.app.simulation import paper_like
from clra.methods.alignment import align
from clra.methods.alignment.region import region_of
from clra.methods.alignment.reprojection import with_margin
from clra.methods.memory_estimate import alignment_need, multigrid_need, reconstruction_need
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.methods.reconstruction.imgr import imgr
from clra.model.grid import default_grid
from clra.model.phantoms.ellipsoids import Ellipsoids
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import HostPlanes

MIB = 1 << 20
AGREES = 0.2  # part by which prediction and measurement may differ


def _scan(views=150, detector=(120, 96)):
    geometry = paper_like("helix", views, detector)
    pixels = np.random.default_rng(0).random((views, *detector), np.float32)
    return clra.Scan(pixels, geometry)


@pytest.mark.parametrize("budget", [None, 16 * MIB, 6 * MIB])
def test_reconstruction_takes_what_is_predicted(budget):
    scan = _scan()
    stream = Stream(max_device_memory=budget)
    grid = default_grid(scan.geometry)
    target = HostPlanes(grid)
    ramp_fbp(stream, Radiographs(stream, scan, 1), scan.geometry, grid, target=target)
    need = reconstruction_need(stream.budgets, scan.geometry, grid)
    assert stream.memory.peak == pytest.approx(need.device, rel=AGREES)
    assert need.device <= stream.budgets.device
    assert stream.memory.taken == 0


@pytest.mark.filterwarnings("ignore::UserWarning")  # of noise nothing can be found
@pytest.mark.parametrize(
    ("detector", "level", "budget"),
    [
        ((120, 96), 2, None),
        ((120, 96), 2, 12 * MIB),
        ((300, 280), 1, 64 * MIB),  # large enough for registration without a correction
    ],
)
def test_alignment_takes_what_is_predicted(detector, level, budget, monkeypatch):
    scan = _scan(150 if level == 2 else 12, detector)
    streams = []

    def remembered(*arguments, **options):
        streams.append(Stream(*arguments, **options))
        return streams[-1]

    monkeypatch.setattr(align, "Stream", remembered)
    schedule = {1: "1FR", 2: "1HR"}[level]
    clra.align(scan, schedule=schedule, max_device_memory=budget, quality=False)
    stream = streams[0]
    peak = stream.memory.peak
    wide = region_of(stream, scan, default_grid(scan.geometry)).grid
    need = alignment_need(stream.budgets, scan.geometry, wide, level)
    assert peak == pytest.approx(need.device, rel=AGREES)
    assert need.device <= stream.budgets.device


@pytest.mark.filterwarnings("ignore::UserWarning")  # of truncation
def test_a_truncated_sample_takes_its_wider_grid(monkeypatch):
    geometry = paper_like("circular", 24, (100, 96))
    grid = default_grid(geometry)
    radius = 0.8 * grid.shape[1] * grid.voxel_size
    sample = Ellipsoids([[0, 0, 0]], [(radius, radius, 2 * radius)], [0.3 / radius])
    scan = clra.Scan(sample.line_integrals(geometry), geometry)
    streams = []

    def remembered(*arguments, **options):
        streams.append(Stream(*arguments, **options))
        return streams[-1]

    monkeypatch.setattr(align, "Stream", remembered)
    clra.align(scan, schedule="1HR", quality=False)
    peak, budgets = streams[0].memory.peak, streams[0].budgets
    wide = region_of(streams[0], scan, grid).grid
    need, usual = (
        alignment_need(budgets, geometry, where, 2).device for where in (wide, with_margin(grid))
    )
    assert peak == pytest.approx(need, rel=0.5 * AGREES), (peak, need, usual)
    assert usual < (1 - 0.5 * AGREES) * peak


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("budget", [None, 12 * MIB])
def test_multigrid_takes_what_is_predicted(budget):
    scan = _scan()
    stream = Stream(max_device_memory=budget)
    grid = default_grid(scan.geometry)
    imgr(stream, scan, grid, align=True, cycles=1)
    need = multigrid_need(stream.budgets, scan.geometry, grid)
    assert stream.memory.peak == pytest.approx(need.device, rel=AGREES)
