"""A reconstruction shared out to several devices is the one that a single device makes."""

import os
import subprocess
import sys

import pytest

import clra
from clra.methods.execution.executor import reconstruct_planes
from clra.methods.execution.several_devices import SeveralDevices
from clra.ops.runtime.devices import choose_device

TWICE = """
import sys
import numpy as np
import clra
from clra.app.simulation import paper_like, sample, simulated_scan
from clra.methods.execution import several_devices
from clra.ops.runtime.devices import usable_devices

devices = usable_devices("all")
if len(devices) < 2:
    print("one device")
    sys.exit()
geometry = paper_like("helix", 320, (64, 64))
truth = clra.Motion.identity(320)
scan = simulated_scan(geometry, sample("spheres", geometry), truth, name="shared")
worked = set()
run = several_devices._Worker.run


def watched(self, *rest):
    worked.add(self.stream.device.int_ptr)
    run(self, *rest)


several_devices._Worker.run = watched
for method in ("fbp", "katsevich"):
    progress = []
    shared = clra.reconstruct(scan, method, device="all", progress=progress.append)
    alone = clra.reconstruct(scan, method)
    assert np.linalg.norm(shared - alone) < 1e-5 * np.linalg.norm(alone), method
    assert (shared != 0).any(axis=(1, 2)).sum() > 10
    progress = [p for p in progress if p.stage == progress[-1].stage]
    assert [p.done for p in progress] == sorted(p.done for p in progress)
    assert progress[-1].done == progress[-1].total
options = clra.OrderedSubsets(passes=1, subsets=4)
progress = []
call = {"method": "osem-tr", "options": options}
shared = clra.reconstruct(scan, device="all", progress=progress.append, **call)
alone = clra.reconstruct(scan, **call)
assert np.linalg.norm(shared - alone) < 1e-6 * np.linalg.norm(alone)
done = [p.done / p.total for p in progress if p.stage == "OSEM-TR: pass 1/1"]
assert done == sorted(done) and done[-1] == 1
few = scan.subset(slice(None, None, 4))
shared, alone = (clra.align(few, method="imgr", device=d, quality=False) for d in ("all", None))
assert np.linalg.norm(shared.volume - alone.volume) < 1e-5 * np.linalg.norm(alone.volume)
shared = clra.align(scan, schedule="1QR-1HR", device="all", quality=False)
alone = clra.align(scan, schedule="1QR-1HR", quality=False)
for one, other in zip(shared.motion.columns(), alone.motion.columns()):
    assert abs(one - other).max() < 1e-4
assert worked == {device.int_ptr for device in devices}
print("shared by", len(worked))
"""


def test_two_devices_share_the_work():
    environment = {**os.environ, "POCL_DEVICES": "pthread pthread"}
    done = subprocess.run(
        [sys.executable, "-c", TWICE], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    if done.stdout.strip() == "one device":
        pytest.skip("no driver that shows two devices")
    assert done.stdout.strip() == "shared by 2"


def test_the_first_failure_is_told(tmp_path):
    def work(stream, planes, target):
        raise ValueError(f"plane {planes.start}")

    device = choose_device()
    with pytest.raises(ValueError, match="plane"):
        several = SeveralDevices([device, device], tmp_path)
        reconstruct_planes(several, work, (7, 1, 1), None, stage="s")


def test_every_plane_is_taken_once(tmp_path):
    taken = []

    class Target:
        def write(self, start, planes):
            taken.append((start, len(planes)))

    def work(stream, planes, target):
        for plane in range(planes.stop - planes.start):
            target.write(plane, [None])

    device = choose_device()
    executor = SeveralDevices([device, device, device], tmp_path)
    reconstruct_planes(executor, work, (23, 1, 1), Target(), stage="s")
    assert sorted(taken) == [(plane, 1) for plane in range(23)]


def test_findings_of_all_devices_are_told(tmp_path):
    def task(stream, item):
        clra.Finding("test", f"told by task {item}").warn()

    device = choose_device()
    executor = SeveralDevices([device, device], tmp_path)
    with pytest.warns(clra.ClraWarning) as told:
        executor.map(task, range(5), stage="s")
    assert {str(warning.message) for warning in told} == {f"told by task {n}" for n in range(5)}
    assert all(warning.filename == __file__ for warning in told)


def test_what_tasks_leave_is_removed(tmp_path):
    folder = tmp_path / "tasks"
    executor = SeveralDevices([choose_device()], folder)
    executor.new_folder("volume").joinpath("slab").touch()
    executor.close()
    assert not folder.exists()
