"""Radiographs of one resolution are those of the scan, and read as often as they should be."""

import numpy as np
import pytest

import clra
from clra.app.simulation import paper_like
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

VIEWS, SIDE = 12, 16


class Counting:
    """Projections that count how often each view is read."""

    def __init__(self):
        self.images = np.random.default_rng(1).random((VIEWS, SIDE, SIDE), np.float32)
        self.shape = self.images.shape
        self.read = np.zeros(VIEWS, int)

    def __getitem__(self, index):
        self.read[index] += 1
        return self.images[index]


@pytest.mark.parametrize(("level", "keep", "times"), [(1, False, 3), (1, True, 1), (2, False, 1)])
def test_each_view_is_read_once_where_it_is_kept(level, keep, times):
    pixels = Counting()
    scan = clra.Scan(pixels, paper_like("circular", VIEWS, (SIDE, SIDE)))
    radiographs = Radiographs(Stream(), scan, level, keep=keep)
    binned = pixels.images.reshape(VIEWS, SIDE // level, level, SIDE // level, level)
    for _ in range(3):
        found = radiographs.read(slice(3, 7))
        np.testing.assert_allclose(found, binned.mean(axis=(2, 4))[3:7], rtol=1e-6)
    np.testing.assert_array_equal(pixels.read[3:7], times)
