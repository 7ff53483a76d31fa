"""Plans of work on a cluster follow from what is simulated."""

from dataclasses import replace

import pytest

from clra.app.planning.cluster_plan import Site, plans, simulated
from clra.app.planning.live_workers import live_workers
from clra.app.planning.plan_table import plan_table
from clra.app.planning.planned_steps import PlannedStep, Workers
from clra.app.simulation import paper_like
from clra.app.speed import Speed
from clra.errors import InputError
from clra.ops.runtime.devices import choose_device
from clra.ops.streaming.memory import Budgets

SPEED = Speed("a device", None, back=1e-9, forward=2e-9, filtering=1e-8, registering=3e-8)
FREE = Site(file_system=1e30, link=1e30, start_s=0.0, begin_s=0.0, task_s=0.0, view_s=0.0)


def workers(count, **changes):
    return Workers(count, SPEED, 1e9, **changes)


@pytest.mark.parametrize(("count", "expected"), [(1, 60.0), (4, 20.0), (6, 10.0), (9, 10.0)])
def test_tasks_of_a_step_are_taken_in_turns(count, expected):
    # six tasks of ten seconds: four workers need two turns
    assert simulated([PlannedStep("s", 6, 60.0, 0, 0)], workers(count), FREE) == pytest.approx(
        expected
    )


def test_steps_wait_for_each_other():
    steps = [PlannedStep("a", 3, 30.0, 0, 0), PlannedStep("b", 3, 3.0, 0, 0)]
    assert simulated(steps, workers(2), FREE) == pytest.approx(20 + 2)


def test_the_file_system_is_shared():
    step = PlannedStep("read", 8, 0.0, 8e9, 0.0)
    site = replace(FREE, file_system=2e9, link=1e9)
    assert simulated([step], workers(1), site) == pytest.approx(8)
    assert simulated([step], workers(2), site) == pytest.approx(4)
    assert simulated([step], workers(8), site) == pytest.approx(4)


def test_the_client_hands_tasks_out_one_by_one():
    site = replace(FREE, task_s=0.5)
    assert simulated([PlannedStep("s", 8, 0.0, 0, 0)], workers(8), site) == pytest.approx(4)


def test_what_the_host_does_takes_longer_where_cores_are_shared():
    site = replace(FREE, begin_s=0.5)
    step = PlannedStep("s", 4, 40.0, 0, 0)
    assert simulated([step], workers(4, slowdown=3.0), site) == pytest.approx(10 + 1.5)


def test_plans_of_a_scan():
    geometry = paper_like("helix", 400, (128, 128))
    one, many = (plans(geometry, workers(n), FREE) for n in (1, 8))
    names = ["fbp, full resolution", "osem-tr, full resolution", "align, 4ER-2QR-2HR"]
    assert [plan.work for plan in one] == names
    for alone, shared in zip(one, many, strict=True):
        assert alone.efficiency == pytest.approx(1, abs=0.02)
        # radiographs that several slabs see are read and filtered for each
        assert alone.seconds / 8 < shared.seconds < alone.seconds
        assert shared.efficiency == pytest.approx(alone.seconds / 8 / shared.seconds, rel=0.02)
        assert shared.read_bytes > alone.read_bytes
    slow = plans(geometry, workers(8), replace(FREE, file_system=1e6))
    assert {plan.limit for plan in slow} == {"file system"}


def test_workers_are_read():
    speed = replace(SPEED, budgets=Budgets.of(choose_device(), 1 << 30, 4 << 30))
    assert Workers.parse("3", speed) == Workers(3, speed, speed.budgets.slab)
    assert Workers.parse("2xdevice", speed).speed is speed
    assert Workers.parse("8xGPU", speed).speed.device == "a GPU, predicted"
    for wrong in ("0", "x4", "4xfoo", "many"):
        with pytest.raises(InputError, match="--cluster"):
            Workers.parse(wrong, speed)


def test_workers_that_are_there_are_tested(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    geometry = paper_like("helix", 400, (128, 128))
    found = live_workers("local:1", geometry, max_device_memory=60 << 20)
    assert found.count == 1 and found.slab_bytes <= 20 << 20 and found.slowdown >= 0.9
    assert found.speed.device == choose_device().name.strip()
    assert all(seconds > 0 for seconds in (found.speed.back, found.speed.registering))
    assert list(tmp_path.iterdir()) == []


def test_a_table_says_what_it_assumes():
    geometry = paper_like("helix", 400, (128, 128))
    text = plan_table(plans(geometry, workers(8)), workers(8))
    assert "8 workers" in text and "2 GB/s" in text and "limited by" in text
