"""OSEM-TR shared out to several workers gives what one process gives."""

import os
import signal

import numpy as np
import pytest

import clra
from clra.errors import Cancelled
from clra.methods.execution.several_devices import SeveralDevices
from clra.methods.reconstruction.osem_tr import osem_tr, start_volume
from clra.methods.shared_work.shared_ordered_subsets import shared_osem_tr, shared_start_volume
from clra.methods.shared_work.shared_scan import SharedScan
from clra.methods.shared_work.subset_tasks import back_projected
from clra.model.grid import default_grid
from clra.ops.runtime.devices import choose_device
from clra.ops.streaming.part_files import RadiographParts, VolumeParts
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.slab_projector import SlabAdjoint, constant_volume
from clra.ops.streaming.stream import Stream, equal_runs
from clra.ops.streaming.volume import HostPlanes

# Norm of the volume, and single voxels: images and slabs are summed in other portions.
VOLUME, VOXEL = 1e-6, 1e-5
SUBSETS = 3


def options(**given):
    return clra.OrderedSubsets(**{"passes": 2, "subsets": SUBSETS, **given})


@pytest.fixture(scope="module")
def scan(small_scan):
    return small_scan


@pytest.fixture(scope="module")
def alone(scan):
    return clra.reconstruct(scan, "osem-tr", motion=scan.truth, options=options())


def assert_same(shared, alone):
    assert np.linalg.norm(shared - alone) < VOLUME * np.linalg.norm(alone)
    assert np.abs(shared - alone).max() < VOXEL * np.abs(alone).max()


@pytest.mark.parametrize(
    ("update", "initial"),
    [("optimal", "uniform"), ("multiplicative", "fbp"), ("paraboloid", "random")],
)
def test_volumes(client, scan, update, initial, tmp_path):
    if initial == "random":
        # What is negative is taken for 0.
        initial = np.random.default_rng(5).normal(0.1, 0.1, default_grid(scan.geometry).shape)
    valid = np.arange(scan.views) % 7 != 3
    call = {"valid_views": valid, "options": options(update=update, initial=initial)}
    shared = clra.reconstruct(scan, "osem-tr", cluster=client, **call)
    assert_same(shared, clra.reconstruct(scan, "osem-tr", **call))
    assert list(tmp_path.iterdir()) == []


def test_workers_that_are_killed(client, scan, alone):
    # One while views are compared, and one while slabs are changed: steps have two tasks each.
    killed = []

    def kill(progress):
        at = ("OSEM-TR: pass 1/2", 1), ("OSEM-TR: pass 2/2", 3)
        if len(killed) < 2 and (progress.stage, progress.done) == at[len(killed)]:
            (pid, *_) = client.run(os.getpid).values()
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)

    call = {"motion": scan.truth, "options": options(), "progress": kill}
    assert_same(clra.reconstruct(scan, "osem-tr", cluster=client, **call), alone)
    assert len(killed) == 2


def test_a_client_that_is_stopped_goes_on(client, scan, alone, tmp_path):
    stopped = []

    def stop(progress):
        # As whoever stops does, it does not change its mind.
        if stopped or progress.stage == "OSEM-TR: pass 2/2":
            stopped.append(progress)
            raise Cancelled

    call = {"motion": scan.truth, "cluster": client, "checkpoint": tmp_path / "kept"}
    with pytest.warns(clra.ClraWarning, match="ended early, after 1 of 2 passes"):
        one = clra.reconstruct(scan, "osem-tr", options=options(), progress=stop, **call)
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]
    single = clra.reconstruct(scan, "osem-tr", motion=scan.truth, options=options(passes=1))
    assert_same(one, single)
    stages = []
    again = clra.reconstruct(
        scan,
        "osem-tr",
        options=options(),
        resume=True,
        progress=lambda told: stages.append(told.stage),
        **call,
    )
    assert "OSEM-TR: pass 1/2" not in stages
    assert_same(again, alone)


def test_a_coarse_level_in_little_memory(scan, tmp_path):
    stream, device = Stream(), choose_device()
    binned = scan.geometry.binned(2)
    grid, used = default_grid(scan.geometry).binned(2), np.ones(binned.shape, np.bool_)
    radiographs, how = Radiographs(stream, scan, 2), options()
    volume = start_volume(stream, radiographs, binned, grid, how)
    misfits = osem_tr(stream, radiographs, binned, volume, how, used=used)
    executor = SeveralDevices([device, device], tmp_path / "tasks", max_device_memory=150 << 10)
    shared = SharedScan(executor, scan)
    given, target = shared.binned(stream, 2), HostPlanes(grid)
    parts = shared_start_volume(shared, stream, given, binned, grid, how)
    assert len(parts.planes) > 2
    parts, found = shared_osem_tr(shared, stream, given, binned, parts, how, used=used)
    shared.source(parts).write(target)
    np.testing.assert_allclose(found, misfits, rtol=1e-5)
    assert_same(target.volume, volume.to_host())
    del parts
    assert [path.name.split("-")[0] for path in executor._files.iterdir()] == ["radiographs"]


def test_a_slab_is_back_projected_from_the_rows_that_see_it(scan, tmp_path, monkeypatch):
    stream, geometry = Stream(), scan.geometry
    images = np.random.default_rng(6).normal(size=scan.shape).astype(np.float32)
    parts = RadiographParts(tmp_path, scan.shape, (slice(0, scan.views),))
    parts.write(slice(0, scan.views), images)
    grid = default_grid(geometry)
    slabs = VolumeParts(tmp_path, grid, tuple(equal_runs(grid.shape[0], 9)))
    whole = constant_volume(stream, grid)
    SlabAdjoint(stream, whole, geometry)(whole, stream.upload(images), slice(0, scan.views))
    expected = stream.download(whole.get(0))
    pixels, read = [], RadiographParts.read

    def counted(self, start, stop, rows=None):
        found = read(self, start, stop, rows)
        pixels.append(found.size)
        return found

    monkeypatch.setattr(RadiographParts, "read", counted)
    monkeypatch.setattr(stream, "chunks", lambda views, size: equal_runs(views, -(-views // 8)))
    for index, planes in enumerate(slabs.planes):
        found = stream.download(back_projected(stream, parts, geometry, slabs, index))
        apart = np.abs(found - expected[:, :, planes]).max()
        assert apart < 6e-6 * np.abs(expected).max()
    assert sum(pixels) < 0.5 * 9 * images.size
