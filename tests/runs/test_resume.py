"""A run that was ended, by whatever, goes on: what each stage remembers, and the whole pipeline under kill -9."""

import hashlib
import json
import os
import resource
import shutil
import sqlite3
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from session_entries import editing, start_facts
from vislam.cli import run_verb
from vislam.config import GraphConfig, WindowConfig, load
from vislam.core.memory import KeyframeEntry
from vislam.core.messages import LoopDecision
from vislam.graph import PoseGraph
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.session import Session, SessionWriter, recall
from vislam.runs.sources import open_source
from vislam.trajectory import read_tum
from worlds.fake_window import FakeWindow
from worlds.lap import RIG, World, rmse_m
from worlds.parts import GRAVITY_M_S2, MACHINE

LOOSE = GraphConfig(coupling="loose", vo_inflation=1.0)
TIGHT = GraphConfig(coupling="tight", window_inflation=1.0)
SOURCE = "points:corridor-loop,duration_s=8,camera_hz=10,tracks=100"
KILLS = 20
SEED = 1


# ---- the graph


def make_graph(world: World, config: GraphConfig, imu: bool, monkeypatch: pytest.MonkeyPatch) -> PoseGraph:
    monkeypatch.setattr("vislam.window.SlidingWindow", lambda *_: FakeWindow(world, imu=imu), raising=False)
    graph = PoseGraph(config, world.noise if imu else None, MACHINE, RIG, WindowConfig())
    graph.initialise(world.initial_state() if imu else None, None if imu else world.truth[0])
    return graph


def edges_of(world: World, k: int) -> list:
    """True loops to a lap before, and now and then one that is false."""
    if k <= 105 or k % 4:
        return []
    return [world.loop(2 * k, k - 100, k), *([world.false_loop(2 * k + 1, k - 60, k)] if k % 12 == 0 else [])]


def feed(graph: PoseGraph, world: World, measured: list, writer: SessionWriter | None = None) -> None:
    """Add packets with their loops; with a writer, as a run stores them."""
    for packet, edges in measured:
        k = packet.keyframe.id
        update = graph.add(packet, edges, world.truth[k])
        if writer is not None:
            start = start_facts(world.initial_state(), world.noise) if measured[-1][0].imu is not None else None
            writer.add(KeyframeEntry(packet, world.truth[k], update, graph.take_record(), edges, start=start))


def same(a: object, b: object) -> bool:
    """Whether two values hold the same bits, field by field."""
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if not hasattr(a, "__slots__") or isinstance(a, str):
        return bool(a == b)
    return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))


@pytest.mark.parametrize(("config", "imu"), [(LOOSE, True), (LOOSE, False), (TIGHT, True), (TIGHT, False)])
def test_a_graph_is_built_again_exactly_and_ends_where_it_would_have(config, imu, tmp_path, monkeypatch):
    world = World(36.0, seed=5)
    measured = [(world.packet(k, imu=imu, lost=k == 60), edges_of(world, k)) for k in range(world.count)]
    writer = SessionWriter.create(tmp_path / "session.db", {}, RIG, world.noise if imu else None, GRAVITY_M_S2)
    old = make_graph(world, config, imu, monkeypatch)
    feed(old, world, measured[:150], writer)
    writer.close()
    memory = recall(Session(tmp_path / "session.db"))
    assert memory is not None
    new = make_graph(world, config, imu, monkeypatch)
    update = new.restore(memory.graph)
    assert len(new.journal) == len(old.journal)
    assert all(same(a, b) for a, b in zip(new.journal, old.journal, strict=True))
    assert np.abs(new.poses() - old.poses()).max() < 1e-2
    assert update.ids.tolist() == list(range(150))
    assert np.allclose(update.T_map_odom, new.poses()[-1] @ np.linalg.inv(world.truth[149]))
    for a, b in zip(new.edge_reports(), old.edge_reports(), strict=True):
        assert same(replace(a, weight=0.0), replace(b, weight=0.0))
        assert a.weight == pytest.approx(b.weight, abs=0.1)
    decisions = {report.decision for report in new.edge_reports()}
    assert decisions >= {LoopDecision.ACCEPTED, LoopDecision.PENDING}
    if config is TIGHT:  # a new window starts at the newest keyframe, seen again
        new.go_on(replace(measured[149][0], imu=None), world.truth[149])
    for graph in (old, new):
        feed(graph, world, measured[150:])
        graph.finish()
    print("rmse [m]: went on", rmse_m(new.poses(), world.truth), "uninterrupted", rmse_m(old.poses(), world.truth))
    assert np.abs(new.poses() - old.poses()).max() < (1e-3 if config is LOOSE else 0.05)
    assert [s.t_ns for s in new.states()] == [s.t_ns for s in old.states()]


