"""Whole live runs in real processes, on simulated vision played in real time; nothing here asserts how long it took."""

import atexit
import errno
import json
import os
import signal
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import pytest
from live_runs import FILES, PATIENCE_S, WORLD, Notes, has_map, interrupt, left_behind, settings, status, until

from vislam.config import load
from vislam.core.errors import HardwareError, TrackingLostError, UsageError, VislamError
from vislam.core.log import log_to
from vislam.hw.chips import BusError
from vislam.hw.health import Health
from vislam.hw.imu_source import InertialSource
from vislam.live import run_live
from vislam.live.processes import child
from vislam.live.replay import Outages, ReplaySource
from vislam.live.run_live import LiveRun
from vislam.runs.folder import prepare
from vislam.runs.session import Session
from waiting import HUNG_S


def start(tmp_path: Path, name: str, source: type[ReplaySource] = ReplaySource) -> tuple[LiveRun, Path]:
    out = tmp_path / name
    prepare(out, overwrite=False)
    return LiveRun(source(WORLD), settings(name), out, WORLD, ["vislam", "live"]), out


def lingering(open_source: Callable[[], InertialSource]) -> InertialSource:
    """Open a source in a process that will not leave, as one whose library waits for a thread of its own."""
    atexit.register(time.sleep, HUNG_S)
    return open_source()


class Lingering(ReplaySource):
    def inertial(self) -> Callable[[], InertialSource]:
        return partial(lingering, super().inertial())


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict, list[Health]]:
    """A run to its end in which the IMU and then the camera are unplugged, and the health that was seen on the way.

    Its processes are spawned, as outside of tests, and the fast one does not leave by itself.
    """
    out = tmp_path_factory.mktemp("live") / "whole"
    prepare(out, overwrite=False)
    source = Lingering(WORLD, outages=Outages(imu=((8.0, 9.0),), camera=((11.0, 13.0),)))
    live = LiveRun(source, settings("whole", dense=True), out, WORLD, ["vislam", "live"])
    live.notes = Notes()
    lasted_16_s = until(lambda run: status(run).get("samples", 0) > 3000 and has_map(run), LiveRun.stop)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(child, "get_context", get_context)
        patch.setattr(run_live, "_TAKING_APART_S", 0.1)
        metrics = live.execute(lasted_16_s, PATIENCE_S)
    assert left_behind("whole") == []
    return out, metrics, live.notes.health


def test_a_live_run_leaves_the_folder_of_a_run(finished) -> None:
    out, metrics, _ = finished
    assert {path.name for path in out.iterdir()} >= FILES
    assert json.loads((out / "metrics.json").read_text())["frames"] == metrics["frames"] > 10
    assert metrics["keyframes"] >= 3
    assert metrics["counters"]["camera"]["captured"] >= metrics["frames"]
    stored = Session(out / "session.db")
    try:
        assert stored.info()["finished"]
        assert len(stored.frames()) == metrics["frames"]
    finally:
        stored.close()


def test_it_finds_the_trajectory(finished) -> None:
    _, metrics, _ = finished
    assert metrics["initialisation"]["status"] != "none"
    times = 1.0 if metrics["frames"] > 60 else 10.0  # a machine too slow for most of the 140 frames dead-reckons
    assert metrics["accuracy"]["graph"]["ate_rmse_m"] < 0.25 * times
    assert metrics["accuracy"]["live"]["ate_rmse_m"] < 0.5 * times


def test_no_sample_is_lost_on_the_way_to_vision(finished) -> None:
    """What the fast process read, the front half has; camera frames may be dropped, and are counted."""
    _, metrics, _ = finished
    assert metrics["counters"]["imu"]["samples"] == metrics["live"]["counters"]["sensor_samples"] > 500
    assert metrics["live"]["latency_ms"]["count"] == metrics["live"]["counters"]["samples"]
    assert set(metrics["cost"]["processes"]) == {"fast", "front", "back", "map"}
    assert metrics["cost"]["cpu_s"] == pytest.approx(sum(c["cpu_s"] for c in metrics["cost"]["processes"].values()))
    assert metrics["cost"]["stages_cpu_ms_per_frame"]["other"] > 0.0


