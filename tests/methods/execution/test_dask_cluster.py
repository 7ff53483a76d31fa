"""Work shared out to the workers of a cluster gives what one process gives."""

import os
import signal
from dataclasses import replace

import numpy as np
import pytest

import clra
from clra.errors import Cancelled, ClusterError
from clra.methods.execution import worker_facts, worker_process
from clra.methods.execution.dask_cluster import DaskCluster
from clra.methods.execution.travelling import Shared, check_travels, read_task, write_task
from clra.model.grid import default_grid

distributed = pytest.importorskip("distributed")

# A volume in parts, and one that is reconstructed at once: at the detector's border rounding
# decides whether a single view sees a voxel.
VOLUME, VOXEL = 3e-6, 2e-4
# Motions of an alignment, after two levels [pixel].
MOTION = 1e-4


@pytest.fixture(scope="module")
def alone(scans):
    return {
        kind: clra.align(scan, schedule="1QR-1HR", quality=False) for kind, scan in scans.items()
    }


def errors(one, other):
    return max(float(np.abs(a - b).max()) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("method", ["fbp", "katsevich"])
def test_volumes(client, scans, method, tmp_path):
    motion = scans["helix"].truth
    shared = clra.reconstruct(scans["helix"], method, motion=motion, cluster=client)
    alone = clra.reconstruct(scans["helix"], method, motion=motion)
    assert np.linalg.norm(shared - alone) < VOLUME * np.linalg.norm(alone)
    assert np.abs(shared - alone).max() < VOXEL * np.abs(alone).max()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["helix", "space-filling"])
def test_alignments(client, scans, alone, kind, tmp_path):
    stages = []
    shared = clra.align(
        scans[kind],
        schedule="1QR-1HR",
        quality=False,
        cluster=client,
        progress=lambda p: stages.append(p.stage),
    )
    assert errors(shared.motion.columns(), alone[kind].motion.columns()) < MOTION
    np.testing.assert_array_equal(shared.valid_views, alone[kind].valid_views)
    assert "QR 1/1: registering" in stages
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("stage", ["QR 1/1: registering", "HR 1/1: correcting"])
def test_a_worker_that_is_killed(client, scans, alone, stage):
    killed = []

    def kill(progress):
        if progress.stage == stage and progress.done == 2 and not killed:
            (pid, *_) = client.run(os.getpid).values()
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)

    shared = clra.align(
        scans["helix"], schedule="1QR-1HR", quality=False, cluster=client, progress=kill
    )
    assert killed
    assert errors(shared.motion.columns(), alone["helix"].motion.columns()) < MOTION


def test_a_client_that_is_stopped_goes_on(client, scans, alone, tmp_path):
    def stop(progress):
        if progress.stage == "HR 1/1: correcting":
            raise Cancelled

    options = {"schedule": "1QR-1HR", "quality": False, "cluster": client}
    with pytest.warns(clra.ClraWarning, match="ended early, after 1 iteration"):
        clra.align(scans["helix"], checkpoint=tmp_path / "kept", progress=stop, **options)
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]
    stages = []
    again = clra.align(
        scans["helix"],
        checkpoint=tmp_path / "kept",
        resume=True,
        progress=lambda p: stages.append(p.stage),
        **options,
    )
    assert not any(stage.startswith("QR") for stage in stages)
    assert errors(again.motion.columns(), alone["helix"].motion.columns()) < MOTION


def test_a_cluster_is_started_for_a_call(scans):
    grid = default_grid(scans["helix"].geometry).slab(40, 44)
    shared = clra.reconstruct(scans["helix"], grid=grid, cluster="local:1")
    alone = clra.reconstruct(scans["helix"], grid=grid)
    np.testing.assert_array_equal(shared, alone)


def test_radiographs_in_memory_are_refused(client, scans):
    scan = scans["helix"]
    inside = clra.Scan(scan.read(0, scan.views), scan.geometry)
    for call in (clra.align, clra.reconstruct):
        with pytest.raises(clra.InputError, match=r"clra\.write_scan"):
            call(inside, cluster=client)


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda scan, on: clra.align(scan, method="reference", cluster=on), "found 'reference'"),
        (lambda scan, on: clra.align(scan, cluster="node1"), "expected ADDRESS"),
        (lambda scan, on: clra.align(scan, cluster=3), "expected a distributed"),
    ],
)
def test_what_a_cluster_does_not_do(client, scans, call, expected):
    with pytest.raises(clra.InputError, match=expected):
        call(scans["helix"], client)


# Tasks are functions inside others: these travel whole, workers cannot import a test's module.
def fails():
    def task(stream, item):
        raise OSError(28, "No space left on device")

    return task


def fails_at_first(path):
    def task(stream, item):
        if not path.exists():
            path.touch()
            raise OSError("a mount that was lost")
        return 2 * item

    return task


def warns():
    def task(stream, item):
        clra.Finding("test", "told by a task").warn()

    return task


@pytest.fixture
def cluster(client, tmp_path):
    executor = DaskCluster(client, tmp_path / "tasks")
    yield executor
    executor.close()


