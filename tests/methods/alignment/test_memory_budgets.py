"""Alignments do not depend on how much memory they may take."""

import numpy as np
import pytest

import clra
from clra.app.simulation import paper_like, sample, simulated_scan

# Of shifts [pixel] where the volume is cut: sums along rays round differently then, and of any
# rounding registration in float32 makes as much for views at the ends, which see little.
SLABS = 1e-4


@pytest.fixture(scope="module")
def scan():
    geometry = paper_like("helix", 120, (48, 48))
    random = np.random.default_rng(3)
    truth = clra.Motion(
        shift_u=random.normal(0, 1, 120),
        shift_v=random.normal(0, 1, 120),
        magnification=np.ones(120),
    )
    return simulated_scan(geometry, sample("spheres", geometry), truth, name="helix")


def motion(scan, budget):
    options = {"schedule": "1HR", "quality": False, "max_device_memory": budget}
    return clra.align(scan, **options).motion


def test_neither_chunks_of_views_nor_slabs_change_an_alignment(scan):
    whole, chunks, slabs = (motion(scan, budget << 10) for budget in (200 << 10, 2 << 10, 384))
    for name in "shift_u", "shift_v", "magnification":
        assert np.array_equal(getattr(chunks, name), getattr(whole, name))
        assert np.abs(getattr(slabs, name) - getattr(whole, name)).max() < SLABS
