"""Radiographs and volumes in files of several workers."""

import numpy as np
import pytest

import clra
from clra.ops.streaming import part_files
from clra.ops.streaming.part_files import RadiographParts, VolumeParts
from clra.ops.streaming.stream import Stream
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