def test_a_task_that_fails_three_times(cluster):
    expected = r"writing: task 1 on worker .* failed 3 times: .*No space left"
    with pytest.raises(ClusterError, match=expected):
        cluster.map(fails(), [0], stage="writing")


def test_a_task_that_fails_once_is_done_again(cluster, tmp_path):
    assert cluster.map(fails_at_first(tmp_path / "failed"), [3, 4], stage="s") == [6, 8]


def test_findings_of_tasks_are_told(cluster):
    with pytest.warns(clra.ClraWarning, match="told by a task"):
        cluster.map(warns(), [0], stage="warning")


def test_results_keep_the_order_of_the_items(cluster):
    done = []
    results = cluster.map(lambda stream, item: item**2, range(9), stage="s", done=done.append)
    assert results == [item**2 for item in range(9)]
    assert sorted(done) == list(range(9))


def test_calls_that_are_a_stage_together(client, tmp_path):
    told = []
    executor = DaskCluster(client, tmp_path / "tasks", progress=told.append)
    told.clear()
    try:
        for part in ((0, 2), None, (1, 2)):
            executor.map(lambda stream, item: item, range(3), stage="s", part=part)
    finally:
        executor.close()
    assert {progress.total for progress in told} == {6}
    assert sorted({progress.done for progress in told}) == list(range(7))
    assert [progress.done for progress in told] == sorted(progress.done for progress in told)


def test_workers_share_the_cores(client, cluster):
    def cores(stream, item):
        return stream.device.max_compute_units, os.environ["POCL_MAX_PTHREAD_COUNT"]

    (units, asked) = cluster.map(cores, [0], stage="s")[0]
    assert int(asked) == max(1, len(os.sched_getaffinity(0)) // 2)
    if "PoCL" in cluster.map(lambda s, _: s.device.platform.version, [0], stage="s")[0]:
        assert units == int(asked)


@pytest.mark.parametrize(
    ("failure", "error", "expected"),
    [
        ("no OpenCL device", clra.DeviceError, "no worker with a device: worker tcp.*no OpenCL"),
        ("it does not see {token}", clra.InputError, "expected a folder that all workers share"),
    ],
)
def test_no_worker_can_work(client, monkeypatch, tmp_path, failure, error, expected):
    def facts(neighbours, token):
        return worker_facts.WorkerFacts("node", failure=failure.format(token=token))

    monkeypatch.setattr(worker_facts, "facts", facts)
    with pytest.raises(error, match=expected):
        DaskCluster(client, tmp_path / "tasks")
    assert not (tmp_path / "tasks").exists()


def test_a_worker_without_a_device_gets_no_tasks(client, monkeypatch, tmp_path):
    def facts(neighbours, token):
        found = worker_process.facts(neighbours, token)
        return replace(found, failure="none") if distributed.get_worker().name == 1 else found

    monkeypatch.setattr(worker_facts, "facts", facts)
    with pytest.warns(clra.ClraWarning, match="worker tcp.*: none: the others do its work"):
        executor = DaskCluster(client, tmp_path / "tasks")
    try:
        names = executor.map(lambda s, _: distributed.get_worker().name, range(4), stage="s")
    finally:
        executor.close()
    assert (executor.places, set(names)) == (1, {0})


def test_a_task_takes_the_gpu_that_its_worker_was_started_with(tmp_path):
    """Workers of several threads do not pile tasks up, which wait for one device."""

    def running(stream, item):
        worker = distributed.get_worker()
        return worker.state.executing_count, dict(worker.state.available_resources)

    with (
        distributed.LocalCluster(
            n_workers=1,
            threads_per_worker=4,
            resources={"GPU": 1},
            memory_limit=None,
            dashboard_address=":0",
            local_directory=str(tmp_path / "dask"),
        ) as local,
        distributed.Client(local, set_as_default=False) as client,
    ):
        executor = DaskCluster(client, tmp_path / "tasks")
        found = executor.map(running, range(6), stage="s")
        executor.close()
    assert found == 6 * [(1, {"GPU": 0})]


def test_a_scan_travels_as_paths(scans, tmp_path):
    scan = scans["helix"]
    write_task(tmp_path / "task", scan)
    assert (tmp_path / "task").stat().st_size < 2e-2 * 4 * np.prod(scan.shape)
    np.testing.assert_array_equal(read_task(tmp_path / "task").read(3, 9), scan.read(3, 9))
    write_task(tmp_path / "some", scan.subset(slice(5, 9)))
    np.testing.assert_array_equal(Shared(tmp_path / "some").get().read(0, 4), scan.read(5, 9))


def test_a_memory_map_travels_as_a_place(scans, tmp_path):
    scan = scans["helix"]
    stored = np.memmap(tmp_path / "raw", np.float32, "w+", 64, scan.shape)
    stored[:] = scan.read(0, scan.views)
    stored.flush()
    part = clra.Scan(stored[7:20], scan.geometry.subset(slice(7, 20)))
    check_travels(part)
    write_task(tmp_path / "task", part)
    assert (tmp_path / "task").stat().st_size < 1e4
    np.testing.assert_array_equal(read_task(tmp_path / "task").read(2, 5), stored[9:12])
