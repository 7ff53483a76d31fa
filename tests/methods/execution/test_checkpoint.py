"""Interruptions of any kind: what is kept, and how a call goes on from it."""

import errno
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import clra
from clra.app.simulation import paper_like, sample, simulated_motion, simulated_scan
from clra.errors import Cancelled, ClraWarning, InputError
from clra.findings import Finding, collected
from clra.methods.execution.checkpoint import Checkpoint
from clra.methods.reconstruction.iterative import Multigrid
from clra.methods.reconstruction.osem_tr import OrderedSubsets
from clra.model.scan import Scan
from clra.ops.streaming.slab_projector import volume_from
from clra.ops.streaming.stream import Stream
from clra.progress import Progress

GRID = clra.VolumeGrid(shape=(3, 4, 5), voxel_size=0.5)
VALUES = {"done": 1}
OSEM = OrderedSubsets(passes=3, subsets=3)


@pytest.fixture(scope="module")
def scan() -> Scan:
    geometry = paper_like("space-filling", 24, (41, 33))
    truth = simulated_motion("random", geometry, shift=(-2.0, 2.0), magnification=0.001)
    return simulated_scan(geometry, sample("spheres", geometry), truth, name="tiny")


class Stop:
    """A progress callback that raises once so many states are kept, before the next is."""

    def __init__(self, folder: Path, kept: int, error: BaseException) -> None:
        self.folder, self.kept, self.error = folder, kept, error

    def __call__(self, progress: Progress) -> None:
        if (self.folder / f"{self.kept}.npz").exists():
            raise self.error


def test_a_state_is_kept_whole_and_read_back(tmp_path: Path) -> None:
    stream, values = Stream(), np.arange(60, dtype=np.float32).reshape(GRID.shape)
    kept = Checkpoint(tmp_path / "c")
    assert kept.begin({"scan": "a"}) is None and not kept.there
    with collected():
        with pytest.warns(ClraWarning, match="few features"):
            Finding("lost", "few features").warn()
        kept.save("1 step", {"done": 1}, {"shift": np.arange(3.0)})
        kept.save("2 steps", {"done": 2}, {"shift": np.ones(2)}, volume_from(stream, GRID, values))
    assert sorted(p.name for p in kept.folder.iterdir()) == ["2.npy", "2.npz", "state.json"]
    with pytest.warns(ClraWarning, match="few features"):  # it is a finding of this run, too
        saved = Checkpoint(tmp_path / "c", resume=True).begin({"scan": "a"})
    assert saved is not None
    assert saved.kept == kept.kept == "2 steps" and saved.values == {"done": 2}
    assert saved.arrays["shift"].tolist() == [1, 1]
    np.testing.assert_array_equal(saved.planes, values)
    kept.clear()
    assert not list(tmp_path.iterdir())


def test_another_scan_or_a_damaged_state_is_not_gone_on_with(tmp_path: Path) -> None:
    kept = Checkpoint(tmp_path / "c")
    kept.begin({"scan": "a", "levels": "HR"})
    kept.save("1 step", VALUES, {})
    again = Checkpoint(tmp_path / "c", resume=True)
    with pytest.raises(InputError, match=r"state.json: levels: found 'HR', expected 'FR' as now"):
        again.begin({"scan": "a", "levels": "FR"})
    for path in (tmp_path / "c" / "1.npz", tmp_path / "c" / "state.json"):
        path.write_bytes(path.read_bytes()[:-7])
        with pytest.raises(InputError, match="no state that clra kept"):
            again.begin({"scan": "a", "levels": "HR"})
    with pytest.raises(InputError, match="not found, expected what an interrupted run leaves"):
        Checkpoint(tmp_path / "none", resume=True).begin({})


def test_a_run_that_does_not_resume_replaces_what_is_there_and_says_so(tmp_path: Path) -> None:
    first = Checkpoint(tmp_path)
    first.begin({})
    first.save("7 steps", VALUES, {})
    second = Checkpoint(tmp_path)
    with pytest.warns(ClraWarning, match="keeps 7 steps of an earlier run"):
        second.begin({})
    assert (tmp_path / "1.npz").exists()  # until there is something in its place
    second.save("1 step", VALUES, {})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["2.npz", "state.json"]


def test_where_the_disk_is_full_the_state_before_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = Checkpoint(tmp_path / "c")
    kept.begin({})
    kept.save("1 step", VALUES, {})

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.warns(ClraWarning, match="cannot keep 2 steps: No space left.* but for 1 step"):
        kept.save("2 steps", VALUES, {})
    assert sorted(p.name for p in kept.folder.iterdir()) == ["1.npz", "state.json"]
    saved = Checkpoint(tmp_path / "c", resume=True).begin({})
    assert saved is not None and saved.kept == "1 step"