def test_unplugged_sensors_degrade_and_come_back(finished) -> None:
    _, metrics, seen = finished
    assert any(Health.IMU_MISSING in h and Health.INVALID in h for h in seen)
    assert any(Health.DEAD_RECKONING in h for h in seen)
    assert metrics["counters"]["imu"]["gaps"] == 1
    assert Health.LEVELLED in seen[-1]


def test_an_interrupt_ends_it_cleanly_without_what_takes_time(interrupted) -> None:
    out, metrics = interrupted
    assert metrics["frames"] > 0
    assert {path.name for path in out.iterdir()} >= FILES
    assert not (out / "map").exists()


def test_an_interrupt_does_not_wait_for_a_slow_end_and_the_session_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_live, "_BRIEF_S", 0.0)
    live, out = start(tmp_path, "hurried")
    with pytest.raises(KeyboardInterrupt):
        live.execute(until(has_map, interrupt), PATIENCE_S)
    assert live.is_brief and not (out / "metrics.json").exists()
    assert left_behind("hurried") == []
    with closing(Session(out / "session.db")) as session:
        assert len(session.factor_log().keyframes) > 0


@pytest.mark.parametrize("role", ["fast", "back", "map"])
def test_a_killed_process_ends_the_run_with_its_name(role: str, tmp_path: Path) -> None:
    """That of the front process stands among runs that go on."""
    live, out = start(tmp_path, role)

    def kill(run: LiveRun) -> None:
        process = run.processes()[role]
        if status(run).get("map_revision", 0) >= 1 and process.is_alive():
            process.kill()

    with pytest.raises(HardwareError, match=f"the {role} process was killed by signal 9"):
        live.execute(kill, PATIENCE_S)
    assert (out / "session.db").is_file()
    if role != "map":
        assert (out / "metrics.json").is_file()
    assert left_behind(role) == []


def test_what_a_process_raises_comes_home_whole(tmp_path: Path) -> None:
    """One camera without motion never sees scale: the front half gives up, as in a run of a recording."""
    out = tmp_path / "run"
    prepare(out, overwrite=False)
    world = f"points:still,rig=mono,camera_hz=10,duration_s={PATIENCE_S:g}"
    never_at_rest = {"view.enabled": False, "init.give_up_s": 2.0, "init.rest_s": 100.0}
    live_settings = load(None, never_at_rest | {"live.name": f"vislam-test-mono-{os.getpid()}"})
    live = LiveRun(ReplaySource(world), live_settings, out, world, ["vislam", "live"])
    with pytest.raises(TrackingLostError, match="no scale after") as caught:
        live.execute(duration_s=PATIENCE_S)
    assert "in the front process" in "".join(caught.value.__notes__)
    assert left_behind("mono") == []


def no_board() -> InertialSource:
    raise BusError("/dev/i2c-7: it cannot be opened", OSError(errno.ENOENT, "No such file or directory"))


class Boardless(ReplaySource):
    """A cart whose board does not answer, which shows when it is opened."""

    def inertial(self) -> Callable[[], InertialSource]:
        return no_board


def test_a_sensor_that_is_missing_ends_the_run_before_it_began_and_the_next_try_is_not_refused(tmp_path: Path) -> None:
    live, out = start(tmp_path, "boardless", Boardless)
    with log_to(out, ["vislam", "live"]), pytest.raises(BusError, match="it cannot be opened") as caught:
        live.execute()
    assert caught.value.exit_code == HardwareError.exit_code and caught.value.kind == "gone"
    assert not live.is_going
    assert left_behind("boardless") == []
    prepare(out, overwrite=False)


def test_an_interrupt_before_the_sensors_are_read_ends_it_at_once(tmp_path: Path) -> None:
    live, _ = start(tmp_path, "early")
    with pytest.raises(KeyboardInterrupt):
        live.execute(lambda run: os.kill(os.getpid(), signal.SIGTERM))
    assert not live.is_going
    assert left_behind("early") == []


def test_a_setting_for_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"ekf\.graph_feedback"):
        LiveRun(ReplaySource(WORLD), load(None, {"ekf.graph_feedback": True}), tmp_path, WORLD, [])


def test_a_source_without_inertial_data_is_refused() -> None:
    with pytest.raises(VislamError, match="no simulated world"):
        ReplaySource("sim:nowhere")
