"""What a run costs: CPU by stage without compilation, memory, and the way to the first pose."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest
from numba import njit
from numba.core import event

from vislam.core import cpu
from vislam.core.clock import StageClock
from vislam.runs.cost import CostMeter, per_frame, whole_cost


@pytest.fixture
def now(monkeypatch):
    """A clock by hand: CPU seconds of this process, all of them of this thread."""
    spent = SimpleNamespace(s=100.0)
    monkeypatch.setattr(cpu.time, "thread_time", lambda: spent.s)
    monkeypatch.setattr(cpu.time, "process_time", lambda: spent.s)
    return spent


def step(t_s: float, has_pose: bool) -> SimpleNamespace:
    frame = SimpleNamespace(t_ns=round(t_s * 1e9))
    return SimpleNamespace(front=SimpleNamespace(frame=frame, T_odom_body=np.eye(4) if has_pose else None))


def test_a_stage_is_charged_for_its_cpu_without_compilation(now):
    clock, compiled_s = StageClock(), cpu.compile_cpu_s()
    with clock.measure("track"):
        now.s += 2.0
        with event.trigger_event("numba:compile"):
            now.s += 30.0
            with event.trigger_event("numba:compile"):  # of a function that the first one calls
                now.s += 40.0
    with clock.measure("track"):
        now.s += 1.0
    assert clock.summary_ms()["track"]["cpu_s"] == pytest.approx(3.0)
    assert clock.summary_ms()["track"]["count"] == 2
    assert cpu.compile_cpu_s() - compiled_s == pytest.approx(70.0)


def test_a_kernel_that_is_compiled_is_told_and_one_that_is_called_again_is_not():
    @njit
    def kernel(x):
        return x + 1.0

    before_s = cpu.compile_cpu_s()
    kernel(1.0)
    compiled_s = cpu.compile_cpu_s()
    kernel(2.0)
    assert compiled_s > before_s
    assert cpu.compile_cpu_s() == compiled_s


def test_threads_that_work_ahead_are_summed_by_stage():
    before_s = cpu.ahead_cpu_s().get("decode", 0.0)

    def work():
        with cpu.working_ahead("decode"):
            sum(range(200_000))

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert cpu.ahead_cpu_s()["decode"] > before_s


def test_the_first_pose_is_the_first_that_is_published(now):
    now.s = 7.0
    meter = CostMeter()
    before_s = 7.0 - cpu.compile_cpu_s()
    for t_s, has_pose in ((10.0, False), (10.5, False), (11.25, True), (12.0, True)):
        now.s += 1.0
        meter.take(step(t_s, has_pose))
    entry = meter.entry({"track": {"cpu_s": 2.5}})
    assert (entry["first_pose_s"], entry["first_pose_cpu_s"]) == pytest.approx((1.25, 3.0))
    assert entry["cpu_s"] == pytest.approx(4.0)
    assert entry["cpu_ms_per_frame"] == pytest.approx(1000.0)
    assert entry["stages_cpu_ms_per_frame"]["track"] == pytest.approx(625.0)
    assert sum(entry["stages_cpu_ms_per_frame"].values()) == pytest.approx(1000.0)
    assert entry["before_cpu_s"] == pytest.approx(before_s)
    assert entry["peak_memory_mb"] > 50.0


def test_a_run_without_a_frame_or_a_pose_has_no_number_for_them():
    meter = CostMeter()
    assert meter.entry({})["cpu_ms_per_frame"] is None
    meter.take(step(1.0, False))
    entry = meter.entry({})
    assert entry["first_pose_s"] is entry["first_pose_cpu_s"] is None
    assert per_frame(2.0, 4, {"a": 0.5}) == {
        "cpu_s": 2.0, "cpu_ms_per_frame": 500.0, "stages_cpu_ms_per_frame": {"a": 125.0, "other": 375.0},
    }  # fmt: skip


def test_a_live_run_costs_what_its_processes_do():
    spent = {"cpu_s": 3.0, "compile_cpu_s": 0.5, "peak_memory_mb": 200.0}
    notes = {"front": {"cost": spent}, "map": {"cost": spent, "found_in_map": True}, "world": {}}
    metrics = {
        "frames": 10, "timing_ms": {"track": {"cpu_s": 2.0}},
        "cost": {"cpu_s": 3.0, "first_pose_s": 0.25, "first_pose_cpu_s": 1.0, "before_cpu_s": 2.0},
    }  # fmt: skip
    cost = whole_cost(metrics, notes)
    assert (cost["cpu_s"], cost["compile_cpu_s"], cost["peak_memory_mb"]) == (6.0, 1.0, 400.0)
    assert cost["stages_cpu_ms_per_frame"] == {"track": 200.0, "other": 400.0}
    assert (cost["first_pose_s"], cost["first_pose_cpu_s"], cost["before_cpu_s"]) == (0.25, None, None)
    assert sorted(cost["processes"]) == ["front", "map"]
