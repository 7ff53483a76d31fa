"""Integers whose limits are percentiles of a volume that does not fit into memory."""

import tracemalloc

import numpy as np

from clra.io.volumes.volume_files import open_volume, read_volume
from clra.model.grid import VolumeGrid

SHAPE = (64, 256, 256)  # 16 MiB
WITHIN = 10 << 20


def test_percentiles_hold_parts_of_a_volume_only(tmp_path):
    grid = VolumeGrid(shape=SHAPE, voxel_size=1.0)
    plane = np.linspace(1, 3, 256 * 256, dtype=np.float32).reshape(1, 256, 256)
    tracemalloc.start()
    try:
        with open_volume(tmp_path / "v.raw", grid, dtype="uint16") as writer:
            for k in range(SHAPE[0]):
                writer.write(k, plane)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < WITHIN
    # The limits are those of each second row, and values beyond are clipped.
    np.testing.assert_allclose(read_volume(tmp_path / "v.raw", 40, 41)[0], plane, atol=0.01)
