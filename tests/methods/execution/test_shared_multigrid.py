"""Multigrid reconstruction by several workers gives what a single process gives."""

import os
import signal

import numpy as np
import pytest

import clra
from clra.errors import Cancelled

# Relative norm of volumes, with the motion known and with that found [pixel].
VOLUME, ALIGNED, MOTION = 1.5e-6, 3e-6, 2e-5


def apart(one, other):
    return np.linalg.norm(one - other) / np.linalg.norm(other)


def test_a_volume(client, few_views, tmp_path):
    options = {"motion": few_views.truth, "options": clra.Multigrid(cycles=2, passes=1)}
    alone = clra.reconstruct(few_views, "imgr", **options)
    assert apart(clra.reconstruct(few_views, "imgr", cluster=client, **options), alone) < VOLUME
    assert list(tmp_path.iterdir()) == []


def test_an_alignment_that_loses_a_worker_and_its_client(client, few_views, tmp_path):
    killed = []

    def disturb(progress):
        if progress.stage == "cycle 1, HR: simulating" and progress.done == 2 and not killed:
            killed.append(next(iter(client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)
        if progress.stage == "cycle 1, FR: correcting":
            raise Cancelled

    options = {"method": "imgr", "quality": False}
    alone = clra.align(few_views, **options)
    options |= {"cluster": client, "checkpoint": tmp_path / "kept"}
    with pytest.warns(clra.ClraWarning, match="it is that of cycle 1 up to HR"):
        early = clra.align(few_views, progress=disturb, **options)
    assert killed
    assert early.volume.shape == alone.volume.shape
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]
    stages = []
    again = clra.align(few_views, progress=lambda p: stages.append(p.stage), resume=True, **options)
    assert not any(stage.startswith("cycle 1, HR") for stage in stages)
    for one, other in zip(again.motion.columns(), alone.motion.columns(), strict=True):
        assert np.abs(one - other).max() < MOTION
    assert apart(again.volume, alone.volume) < ALIGNED
    assert [i.misfit for i in again.history] == pytest.approx([i.misfit for i in alone.history])
    assert list(tmp_path.iterdir()) == []