def test_the_newest_state_of_the_window_is_that_of_the_last_commit(tmp_path, monkeypatch):
    world = World(10.0, seed=6)
    measured = [(world.packet(k), []) for k in range(40)]
    writer = SessionWriter.create(tmp_path / "session.db", {}, RIG, world.noise, GRAVITY_M_S2)
    graph = make_graph(world, TIGHT, True, monkeypatch)
    feed(graph, world, measured, writer)
    writer.close()
    states = Session(tmp_path / "session.db").states("graph")
    assert sorted(states) == list(range(40))
    new = make_graph(world, TIGHT, True, monkeypatch)
    memory = recall(Session(tmp_path / "session.db"))
    new.restore(memory.graph)
    for a, b in zip(new.states(), graph.states(), strict=True):
        assert np.allclose(a.velocity_world_m_s, b.velocity_world_m_s, atol=0.02)
        assert np.array_equal(a.accel_bias_m_s2, b.accel_bias_m_s2)


# ---- the whole run


def folder_of(path: Path) -> dict:
    """Return what a test looks at in a run folder."""
    metrics = json.loads((path / "metrics.json").read_text())
    session = Session(path / "session.db")
    ids = [keyframe.id for keyframe in session.keyframes()]
    session.close()
    return {"metrics": metrics, "ids": ids, "trajectory": read_tum(path / "trajectory_graph.tum")}


@pytest.mark.slow
def test_twenty_kills_at_random_moments_lose_at_most_the_last_keyframe_each(tmp_path):
    """The script checks each time what is left; here the run that came to its end is compared with an undisturbed."""
    print("seed", SEED)
    command = [sys.executable, str(Path(__file__).parents[1] / "killed_runs.py"), str(tmp_path), str(SEED), str(KILLS)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)
    print(done.stdout[-6000:], done.stderr[-3000:])
    assert done.returncode == 0
    facts = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"kill"')]
    assert facts[-1]["kill"] == KILLS
    assert sum(fact["begun"] for fact in facts) > 0
    whole, resumed = folder_of(tmp_path / "whole"), folder_of(tmp_path / "killed0")
    assert resumed["metrics"]["resumed"]
    assert resumed["ids"] == list(range(resumed["metrics"]["keyframes"]))
    assert abs(len(resumed["ids"]) - len(whole["ids"])) <= 0.2 * len(whole["ids"])
    assert resumed["metrics"]["frames"] == whole["metrics"]["frames"]
    assert np.array_equal(resumed["trajectory"].t_ns, whole["trajectory"].t_ns)
    errors_m = [run["metrics"]["accuracy"]["graph"]["ate_rmse_m"] for run in (whole, resumed)]
    print("ATE [m]: undisturbed, resumed", errors_m)
    assert errors_m[1] < 2.0 * errors_m[0] + 0.01
    for name in ("tracking.csv", "trajectory_live.tum"):
        lines = [(tmp_path / run / name).read_text().splitlines() for run in ("whole", "killed0")]
        assert len(lines[0]) == len(lines[1]), name


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """A run that was interrupted in the middle, to copy and to resume."""
    out = tmp_path_factory.mktemp("runs") / "ended"
    prepare(out, overwrite=False)
    config = load(None, {"view.enabled": False})
    recording = open_source(SOURCE)

    def stop(done: int, total: int, note: str) -> None:
        if done == total // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        execute(recording, config, out, SOURCE, [], stop)
    return out


@pytest.fixture
def copied(ended, tmp_path):
    shutil.copytree(ended, tmp_path / "run")
    return tmp_path / "run"


