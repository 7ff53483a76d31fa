"""Radiographs that several workers correct are, to the bit, those that one process corrects."""

from dataclasses import replace

import numpy as np
import pytest

import clra
from clra.methods import correction
from clra.methods.alignment.result import AlignmentResult
from clra.ops.runtime.devices import choose_device

REJECTED = 4


@pytest.fixture
def scan(scans):
    mask = np.ones(scans["helix"].geometry.shape, np.bool_)
    mask[20:30, 40] = False  # interpolated from beside
    return replace(scans["helix"].subset(slice(0, 31)), mask=mask)


@pytest.fixture
def alignment(scan):
    valid_views = np.arange(scan.views) != REJECTED
    sigma = np.zeros((scan.views, 3))
    return AlignmentResult(
        motion=scan.truth, valid_views=valid_views, confidence=np.ones(scan.views), sigma=sigma
    )


def assert_same(scan, alignment, corrected, path):
    written = []
    assert corrected.views == scan.views - 1
    clra.write_scan(path, corrected, progress=written.append)
    assert [p.done for p in written] == sorted(p.done for p in written)
    assert written[-1].done == written[-1].total
    assert {p.stage for p in written} == {"correcting"}  # not "writing", by this process
    expected = clra.correct(scan, alignment)
    found = clra.read_scan(path)
    np.testing.assert_array_equal(found.read(0, found.views), expected.read(0, found.views))
    np.testing.assert_array_equal(corrected.read(3, 5), expected.read(3, 5))
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_on_a_cluster(client, scan, alignment, tmp_path):
    corrected = clra.correct(scan, alignment, cluster=client)
    assert_same(scan, alignment, corrected, tmp_path / "corrected.nxs")


def test_on_several_devices(scan, alignment, monkeypatch, tmp_path):
    device = choose_device()
    monkeypatch.setattr(correction, "usable_devices", lambda _: [device, device])
    corrected = clra.correct(scan, alignment, "all")
    monkeypatch.undo()
    assert_same(scan, alignment, corrected, tmp_path / "corrected.nxs")
