"""Rigid motion that several workers look for is the one that a single process finds."""

import importlib
import os
import signal

import numpy as np
import pytest
from rigid_samples import moved_scan

import clra
from clra.errors import Cancelled
from clra.methods.alignment.rigid import rigid_alignment
from clra.ops.runtime.devices import choose_device

# Of shifts [pixel] and rotations [rad], and of standard errors a part of them.
SHIFT, ANGLE, SIGMA = 2e-5, 3e-7, 6e-6


@pytest.fixture(scope="module", autouse=True)
def _three_iterations():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rigid_alignment, "rigid_stages", lambda shape: ((2, 2), (1, 1)))
        yield


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    path = tmp_path_factory.mktemp("rigid") / "scan.nxs"
    clra.write_scan(path, moved_scan([1.5, 1.5, 0.5, *np.radians([0.4, 0.4, 0.4])])[0])
    return clra.read_scan(path)


def aligned(scan, **options):
    return clra.align(scan, estimate="rigid", schedule="1HR", quality=False, **options)


@pytest.fixture(scope="module")
def alone(scan):
    return aligned(scan)


def assert_same(one, other):
    for name, most in (("shift_u", SHIFT), ("shift_v", SHIFT), ("rotation", ANGLE)):
        apart = getattr(one.motion, name) - getattr(other.motion, name)
        assert np.abs(apart).max() < most, name
    np.testing.assert_allclose(one.sigma, other.sigma, rtol=SIGMA)
    np.testing.assert_array_equal(one.valid_views, other.valid_views)


def test_on_a_cluster_that_loses_a_worker_and_its_client(client, scan, alone, tmp_path):
    killed = []

    def disturb(progress):
        if progress.stage == "HR, rigid 2/2: registering" and progress.done == 2 and not killed:
            killed.append(next(iter(client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)
        if progress.stage == "FR, rigid 1/1: registering":
            raise Cancelled

    options = {"cluster": client, "checkpoint": tmp_path / "kept"}
    with pytest.warns(clra.ClraWarning, match="ended early, after 3 iterations, the last at HR"):
        aligned(scan, progress=disturb, **options)
    assert killed
    stages = []
    again = aligned(scan, progress=lambda p: stages.append(p.stage), resume=True, **options)
    assert not any(stage.startswith("HR") for stage in stages)
    assert_same(again, alone)
    assert list(tmp_path.iterdir()) == []


def test_on_several_devices(scan, alone, monkeypatch):
    device = choose_device()
    align = importlib.import_module("clra.methods.alignment.align")
    monkeypatch.setattr(align, "usable_devices", lambda *_: [device, device])
    assert_same(aligned(scan), alone)
