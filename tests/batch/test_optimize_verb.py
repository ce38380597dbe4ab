"""`vislam optimize`: the files it leaves, runs that were killed, damage, and what it does not take."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from itertools import takewhile
from multiprocessing import get_context

import numpy as np
import pytest

from needs import missing
from session_entries import editing
from vislam.cli import run_verb
from vislam.config import BatchConfig, Config, load
from vislam.core.errors import DataError, UsageError
from vislam.core.memory import FrameEntry
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.offline.optimize_run import optimize
from vislam.runs.sources import open_source
from vislam.trajectory import Trajectory, read_states_csv, read_tum, write_tum
from worlds.session import simulate, store

QUICK = BatchConfig(rounds=2)


@pytest.fixture(scope="module")
def simulated():
    return simulate("stereo", duration_s=8.0, true_loops=0)


@pytest.fixture(scope="module")
def stored(simulated, tmp_path_factory):
    """A run folder with a session, truth and metrics."""
    folder = tmp_path_factory.mktemp("stored")
    store(simulated.log, folder / "session.db", {"config": asdict(Config())}).close()
    stamps = np.array([k.packet.keyframe.t_ns for k in simulated.log.keyframes])
    write_tum(Trajectory(stamps, simulated.truth), folder / "trajectory_truth.tum")
    (folder / "metrics.json").write_text(json.dumps({"name": "simulated", "accuracy": {"graph": {}}}))
    return folder


@pytest.fixture
def folder(stored, tmp_path):
    shutil.copytree(stored, tmp_path, dirs_exist_ok=True)
    return tmp_path


def digests(folder):
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.iterdir() if p.is_file()}


def damage(folder, statement):
    with editing(folder / "session.db") as database:
        database.execute(statement)


def test_a_run_gets_its_batch_trajectory_states_and_metrics(folder, simulated):
    entry = optimize(folder, QUICK)
    trajectory = read_tum(folder / "trajectory_batch.tum")
    ids, states = read_states_csv(folder / "states_batch.csv")
    metrics = json.loads((folder / "metrics.json").read_text())
    assert len(trajectory) == entry["frames"] == len(simulated.log.frames.t_ns)
    assert ids.tolist() == list(range(len(simulated.log.keyframes)))
    assert np.isfinite(states[-1].covariance).all()
    assert metrics["name"] == "simulated"
    assert metrics["accuracy"]["graph"] == {}
    assert metrics["accuracy"]["batch"]["ate_rmse_m"] < 0.02
    assert metrics["batch"]["batch"]["accuracy"]["yaw"]["ate_rmse_m"] < 0.03
    assert entry["cost_after"] < entry["cost_before"]
    optimize(folder, replace(QUICK, huber_k=1.0), name="huber1")
    assert set(json.loads((folder / "metrics.json").read_text())["batch"]) == {"batch", "huber1"}
    assert (folder / "trajectory_huber1.tum").is_file()


def test_another_process_gives_the_same_bytes(folder):
    names = ("trajectory_batch.tum", "states_batch.csv")
    optimize(folder, QUICK)
    first = digests(folder)
    command = [sys.executable, "-m", "vislam", "optimize", str(folder), "--rounds", "2", "--json"]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=300)
    assert json.loads(done.stdout)["config"]["rounds"] == 2
    second = digests(folder)
    assert [first[name] for name in names] == [second[name] for name in names]
    assert "report.html" in second


def test_a_killed_run_can_be_optimised_up_to_its_last_keyframe(simulated, tmp_path):
    def killed() -> None:
        writer = store(simulated.log, tmp_path / "session.db", upto=20)
        writer.add_frame(FrameEntry(10**12, 19, None))
        os.kill(os.getpid(), signal.SIGKILL)

    child = get_context("fork").Process(target=killed)
    child.start()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    assert run_verb(["optimize", str(tmp_path), "--rounds", "2"]) == 0
    assert len(read_tum(tmp_path / "trajectory_batch.tum")) == 20
    assert json.loads((tmp_path / "metrics.json").read_text())["batch"]["batch"]["keyframes"] == 20


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("UPDATE packets SET pixels_px = x'0011' WHERE id = 3", "damaged"),
        ("UPDATE packets SET vo_covariance = zeroblob(288) WHERE id = 3", "keyframe 3"),
        ("UPDATE keyframes SET T_map_body = zeroblob(128) WHERE id = 4", "keyframe 4"),
        ("DELETE FROM packets WHERE id = 7", "damaged"),
        ("DELETE FROM keyframes", "no keyframe"),
        ("PRAGMA user_version=1", "format 1"),
        ('UPDATE info SET value = \'{"graph": {"huber_k": "wide"}}\' WHERE key = \'config\'', "huber_k"),
    ],
)
def test_a_damaged_run_is_refused_and_stays_as_it_was(folder, statement, message, capsys):
    damage(folder, statement)
    before = digests(folder)
    assert run_verb(["optimize", str(folder)]) == 3
    assert message in capsys.readouterr().err
    assert digests(folder) == before


def test_a_failed_optimisation_leaves_the_folder_as_it_was(folder, monkeypatch, capsys):
    def fail(*_):
        raise DataError("the run cannot be optimised: for this test")

    monkeypatch.setattr("vislam.batch.bundle.bundle_adjustment.solve", fail)
    before = digests(folder)
    assert run_verb(["optimize", str(folder)]) == 3
    assert "cannot be optimised" in capsys.readouterr().err
    assert digests(folder) == before


def test_damaged_metrics_and_truth_are_refused_before_anything_is_written(folder):
    (folder / "metrics.json").write_text("[1, 2")
    with pytest.raises(DataError, match=r"metrics\.json"):
        optimize(folder, QUICK)
    (folder / "metrics.json").unlink()
    (folder / "trajectory_truth.tum").write_text("1.0 2.0 nonsense\n")
    with pytest.raises(DataError, match=r"trajectory_truth\.tum"):
        optimize(folder, QUICK)
    assert not list(folder.glob("*batch*"))


def test_settings_that_this_version_does_not_know_are_left_aside(folder):
    config = asdict(Config())
    config["graph"]["retired_setting"] = 3
    config["retired_section"] = {}
    with editing(folder / "session.db") as database:
        database.execute("UPDATE info SET value = ? WHERE key = 'config'", (json.dumps(config),))
    assert optimize(folder, replace(QUICK, covariances=False))["keyframes"] > 0


def test_what_is_no_run_folder_is_refused(tmp_path, capsys):
    assert run_verb(["optimize", str(tmp_path / "sphere.g2o")]) == 3
    assert "g2o" in capsys.readouterr().err
    assert run_verb(["optimize", str(tmp_path)]) == 3
    assert "session" in capsys.readouterr().err
    assert run_verb(["optimize", str(tmp_path / "absent")]) == 3
    for name in ("live", "truth", "../x", ""):
        with pytest.raises(UsageError, match="out-name"):
            optimize(tmp_path, QUICK, name=name)


class _Start:
    """The first seconds of a recording."""

    def __init__(self, recording, seconds):
        self._recording, self._seconds = recording, seconds

    def __getattr__(self, name):
        return getattr(self._recording, name)

    def events(self):
        first = next(iter(self._recording.events())).t_ns
        return takewhile(lambda v: (v.t_ns - first) * 1e-9 < self._seconds, self._recording.events())


@pytest.mark.parametrize(
    ("source", "seconds", "bound_m"), [("euroc:euroc_mh01_17s", 9.0, 0.010), ("tum:tum_fr1_desk", 4.0, 0.020)]
)
def test_real_recordings_are_not_worse_than_their_graph(source, seconds, bound_m, data_root, tmp_path):
    kind, _, name = source.partition(":")
    if not (data_root / name).is_dir():
        missing(f"no {name} in {data_root}")
    recording = _Start(open_source(f"{kind}:{data_root / name}", 0), seconds)
    out = tmp_path / "run"
    prepare(out, overwrite=False)
    config = load(None, {"view.enabled": False, "map.enabled": False, "loop.enabled": False})
    metrics = execute(recording, config, out, "test", [])
    entry = optimize(out, BatchConfig(covariances=False))
    graph_m, batch_m = metrics["accuracy"]["graph"]["ate_rmse_m"], entry["accuracy"]["se3"]["ate_rmse_m"]
    print(f"{name}: graph {graph_m:.4f} m, batch {batch_m:.4f} m, readout {entry['readout_s'] * 1e3:.1f} ms")
    assert batch_m < max(1.15 * graph_m, graph_m + 0.002)
    assert batch_m < bound_m
    if name == "tum_fr1_desk":
        assert 0.012 < entry["readout_s"] < 0.028  # a Kinect's colour camera: about 20 ms
    else:
        assert entry["readout_s"] == 0.0


def test_overwriting_a_run_takes_its_batch_estimates_along(folder):
    optimize(folder, replace(QUICK, covariances=False), name="other")
    (folder / "manifest.json").write_text("{}")
    prepare(folder, overwrite=True)
    assert not list(folder.iterdir())