@pytest.mark.parametrize("method", ["ra", "imgr"])
def test_an_alignment_that_failed_goes_on(scan: Scan, tmp_path: Path, method: str) -> None:
    options = {"method": method, "schedule": "2HR-2FR" if method == "ra" else "HR-FR"}
    folder = tmp_path / "c"
    whole = clra.align(scan, **options)
    with pytest.raises(MemoryError):
        clra.align(scan, **options, checkpoint=folder, progress=Stop(folder, 1, MemoryError()))
    again = clra.align(scan, **options, checkpoint=folder, resume=True)
    assert not folder.exists()
    levels = [step.level for step in again.history]
    assert levels == [step.level for step in whole.history]
    assert again.history[0].update_max == pytest.approx(whole.history[0].update_max, rel=1e-5)
    if method == "imgr":  # whose state is all of it
        assert again.motion == whole.motion
        np.testing.assert_array_equal(again.volume, whole.volume)
    else:  # extrapolation begins anew
        apart = np.abs(again.motion.shift_u - whole.motion.shift_u)
        assert np.median(apart) < 0.05


def test_an_alignment_is_cancelled_with_what_is_finished(scan: Scan, tmp_path: Path) -> None:
    folder = tmp_path / "c"
    stop = Stop(folder, 2, Cancelled())
    with pytest.warns(ClraWarning, match="ended early, after 2 iterations, the last at HR"):
        result = clra.align(scan, schedule="4HR", checkpoint=folder, progress=stop)
    assert len(result.history) == 2 and [f.code for f in result.warnings] == ["cancelled"]
    two = clra.align(scan, schedule="2HR")
    np.testing.assert_allclose(result.motion.shift_u, two.motion.shift_u, atol=1e-3)
    assert len(clra.align(scan, schedule="4HR", checkpoint=folder, resume=True).history) == 4

    def at_once(progress: Progress) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        clra.align(scan, schedule="1HR", progress=at_once)


@pytest.mark.parametrize(("method", "options"), [("osem-tr", OSEM), ("imgr", Multigrid(cycles=2))])
def test_a_reconstruction_that_failed_goes_on_to_the_bit(
    scan: Scan, tmp_path: Path, method: str, options: OrderedSubsets
) -> None:
    folder = tmp_path / "c"
    call = {"method": method, "motion": scan.truth, "options": options}
    whole = clra.reconstruct(scan, **call)
    stop = Stop(folder, 2, RuntimeError("a callback failed"))
    with pytest.raises(RuntimeError, match="a callback failed"):
        clra.reconstruct(scan, **call, checkpoint=folder, progress=stop)
    with pytest.raises(InputError, match=r"state.json: background: found 0.0, expected 3.0"):
        changed = {**call, "options": replace(options, background=3.0)}
        clra.reconstruct(scan, **changed, checkpoint=folder, resume=True)
    again = clra.reconstruct(scan, **call, checkpoint=folder, resume=True)
    np.testing.assert_array_equal(again, whole)
    assert not folder.exists()


def test_a_reconstruction_is_cancelled_with_what_is_finished(scan: Scan, tmp_path: Path) -> None:
    folder = tmp_path / "c"
    call = {"method": "osem-tr", "motion": scan.truth}
    stop = Stop(folder, 1, Cancelled())
    with pytest.warns(ClraWarning, match="ended early, after 1 of 3 passes"):
        volume = clra.reconstruct(scan, **call, options=OSEM, checkpoint=folder, progress=stop)
    one = clra.reconstruct(scan, **call, options=replace(OSEM, passes=1))
    np.testing.assert_allclose(volume, one, atol=1e-5 * one.max())
    stop = Stop(tmp_path / "i", 1, Cancelled())
    with pytest.warns(ClraWarning, match="ended early: it is that of cycle 1 up to QR"):
        coarse = clra.reconstruct(scan, method="imgr", checkpoint=tmp_path / "i", progress=stop)
    fine = clra.reconstruct(scan, method="imgr")
    assert coarse.shape == fine.shape and np.corrcoef(coarse.ravel(), fine.ravel())[0, 1] > 0.8


def test_nothing_to_resume_is_refused(scan: Scan, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="resume: found no checkpoint"):
        clra.align(scan, resume=True)
    with pytest.raises(InputError, match="resume: found it with fbp alone"):
        clra.reconstruct(scan, checkpoint=tmp_path / "c", resume=True)
    with pytest.raises(InputError, match="none, expected one to go on from"):
        clra.reconstruct(scan, align=True, checkpoint=tmp_path / "c", resume=True)


KILLED = """
import os, signal, sys
from pathlib import Path
import clra
folder, scan = Path(sys.argv[1]), clra.read_scan(sys.argv[2])
def progress(told):
    if (folder / "2.npz").exists():
        os.kill(os.getpid(), signal.SIGKILL)
clra.align(scan, schedule="4HR", checkpoint=folder, progress=progress)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL on this system")
def test_a_killed_alignment_goes_on(scan: Scan, tmp_path: Path) -> None:
    path, folder = tmp_path / "scan.nxs", tmp_path / "c"
    clra.write_scan(path, scan)
    done = subprocess.run([sys.executable, "-c", KILLED, folder, path], check=False)
    assert done.returncode == -signal.SIGKILL
    result = clra.align(clra.read_scan(path), schedule="4HR", checkpoint=folder, resume=True)
    assert [step.iteration for step in result.history] == [1, 2, 3, 4]
    whole = clra.align(clra.read_scan(path), schedule="4HR")
    apart = np.abs(result.motion.shift_v - whole.motion.shift_v)
    assert np.median(apart) < 0.05
