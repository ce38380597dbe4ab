"""Sessions joined into one pose graph by loops between them: truth in one frame, refusals, determinism."""

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from session_entries import editing
from vislam.batch import DaskTeam, dask_client, read_pose_graph
from vislam.batch.posegraph.auto import decide
from vislam.batch.posegraph.problem import RelativePoses
from vislam.cli import run_verb
from vislam.config import PoseGraphConfig, load
from vislam.core.geometry import invert, se3_exp, transform
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.offline.join_sessions import join_sessions
from vislam.runs.sources import open_source
from vislam.trajectory import Trajectory, read_tum

# one way and the same landmarks (both hang on the duration), seen by other noise at other times
SOURCES = {
    "monday": "points:corridor-loop,duration_s=10,camera_hz=10,tracks=150",
    "tuesday": "points:corridor-loop,duration_s=10,camera_hz=12,tracks=150,pixel_sigma_px=0.8",
    "elsewhere": "points:corridor-loop,start_s=35,duration_s=5,camera_hz=10,tracks=150",
}

T_NEW_OLD = transform(
    np.array([[0.5, -(0.75**0.5), 0.0], [0.75**0.5, 0.5, 0.0], [0.0, 0.0, 1.0]]), np.array([3, 2, 0.5])
)


def turn_map(session: Path) -> None:
    """Give a session another map frame with the same up, as if it had begun elsewhere."""
    with editing(session) as db:
        for k, blob in db.execute("SELECT id, T_map_body FROM keyframes").fetchall():
            T = T_NEW_OLD @ np.frombuffer(blob, "<f8").reshape(4, 4)
            db.execute("UPDATE keyframes SET T_map_body = ? WHERE id = ?", (T.astype("<f8").tobytes(), k))


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    for name, source in SOURCES.items():
        prepare(folder / name, overwrite=False)
        config = load(None, {"view.enabled": False, "map.enabled": False})
        execute(open_source(source), config, folder / name, source, [])
    turn_map(folder / "tuesday" / "session.db")
    return folder


def digests(folder: Path) -> dict[str, str]:
    return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.rglob("*")) if p.is_file()}


