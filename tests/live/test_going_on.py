"""Live runs that go on: resumed after Ctrl-C, a kill or an unplugged sensor, and in the map of another run.

The recording is played again from its start each time, as a cart does that was put back to where it began. A run is
ended when it has been found, or has seen enough, however long that takes.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.config import Config, SensorsConfig, load
from vislam.core.errors import DataError, HardwareError, UsageError
from vislam.core.files import write_json
from vislam.hw.health import Health
from vislam.live.beginning import in_map, resumed
from vislam.live.replay import Outages, ReplaySource
from vislam.live.run_live import LiveRun
from vislam.runs.folder import MapChoice, prepare
from vislam.runs.session import Session
from vislam.trajectory import read_tum

WORLD = "points:corridor-loop,camera_hz=10,tracks=150"
PATIENCE_S = 60.0  # the recording is 63 s long; a quiet machine needs a few of them


def settings() -> Config:
    name = f"vislam-test-going-on-{os.getpid()}"
    return load(None, {"view.enabled": False, "live.name": name, "live.send_to": ()})


def keyframes_in(out: Path) -> int:
    session = Session(out / "session.db")
    try:
        return sum(1 for _ in session.keyframes())
    finally:
        session.close()


def begin(out: Path, base: MapChoice | None = None, outages: Outages | None = None) -> LiveRun:
    """Return a run that goes on with what is in a folder, or begins in a map, or begins."""
    source, config = ReplaySource(WORLD, outages=outages), settings()
    if (out / "session.db").exists():
        beginning = resumed(out, source, config)
        assert beginning is not None
    else:
        prepare(out, overwrite=False)
        beginning = None if base is None else in_map(base, source, config)
    write_json(out / "sensors.json", asdict(SensorsConfig()))
    return LiveRun(source, config, out, f"replay:{WORLD}", ["vislam", "live"], base, beginning)


def until(enough: Callable[[LiveRun], bool], act: Callable[[LiveRun], None]) -> Callable[[LiveRun], None]:
    """Return what watches a run and acts once, when it has enough."""
    done: list[bool] = []

    def watch(run: LiveRun) -> None:
        if not done and enough(run):
            done.append(True)
            act(run)

    return watch


def has_map(run: LiveRun) -> bool:
    return run.notes.get("fast", {}).get("status", {}).get("map_revision", 0) >= 8


def is_found(run: LiveRun) -> bool:
    return bool(run.notes.get("map", {}).get("found_in_map"))


def interrupt(run: LiveRun) -> None:
    os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """A run that was ended by Ctrl-C."""
    out = tmp_path_factory.mktemp("live") / "first"
    return out, begin(out).execute(until(has_map, interrupt), PATIENCE_S)


def test_a_run_ended_by_ctrl_c_a_kill_and_an_outage_is_resumed_each_time(first, tmp_path: Path) -> None:
    out, metrics = first
    before = keyframes_in(out)
    assert before == metrics["keyframes"] >= 8

    outages = Outages(imu=((2.0, 2.5),), camera=((3.0, 4.5),))
    seen: list[Health] = []

    def watch(run: LiveRun) -> None:
        seen.append(Health(run.notes.get("fast", {}).get("status", {}).get("health", 0)))
        found(run)

    has_all = lambda run: is_found(run) and any(Health.CAMERA_MISSING in h for h in seen)  # noqa: E731
    found = until(has_all, interrupt)
    again = begin(out, outages=outages).execute(watch, PATIENCE_S)
    after = keyframes_in(out)
    assert after > before
    assert again["resumed"][0]["keyframe"] == before - 1
    assert again["map"]["keyframes"] == before
    assert again["map"]["found_t_s"] > 0.0
    assert again["frames"] > metrics["frames"]
    assert any(Health.IMU_MISSING in h and Health.INVALID in h for h in seen)

    kill = until(is_found, lambda run: run.processes()["front"].kill())
    with pytest.raises(HardwareError, match="the front process was killed"):
        begin(out).execute(kill, PATIENCE_S)
    assert keyframes_in(out) >= after

    last = begin(out).execute(until(is_found, interrupt), PATIENCE_S)
    assert len(last["resumed"]) == 3
    assert (np.diff(read_tum(out / "trajectory_graph.tum").t_ns) > 0).all()
    assert last["accuracy"]["graph"]["ate_rmse_m"] < 0.3
    stored = Session(out / "session.db")
    try:
        assert len(stored.frames()) == last["frames"]
    finally:
        stored.close()


def test_frames_whose_keyframes_waited_at_the_end_are_not_lost(tmp_path: Path) -> None:
    out, stopped_s = tmp_path / "behind", []

    def watch(run: LiveRun) -> None:
        back = run.processes()["back"].pid
        if not stopped_s and run.notes.get("fast", {}).get("status", {}).get("map_revision", 0) >= 2:
            stopped_s.append(time.monotonic())
            os.kill(back, signal.SIGSTOP)
        if stopped_s and time.monotonic() > stopped_s[0] + 8.0 and not run.is_brief:
            interrupt(run)
        if run.is_brief:
            os.kill(back, signal.SIGCONT)

    metrics = begin(out).execute(watch, PATIENCE_S)
    assert len(read_tum(out / "trajectory_graph.tum").t_ns) < 0.8 * metrics["frames"]  # fewer than what is covered
    assert metrics["coverage_frames"] > 0.9
    assert metrics["verdict"]["state"] != "lost"


@pytest.mark.parametrize("localize_only", [False, True])
def test_a_run_begins_in_the_map_of_another(localize_only: bool, first, tmp_path: Path) -> None:
    out, _ = first
    old = (out / "session.db").read_bytes()
    run = begin(tmp_path / "next", MapChoice(out, localize_only))
    found = run.execute(until(is_found, interrupt), PATIENCE_S)
    assert (out / "session.db").read_bytes() == old
    assert found["map"]["localize_only"] is localize_only
    assert found["map"]["found_t_s"] is not None
    assert keyframes_in(tmp_path / "next") == keyframes_in(out) + found["keyframes"]
    manifest = json.loads((tmp_path / "next" / "manifest.json").read_text())
    assert manifest["map"] == {"path": str(out.resolve()), "localize_only": localize_only}


def test_what_cannot_go_on_is_refused_before_anything_starts(first, tmp_path: Path, monkeypatch) -> None:
    out, _ = first
    with pytest.raises(UsageError, match="other cameras"):
        in_map(MapChoice(out, False), ReplaySource(WORLD + ",rig=mono"), settings())
    with pytest.raises(DataError, match="no session at"):
        in_map(MapChoice(tmp_path, False), ReplaySource(WORLD), settings())
    monkeypatch.setattr("vislam.live.beginning.time.monotonic_ns", lambda: 1)
    with pytest.raises(UsageError, match="the machine was started anew"):
        resumed(out, ReplaySource(WORLD), settings())
    assert resumed(tmp_path, ReplaySource(WORLD), settings()) is None


def test_the_command_line_goes_on_and_says_what_it_cannot(first, tmp_path: Path, capsys) -> None:
    out, _ = first
    before = json.loads((out / "metrics.json").read_text())
    assert run_verb(["live", "--resume", str(out), "--seconds", "4", "--json"]) == 0
    resumed_again = json.loads(capsys.readouterr().out)["resumed"]
    assert len(resumed_again) == len(before["resumed"]) + 1
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