def test_an_interrupted_run_is_resumed_once_and_then_finished(copied, capsys):
    assert json.loads((copied / "metrics.json").read_text())["warnings"]
    before = Session(copied / "session.db")
    assert before.info()["finished"] is False
    count = len(list(before.keyframes()))
    assert run_verb(["run", "--resume", str(copied), "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    (resumed,) = metrics["resumed"]
    assert resumed["keyframe"] == count - 1
    assert metrics["frames"] == metrics["frames_expected"]
    assert metrics["coverage_frames"] > 0.9
    assert run_verb(["run", "--resume", str(copied)]) == 2
    assert "nothing to resume" in capsys.readouterr().err


def test_the_habits_of_the_front_end_are_kept(ended):
    habits = recall(Session(ended / "session.db")).front.learned.habits
    assert habits.shape == (11,) and habits[7] > 10 and np.linalg.norm(habits[:6]) > 0.1


def test_two_resumed_runs_give_identical_bytes(ended, tmp_path):
    digests = []
    for name in ("a", "b"):
        shutil.copytree(ended, tmp_path / name)
        assert run_verb(["run", "--resume", str(tmp_path / name)]) == 0
        files = ("trajectory_graph.tum", "trajectory_ekf.tum", "loops.csv", "states_graph.csv", "states_ekf.csv")
        digests.append([hashlib.sha256((tmp_path / name / f).read_bytes()).hexdigest() for f in files])
    assert digests[0] == digests[1]


def edit_config(out: Path) -> None:
    config = json.loads((out / "config.json").read_text())
    config["loop"]["min_inliers"] += 1
    (out / "config.json").write_text(json.dumps(config))


def edit_manifest(out: Path) -> None:
    manifest = json.loads((out / "manifest.json").read_text())
    manifest["data_sha256"] = "0" * 64
    (out / "manifest.json").write_text(json.dumps(manifest))


def rename_source(out: Path, source: str) -> None:
    manifest = json.loads((out / "manifest.json").read_text())
    (out / "manifest.json").write_text(json.dumps(manifest | {"source": source}))


def edit_session(out: Path, statement: str) -> None:
    with editing(out / "session.db") as database:
        database.execute(statement)


@pytest.mark.parametrize(
    ("spoil", "code", "message"),
    [
        (lambda out: (out / "manifest.json").unlink(), 2, "holds no run to resume"),
        (lambda out: (out / "config.json").write_text("{"), 3, "cannot be read"),
        (edit_config, 2, "was changed since the run began"),
        (edit_manifest, 3, "is not the recording"),
        (lambda out: rename_source(out, "x" * 10**5), 3, "cannot be looked at: File name too long"),
        (lambda out: (out / "session.db").write_bytes(b"no database at all " * 400), 3, "cannot be read"),
        (lambda out: edit_session(out, "PRAGMA user_version=2"), 3, "format 2, this vislam reads 8"),
        (lambda out: edit_session(out, "DELETE FROM windows WHERE id = 3"), 3, "run the recording again"),
        (lambda out: edit_session(out, "DELETE FROM keyframes WHERE id = 3"), 3, "run the recording again"),
        (lambda out: edit_session(out, "UPDATE states SET state = x'00'"), 3, "run the recording again"),
        (
            lambda out: edit_session(out, "UPDATE keyframes SET T_map_body = zeroblob(128)"),
            3,
            "run the recording again",
        ),
        (lambda out: edit_session(out, "UPDATE newest SET value = '[]'"), 3, "run the recording again"),
        (lambda out: edit_session(out, "UPDATE keyframes SET t_ns = t_ns + 7 WHERE id > 0"), 3, "has no frame at"),
    ],
)
def test_what_cannot_be_resumed_is_told_in_one_line(copied, spoil, code, message, capsys):
    spoil(copied)
    assert run_verb(["run", "--resume", str(copied)]) == code
    error = capsys.readouterr().err.strip()
    assert message in error
    assert len(error.splitlines()) == 1


@pytest.mark.parametrize(
    ("make", "advice"),
    [
        (lambda out: None, "start one with --out {out}"),
        (lambda out: out.mkdir(), "start one with --out {out}"),
        (lambda out: (out.mkdir(), (out / "manifest.json").write_text("{}")), "start one with --out {out} --overwrite"),
        (lambda out: (out.mkdir(), (out / "notes.txt").write_text("")), "start one with --out and a new folder"),
        (lambda out: out.write_text(""), "start one with --out and a new folder"),
    ],
)
def test_where_no_run_is_the_advice_works(tmp_path, make, advice, capsys):
    out = tmp_path / "drive"
    make(out)
    assert run_verb(["run", "--resume", str(out)]) == 2
    assert capsys.readouterr().err.strip().endswith(advice.format(out=out))
    prepare(tmp_path / "new" if "new folder" in advice else out, overwrite="--overwrite" in advice)


@pytest.mark.parametrize("left", ["nothing", "empty", "no keyframe"])
def test_a_run_that_had_not_begun_begins_again(copied, left, capsys):
    for path in copied.glob("session.db*"):
        path.unlink()
    if left == "empty":
        sqlite3.connect(copied / "session.db").execute("PRAGMA journal_mode=WAL")
    if left == "no keyframe":
        recording, config = open_source(SOURCE), json.loads((copied / "config.json").read_text())
        SessionWriter.create(copied / "session.db", {"config": config}, recording.rig, recording.imu_noise, 9.81)
    assert run_verb(["run", "--resume", str(copied), "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["resumed"] == []
    assert metrics["frames"] == metrics["frames_expected"]


def test_a_full_disk_is_a_storage_error_and_the_run_goes_on_when_there_is_room(copied, capsys):
    """The limit on the size of a file stands for the disk."""
    size = (copied / "session.db").stat().st_size
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size // 8, limits[1]))
        assert run_verb(["run", "--resume", str(copied)]) == 3
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "free disk space" in capsys.readouterr().err
    assert run_verb(["run", "--resume", str(copied)]) == 0


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_a_storage_error(copied, capsys):
    copied.chmod(0o500)
    try:
        assert run_verb(["run", "--resume", str(copied)]) == 3
    finally:
        copied.chmod(0o700)
    assert "cannot be written" in capsys.readouterr().err


def test_settings_that_came_with_a_newer_version_do_not_stop_a_run_from_being_resumed(copied):
    with editing(copied / "session.db") as database:
        config = json.loads(database.execute("SELECT value FROM info WHERE key = 'config'").fetchone()[0])
        del config["loop"]["min_inliers"]
        database.execute("UPDATE info SET value = ? WHERE key = 'config'", (json.dumps(config),))
    config = json.loads((copied / "config.json").read_text())
    del config["loop"]["min_inliers"]
    (copied / "config.json").write_text(json.dumps(config))
    assert run_verb(["run", "--resume", str(copied)]) == 0
