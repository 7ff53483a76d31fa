"""Chunks, slabs and binned radiographs."""

from dataclasses import replace

import numpy as np
import pytest

import clra
from clra.methods.reconstruction.fbp import ramp_fbp
from clra.model.grid import VolumeGrid
from clra.ops.runtime.profile import CPU, forced
from clra.ops.streaming.memory import DeviceMemoryError
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import Volume

DETECTOR = {"source_to_axis": 50.0, "source_to_detector": 100.0, "pixel_size": 1.0}


def test_chunks_cover_all_views_within_the_budget():
    stream = Stream(max_device_memory=8 << 20)
    chunks = stream.chunks(101, 100_000)
    assert [c.start for c in chunks[1:]] == [c.stop for c in chunks[:-1]]
    assert (chunks[0].start, chunks[-1].stop) == (0, 101)
    sizes = [c.stop - c.start for c in chunks]
    assert max(sizes) * 100_000 <= 1 << 19
    assert max(sizes) - min(sizes) <= 1


def test_a_view_larger_than_the_budget_is_a_chunk():
    assert len(Stream(max_device_memory=1 << 20).chunks(3, 1 << 30)) == 3


def test_slabs_fit_and_cover():
    stream = Stream(max_device_memory=3 << 20)
    slabs = stream.slabs(VolumeGrid(shape=(100, 64, 64), voxel_size=1.0))
    assert slabs[0].start == 0
    assert slabs[-1].stop == 100
    assert max(s.stop - s.start for s in slabs) * 64 * 64 * 4 <= 1 << 20


def test_a_plane_too_large_says_what_to_do():
    stream = Stream(max_device_memory=1 << 20)
    with pytest.raises(DeviceMemoryError, match="coarser grid or raise the memory limit"):
        stream.slabs(VolumeGrid(shape=(2, 1000, 1000), voxel_size=1.0))


@pytest.mark.parametrize("budget", [None, 3 << 10])
def test_volume_keeps_its_slabs(budget):
    stream = Stream(max_device_memory=budget)
    grid = VolumeGrid(shape=(13, 5, 7), voxel_size=1.0)
    expected = np.random.default_rng(0).random(grid.shape, np.float32)
    volume = Volume(stream, grid)
    assert (len(volume.slabs) > 1) == (budget is not None)
    start = 0
    for index, slab in enumerate(volume.slabs):
        part = np.ascontiguousarray(np.moveaxis(expected[start : start + slab.shape[0]], 0, 2))
        volume.put(index, stream.upload(part))
        assert np.array_equal(volume.get(index).get(), part)
        start += slab.shape[0]
    assert np.array_equal(volume.to_host(), expected)


@pytest.mark.parametrize("host", [None, 40 << 10])
def test_binned_radiographs_are_means(host):
    geometry = clra.circular(80, shape=(29, 42), **DETECTOR)
    pixels = np.random.default_rng(1).random((80, 29, 42), np.float32)
    stream = Stream(max_host_memory=host)
    radiographs = Radiographs(stream, clra.Scan(pixels, geometry), 4)
    expected = pixels[:, :28, :40].reshape(80, 7, 4, 10, 4).mean(axis=(2, 4))
    assert radiographs.shape == (80, *geometry.binned(4).shape)
    assert np.allclose(radiographs.read(slice(1, 77)), expected[1:77], rtol=1e-6)


def test_full_resolution_is_read_where_needed():
    class Counting:
        shape = (6, 4, 5)
        read = 0

        def __getitem__(self, views):
            Counting.read += 1
            return np.zeros((views.stop - views.start, 4, 5), np.float32)

    scan = clra.Scan(Counting(), clra.circular(6, shape=(4, 5), **DETECTOR))
    radiographs = Radiographs(Stream(), scan, 1)
    assert Counting.read == 0
    radiographs.read(slice(2, 4))
    assert Counting.read == 1


def test_what_is_uploaded_may_change_at_once():
    """Through a ring of three buffers, in pieces, of which the last is no whole one."""
    with forced(replace(CPU, shared_memory=False)):
        stream = Stream(max_host_memory=1 << 20)
    host = np.arange(5 * stream.budgets.piece // 4 + 3, dtype=np.float32)
    arrays = []
    for _ in range(3):
        arrays.append(stream.upload(host))
        host += 1
    for added, array in enumerate(arrays):
        expected = np.arange(host.size, dtype=np.float32) + added
        assert np.array_equal(stream.download(array), expected)


def test_radiographs_stay_on_a_device_with_its_own_memory():
    pixels = np.random.default_rng(3).random((7, 12, 16), np.float32)
    scan = clra.Scan(pixels, clra.circular(7, shape=(12, 16), **DETECTOR))
    with forced(replace(CPU, shared_memory=False)):
        stream = Stream()
    radiographs = Radiographs(stream, scan, 1)
    for views in slice(2, 5), slice(0, 4), slice(1, 7):
        assert np.array_equal(stream.download(radiographs.on_device(stream, views)), pixels[views])
    taken = stream.memory.taken
    assert taken == pixels.nbytes
    pixels[:] = 0  # nothing is read again
    assert stream.download(radiographs.on_device(stream, slice(0, 7))).all()
    assert stream.memory.taken == taken


@pytest.mark.parametrize("budget", [None, 40 << 10])
def test_a_device_with_its_own_memory_gets_copies(budget):
    """As on a GPU: radiographs are copied on a queue beside the one that works on them."""
    geometry = clra.circular(60, shape=(12, 16), **DETECTOR)
    grid = VolumeGrid(shape=(9, 10, 11), voxel_size=0.5)
    pixels = np.random.default_rng(2).random((60, 12, 16), np.float32)
    volumes = []
    for shared in (True, False):
        with forced(replace(CPU, shared_memory=shared)):
            stream = Stream(max_device_memory=budget)
        assert stream.budgets.shared == shared
        radiographs = Radiographs(stream, clra.Scan(pixels, geometry), 1)
        volumes.append(ramp_fbp(stream, radiographs, geometry, grid).to_host())
    assert np.array_equal(volumes[0] != 0, volumes[1] != 0)
    assert np.allclose(*volumes, atol=1e-6 * np.abs(volumes[0]).max())
