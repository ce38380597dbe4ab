"""Live runs that go on: resumed after Ctrl-C, a kill or an unplugged sensor, and in the map of another run."""

import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from live_runs import PATIENCE_S, WORLD, Notes, begin, interrupt, settings, status, until

from vislam.cli import run_verb
from vislam.core.errors import DataError, HardwareError, UsageError
from vislam.hw.health import Health
from vislam.live import run_live
from vislam.live.beginning import in_map, resumed
from vislam.live.replay import Outages, ReplaySource
from vislam.live.run_live import LiveRun
from vislam.runs.folder import MapChoice
from vislam.runs.session import Session
from vislam.trajectory import read_tum

BEHIND = 1600  # samples, of 200 Hz, that the back end does nothing for


def keyframes_in(out: Path) -> int:
    session = Session(out / "session.db")
    try:
        return sum(1 for _ in session.keyframes())
    finally:
        session.close()


def is_found(run: LiveRun) -> bool:
    return bool(run.notes.get("map", {}).get("found_in_map"))


def is_placed(run: LiveRun) -> bool:
    """Whether the published pose is in the map."""
    return Health.NOT_IN_MAP not in Health(status(run).get("health", Health.NOT_IN_MAP))


def test_a_run_ended_by_ctrl_c_and_a_kill_is_resumed_each_time(
    interrupted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """At last by the command line, which also says what it cannot go on from."""
    first, metrics = interrupted
    out = shutil.copytree(first, tmp_path / "run")
    before = keyframes_in(out)
    assert before == metrics["keyframes"] >= 8

    def has_all(run: LiveRun) -> bool:
        return is_found(run) and any(Health.CAMERA_MISSING in health for health in run.notes.health)

    live = begin(out, outages=Outages(imu=((2.0, 2.5),), camera=((3.0, 4.5),)))
    live.notes = Notes()
    with pytest.raises(HardwareError, match="the front process was killed"):
        live.execute(until(has_all, lambda run: run.processes()["front"].kill()), PATIENCE_S)
    after = keyframes_in(out)
    assert after > before
    assert any(Health.IMU_MISSING in health and Health.INVALID in health for health in live.notes.health)

    execute, gone = LiveRun.execute, list[float]()
    times_out = until(is_found, lambda _: gone.append(PATIENCE_S))  # then its --seconds are over

    def till_found(run: LiveRun, show: Callable[[LiveRun], None], seconds: float) -> dict:
        return execute(run, lambda run: (show(run), times_out(run)), seconds)

    with monkeypatch.context() as patch:
        patch.setattr(LiveRun, "execute", till_found)
        patch.setattr(run_live, "time", SimpleNamespace(monotonic=lambda: time.monotonic() + sum(gone)))
        assert run_verb(["live", "--resume", str(out), "--seconds", f"{PATIENCE_S:g}", "--json"]) == 0
    assert gone == [PATIENCE_S]
    last = json.loads(capsys.readouterr().out)
    assert [resumption["keyframe"] for resumption in last["resumed"]] == [before - 1, after - 1]
    assert last["map"]["keyframes"] == after
    assert last["map"]["found_t_s"] > 0.0
    assert last["frames"] > metrics["frames"]
    assert (np.diff(read_tum(out / "trajectory_graph.tum").t_ns) > 0).all()
    assert last["accuracy"]["graph"]["ate_rmse_m"] < 0.3
    stored = Session(out / "session.db")
    try:
        assert len(stored.frames()) == last["frames"]
    finally:
        stored.close()

    for arguments, code, message in [
        (["--resume", str(tmp_path / "none")], 2, "holds no run to resume"),
        (["--out", str(tmp_path / "new"), "--localize-only"], 2, "give --map"),
        (["--out", str(out), "--map", str(out), "--source", f"replay:{WORLD}", "--overwrite"], 2, "would be replaced"),
        (["--out", str(tmp_path / "new"), "--map", str(out)], 2, "other cameras"),
    ]:
        assert run_verb(["live", *arguments]) == code
        error = capsys.readouterr().err.strip()
        assert message in error
        assert len(error.splitlines()) == 1
    assert run_verb(["run", "--resume", str(out)]) == 2
    assert f"vislam live --resume {out}" in capsys.readouterr().err
    assert (out / "session.db").is_file()
    assert not (tmp_path / "new").exists()


def test_frames_whose_keyframes_waited_at_the_end_are_not_lost(tmp_path: Path) -> None:
    out, stopped_at = tmp_path / "behind", []

    def watch(run: LiveRun) -> None:
        back, samples = run.processes()["back"].pid, status(run).get("samples", 0)
        if not stopped_at and status(run).get("map_revision", 0) >= 2:
            stopped_at.append(samples)
            os.kill(back, signal.SIGSTOP)
        if stopped_at and samples > stopped_at[0] + BEHIND and not run.is_brief:
            interrupt(run)
        if run.is_brief:
            with suppress(ProcessLookupError):  # it went on and has ended
                os.kill(back, signal.SIGCONT)

    metrics = begin(out).execute(watch, PATIENCE_S)
    assert len(read_tum(out / "trajectory_graph.tum").t_ns) < 0.8 * metrics["frames"]  # fewer than what is covered
    assert metrics["coverage_frames"] > 0.9
    assert metrics["verdict"]["state"] != "lost"


def test_a_run_begins_in_the_map_of_another(interrupted, tmp_path: Path) -> None:
    out, _ = interrupted
    old = (out / "session.db").read_bytes()
    run = begin(tmp_path / "next", MapChoice(out, True), dense=True)
    run.notes = Notes()
    found = run.execute(until(lambda run: is_found(run) and is_placed(run), interrupt), PATIENCE_S)
    assert any(Health.NOT_IN_MAP in health for health in run.notes.health)
    assert is_placed(run)
    assert (out / "session.db").read_bytes() == old
    assert found["map"]["localize_only"] is True
    assert found["map"]["found_t_s"] is not None
    assert keyframes_in(tmp_path / "next") == keyframes_in(out) + found["keyframes"]
    manifest = json.loads((tmp_path / "next" / "manifest.json").read_text())
    assert manifest["map"] == {"path": str(out.resolve()), "localize_only": True}


def test_what_cannot_go_on_is_refused_before_anything_starts(interrupted, tmp_path: Path, monkeypatch) -> None:
    out, _ = interrupted
    with pytest.raises(UsageError, match="other cameras"):
        in_map(MapChoice(out, False), ReplaySource(WORLD.replace("rgbd", "mono")), settings())
    with pytest.raises(DataError, match="no session at"):
        in_map(MapChoice(tmp_path, False), ReplaySource(WORLD), settings())
    monkeypatch.setattr("vislam.live.beginning.time.monotonic_ns", lambda: 1)
    with pytest.raises(UsageError, match="the machine was restarted"):
        resumed(out, ReplaySource(WORLD), settings())
    assert resumed(tmp_path, ReplaySource(WORLD), settings()) is None


def test_the_advice_after_an_interrupt_works_whether_or_not_something_was_recorded(
    interrupted, tmp_path: Path, monkeypatch, capsys
) -> None:
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(LiveRun, "execute", stopped)
    monkeypatch.setattr(LiveRun, "is_brief", True)
    new = ["live", "--source", f"replay:{WORLD}", "--out", str(tmp_path / "new"), "--view.no-enabled"]
    for _ in range(2):
        assert run_verb(new) == 130
        assert "nothing was recorded yet; the same command begins again" in capsys.readouterr().err
    out = shutil.copytree(interrupted[0], tmp_path / "run")
    assert run_verb(["live", "--resume", str(out)]) == 130
    assert f"vislam live --resume {out}, or vislam optimize {out}" in capsys.readouterr().err
    assert run_verb(["optimize", str(out)]) == 0