def error_m(reference: Path, estimate: Trajectory, truth: Path) -> float:
    """Return the rms position error of a trajectory in the map whose first pose is that of `reference`."""
    first = read_tum(reference)
    T_truth_map = read_tum(reference.parent / "trajectory_truth.tum").at(first.t_ns[:1])[0]
    T_truth_map = T_truth_map @ invert(first.T_world_body[0])
    true = read_tum(truth)
    inside = estimate.t_ns[(estimate.t_ns >= true.t_ns[0]) & (estimate.t_ns <= true.t_ns[-1])]
    apart = (T_truth_map @ estimate.at(inside))[:, :3, 3] - true.at(inside)[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


def test_two_sessions_come_into_one_frame(runs, tmp_path, capsys):
    before = digests(runs)
    out = tmp_path / "joined"
    assert run_verb(["optimize", str(runs / "monday"), str(runs / "tuesday"), "--out", str(out), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert digests(runs) == before
    reference, truth = runs / "monday" / "trajectory_graph.tum", runs / "tuesday" / "trajectory_truth.tum"
    alone = read_tum(runs / "tuesday" / "trajectory_graph.tum")
    apart_m = error_m(reference, replace(alone, T_world_body=T_NEW_OLD @ alone.T_world_body), truth)
    joined_m = error_m(reference, read_tum(out / "trajectory_tuesday.tum"), truth)
    first_m = error_m(reference, read_tum(out / "trajectory_monday.tum"), runs / "monday" / "trajectory_truth.tum")
    print(f"tuesday in monday's map: {apart_m:.3f} m before, {joined_m:.3f} m after; monday {first_m:.3f} m")
    assert apart_m > 1.0
    assert joined_m < 0.06
    assert first_m < 0.06
    rows = (out / "loops.csv").read_text().splitlines()
    assert len(rows) - 1 == summary["loops_between"]
    assert sum(row.endswith(",1") for row in rows[1:]) == summary["loops_kept"] >= 4
    graph = read_pose_graph(out / "joined.g2o")
    assert len(graph.ids) == summary["poses"] == sum(s["keyframes"] for s in summary["sessions"])
    assert graph.components().max() == 0
    assert graph.chi2(graph.poses) == pytest.approx(summary["chi2_after"], rel=1e-3)
    assert "each session in its own map" in (out / "report.html").read_text()
    again = tmp_path / "again"
    assert run_verb(["optimize", str(runs / "monday"), str(runs / "tuesday"), "--out", str(again), "--no-report"]) == 0
    for name in ("joined.g2o", "loops.csv", "summary.json", "trajectory_monday.tum", "trajectory_tuesday.tum"):
        assert (again / name).read_bytes() == (out / name).read_bytes(), name


def test_three_sessions_of_which_two_have_one_name_are_joined_by_domains(runs, tmp_path):
    copy = tmp_path / "tuesday"
    shutil.copytree(runs / "tuesday", copy)
    with dask_client(None, workers=1) as client:
        joined = join_sessions([runs / "monday", runs / "tuesday" / "session.db", copy], team=DaskTeam(client))
    assert joined.names == ("monday", "tuesday", "tuesday-2")
    assert joined.solution.converged
    ends = {(loop.from_session, loop.to_session) for loop in joined.loops if loop.kept}
    assert any(b == "tuesday-2" for _, b in ends)
    one, other = joined.trajectories[1:]
    assert np.abs(one.positions_m - other.positions_m).max() < 0.05


def test_what_does_not_overlap_ends_with_4(runs, tmp_path, capsys):
    out = tmp_path / "none"
    assert run_verb(["optimize", str(runs / "monday"), str(runs / "elsewhere"), "--out", str(out)]) == 4
    error = capsys.readouterr().err.strip()
    assert "no loops join elsewhere with monday" in error
    assert len(error.splitlines()) == 1
    assert not out.exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rig": None}, "other cameras"),
        ({"imu_noise": "null", "start": "null", "first_state": "null"}, "must both have an IMU"),
        ({"start": "null"}, "holds no map"),
    ],
)
def test_sessions_that_do_not_fit_are_told_in_one_line(change, message, runs, tmp_path, capsys):
    shutil.copytree(runs / "tuesday", tmp_path / "other")
    with editing(tmp_path / "other" / "session.db") as db:
        for key, value in change.items():
            if value is None:
                rig = json.loads(db.execute("SELECT value FROM info WHERE key = ?", (key,)).fetchone()[0])
                rig["T_body_cams"][0][0][3] += 0.01
                text = json.dumps(rig)
            else:
                text = value
            db.execute("UPDATE info SET value = ? WHERE key = ?", (text, key))
    code = run_verb(["optimize", str(runs / "monday"), str(tmp_path / "other"), "--out", str(tmp_path / "out")])
    error = capsys.readouterr().err.strip()
    assert code in (2, 3)
    assert message in error
    assert len(error.splitlines()) == 1


def test_usage(runs, tmp_path, capsys):
    monday, out = str(runs / "monday"), str(tmp_path / "out")
    assert run_verb(["optimize", monday, "--out", out]) == 2
    assert run_verb(["optimize", monday, monday, "--out", out]) == 2
    assert run_verb(["optimize", monday, str(runs / "tuesday")]) == 2
    assert run_verb(["optimize", monday, "--engine", "dask"]) == 2
    assert capsys.readouterr().err.count("--out FOLDER") == 2
    assert run_verb(["optimize", monday, str(runs / "tuesday"), "--out", out, "--rounds", "1"]) == 2
    assert run_verb(["optimize", monday, str(tmp_path / "nowhere"), "--out", out]) == 3
    assert "no session at" in capsys.readouterr().err


def test_false_loops_between_are_rejected_and_odometry_is_not():
    rng = np.random.default_rng(3)
    count = 40
    step = se3_exp(np.array([0.0, 0.0, 0.1, 0.5, 0.0, 0.0]))
    true = [np.eye(4)]
    for _ in range(count - 1):
        true.append(true[-1] @ step)
    poses = np.array(true + true)  # two sessions on one way
    sigma = np.array([0.005] * 3 + [0.02] * 3)
    ends = [(k - 1, k) for k in range(1, 2 * count) if k != count] + [(k, count + k) for k in range(0, count, 5)]
    false = [(3, count + 30), (20, count + 2), (38, count + 11)]
    measured = [invert(poses[a]) @ poses[b] @ se3_exp(sigma * rng.standard_normal(6)) for a, b in ends]
    measured += [se3_exp(np.array([0.0, 0.0, 0.3, 0.4, -0.3, 0.1])) for _ in false]
    information = np.tile(np.diag(sigma**-2), (len(ends) + len(false), 1, 1))
    problem = RelativePoses(np.array(ends + false), np.array(measured), information).problem(poses)
    suspects = np.arange(len(ends) + len(false)) >= 2 * (count - 1)
    weights = decide(problem, PoseGraphConfig(), doubtful=suspects).weights
    assert np.flatnonzero(weights == 0.0).tolist() == list(range(len(ends), len(ends) + len(false)))
