"""Radiographs and volumes in files of several workers."""

from dataclasses import replace

import numpy as np
import pytest

import clra
from clra.ops.streaming import part_files
from clra.ops.streaming.memory import Store
from clra.ops.streaming.part_files import RadiographParts, VolumeParts
from clra.ops.streaming.slab_projector import ConstantVolume, SlabProjector, volume_from
from clra.ops.streaming.stream import Stream, equal_runs
from clra.ops.streaming.volume import HostPlanes

SHAPE = (7, 5, 3)


@pytest.fixture(scope="module")
def stream():
    return Stream()


def test_images_that_are_written_some_at_a_time(tmp_path):
    images = np.random.default_rng(0).normal(size=(6, 2, 3)).astype(np.float32)
    parts = RadiographParts(tmp_path, images.shape, (slice(0, 4), slice(4, 6)))
    with parts.writing(slice(0, 4)) as write:
        write(images[:1])
        assert not any(path.name == "views-000000" for path in tmp_path.iterdir())
        write(images[1:4])
    parts.write(slice(4, 6), images[4:])
    np.testing.assert_array_equal(parts.read(2, 6), images[2:])


@pytest.mark.parametrize("piece", [64, 32 << 20])
def test_a_volume_of_the_host(stream, tmp_path, monkeypatch, piece):
    monkeypatch.setattr(part_files, "_PIECE_BYTES", piece)
    values = np.random.default_rng(1).normal(size=SHAPE).astype(np.float32)
    grid = clra.VolumeGrid(shape=SHAPE, voxel_size=1.0)
    parts = VolumeParts(tmp_path, grid, (slice(0, 4), slice(4, 7)))
    for index in range(2):
        parts.write_planes(index, values)
    np.testing.assert_array_equal(parts.volume(stream).to_host(), np.maximum(values, 0))


@pytest.mark.parametrize("wanted", [slice(0, 7), slice(1, 3), slice(2, 6), slice(6, 7)])
def test_some_planes_of_a_volume(stream, tmp_path, wanted):
    values = np.random.default_rng(2).uniform(size=SHAPE).astype(np.float32)
    parts = VolumeParts(
        tmp_path, clra.VolumeGrid(shape=SHAPE, voxel_size=1.0), (slice(0, 4), slice(4, 7))
    )
    for index in range(2):
        parts.write_planes(index, values)
    target = HostPlanes(
        clra.VolumeGrid(shape=(wanted.stop - wanted.start, *SHAPE[1:]), voxel_size=1.0)
    )
    parts.volume(stream).write(target, wanted)
    np.testing.assert_array_equal(target.volume, values[wanted])


def test_all_views_are_projected_with_each_slab_read_once(stream, tmp_path, monkeypatch):
    # A helix that sees the slabs one after the other, and nothing at its ends.
    flat = clra.circular(24, source_to_axis=5, source_to_detector=50, pixel_size=1.0, shape=(8, 16))
    height = np.outer(np.linspace(-2.5, 2.5, 24), [0, 0, 1])
    geometry = replace(flat, source=flat.source + height, detector=flat.detector + height)
    grid = clra.VolumeGrid(shape=(21, 9, 11), voxel_size=0.1)
    values = np.random.default_rng(4).uniform(size=grid.shape).astype(np.float32)
    parts = VolumeParts(tmp_path, grid, tuple(equal_runs(21, 3)))
    for index in range(3):
        parts.write_planes(index, values)
    read, get = [], VolumeParts.read
    monkeypatch.setattr(VolumeParts, "read", lambda *args: read.append(args[2]) or get(*args))
    kept = Store((24, 8, 16), stream.room)
    kept.write(0, np.full((24, 8, 16), np.nan, np.float32))
    monkeypatch.setattr(stream, "chunks", lambda views, size: equal_runs(views, -(-views // 5)))
    SlabProjector(stream, parts.volume(stream), geometry).project_all(stream, kept)
    assert read == [0, 1, 2]
    read.clear()
    project = SlabProjector(stream, parts.volume(stream), geometry)
    for views, part in project.in_chunks(stream, equal_runs(24, 6)):
        np.testing.assert_array_equal(stream.download(part), kept.read(views.start, views.stop))
    assert read == [0, 1, 2] and views.stop == 24
    expected = stream.empty((24, 8, 16))
    SlabProjector(stream, volume_from(stream, grid, values), geometry)(expected, slice(0, 24))
    expected = stream.download(expected)
    assert (expected == 0).all(axis=(1, 2)).any() and expected.any()
    np.testing.assert_allclose(kept.read(0, 24), expected, atol=1e-6 * expected.max())


def test_a_volume_of_one_value(stream):
    grid = clra.VolumeGrid(shape=SHAPE, voxel_size=1.0)
    volume = ConstantVolume(stream, grid, 0.5, volumes=stream.budgets.slab // (3 * 60))
    assert len(volume.planes) > 1
    np.testing.assert_array_equal(volume.to_host(), np.full(SHAPE, 0.5, np.float32))
