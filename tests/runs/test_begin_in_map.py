"""A run that begins in the map of an earlier session: found there, extending it or leaving it as it is."""

import csv
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.config import load
from vislam.core.geometry import align_points, invert
from vislam.loop.table import read_loops
from vislam.runs import execute
from vislam.runs.folder import MapChoice, prepare
from vislam.runs.loaded import load_run
from vislam.runs.session import Session
from vislam.runs.sources import open_source
from vislam.trajectory import read_tum

# the same way and the same landmarks, seen by other noise at other times
YESTERDAY = "points:corridor-loop,duration_s=12,camera_hz=10,tracks=150"
TODAY = "points:corridor-loop,duration_s=12,camera_hz=12,tracks=150,pixel_sigma_px=0.8"
FAST = {"view.enabled": False}


def run(source: str, out: Path, base: MapChoice | None = None, stop_at: int | None = None, **settings: object) -> dict:
    def stop(done: int, total: int, note: str) -> None:
        if done == stop_at:
            raise KeyboardInterrupt

    prepare(out, overwrite=False)
    return execute(open_source(source), load(None, FAST | settings), out, source, [], stop, base)


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def keyframes_of(path: Path) -> list:
    session = Session(path / "session.db")
    stored = list(session.keyframes())
    session.close()
    assert [keyframe.id for keyframe in stored] == list(range(len(stored)))
    return stored


def poses_of(path: Path) -> np.ndarray:
    return np.array([keyframe.T_map_body for keyframe in keyframes_of(path)])


@pytest.fixture(scope="module")
def yesterday(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "yesterday"
    run(YESTERDAY, out)
    return out


def error_in_map_m(old: Path, new: Path) -> float:
    """Return the rms position error of a run in the map of another: both motions are the same, so are the truths."""
    truth = read_tum(old / "trajectory_truth.tum")
    estimates = [read_tum(path / "trajectory_graph.tum") for path in (old, new)]
    T_truth_map = truth.at(estimates[0].t_ns[:1])[0] @ invert(estimates[0].T_world_body[0])
    inside = estimates[1].t_ns[estimates[1].t_ns >= truth.t_ns[0]]
    expected = truth.at(inside)[:, :3, 3]
    found = (T_truth_map @ estimates[1].at(inside))[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum((found - expected) ** 2, axis=1))))


@pytest.mark.parametrize("localize_only", [False, True])
def test_a_run_is_found_in_the_map_of_another_which_is_not_written(localize_only, yesterday, tmp_path):
    before, old = digest(yesterday / "session.db"), poses_of(yesterday)
    metrics = run(TODAY, tmp_path / "today", MapChoice(yesterday, localize_only))
    assert digest(yesterday / "session.db") == before
    assert metrics["map"]["found_t_s"] < 6.0
    assert metrics["map"]["keyframes"] == len(old)
    stored = keyframes_of(tmp_path / "today")
    new = np.array([keyframe.T_map_body for keyframe in stored])
    assert len(new) == len(old) + metrics["keyframes"]
    first_s = np.diff([keyframe.t_ns for keyframe in stored[len(old) : len(old) + 6]]) * 1e-9
    print(f"seconds between the first keyframes, which are to be recognised: {first_s}")
    assert first_s.max() < 0.3  # as after a loss; later ones are up to two seconds apart
    moved_m = np.linalg.norm(new[: len(old), :3, 3] - old[:, :3, 3], axis=1).max()
    error_m = error_in_map_m(yesterday, tmp_path / "today")
    print(f"old keyframes moved {moved_m:.2e} m, rms error in their map {error_m:.3f} m")
    assert moved_m < (3e-4 if localize_only else 0.1)  # they are held at 1 mm (1 sigma), each, and loops pull
    assert error_m < 0.06


def test_a_place_that_is_found_is_in_map_at_once_and_no_pose_is_claimed_before(tmp_path):
    """By vision alone, from another place; vision is lost once, and the submap after it is found in the map as well."""
    with_depth = "points:corridor-loop,rig=rgbd,tracks=150"  # with one end both have the same landmarks
    sources = [f"{with_depth},duration_s=12,camera_hz=10"]
    sources += [f"{with_depth},start_s=1.5,duration_s=10.5,camera_hz=12,pixel_sigma_px=0.8"]
    by_eye = {"imu.enabled": False, "map.enabled": False}
    old, new = tmp_path / "old", tmp_path / "new"
    run(sources[0], old, **by_eye)
    metrics = run(sources[1], new, MapChoice(old, False), **by_eye)
    assert metrics["counters"]["localisation"]["relocalised"] == 2
    with (new / "tracking.csv").open() as file:
        rows = {int(row["t_ns"]): row for row in csv.DictReader(file)}
    live, truth, built = (read_tum(new / f"trajectory_{name}.tum") for name in ("live", "truth", "graph"))
    old_truth, old_built = (read_tum(old / f"trajectory_{name}.tum") for name in ("truth", "graph"))
    T_truth_map = align_points(old_built.positions_m, old_truth.at(old_built.t_ns)[:, :3, 3])
    off = T_truth_map @ live.T_world_body
    off_m = np.linalg.norm(off[:, :3, 3] - truth.at(live.t_ns)[:, :3, 3], axis=1)
    states = [rows[t]["localisation"] for t in live.t_ns.tolist()]
    found_m = [m for m, state in zip(off_m, states, strict=True) if state == "relocalised"]
    known_m = [m for m, state in zip(off_m, states, strict=True) if state != "lost"]
    print(f"off when found {np.round(1e3 * np.array(found_m))} mm, at most {1e3 * max(known_m):.0f} mm while known")
    assert len(found_m) == 2
    assert max(found_m) < 0.03
    assert max(known_m) < 0.15
    unplaced = {t for t, row in rows.items() if row["localisation"] == "lost" and row["tracking"] != "lost"}
    assert min(rows) in unplaced
    assert not unplaced & set(live.t_ns.tolist())
    assert unplaced < set(built.t_ns.tolist())  # what is final has them


def test_a_run_that_is_never_found_has_no_pose_in_the_map(yesterday, tmp_path):
    elsewhere = TODAY.replace("tracks=150", "tracks=150,world_seed=5")
    metrics = run(elsewhere, tmp_path / "today", MapChoice(yesterday, False))
    assert metrics["map"]["found_t_s"] is None
    paths = load_run(tmp_path / "today").trajectories
    assert "live" not in paths
    assert len(paths["graph"]) == metrics["frames"]


def test_maps_are_chained_and_a_run_in_one_is_resumed(yesterday, tmp_path, capsys):
    today, tomorrow = tmp_path / "today", tmp_path / "tomorrow"
    with pytest.raises(KeyboardInterrupt):
        run(TODAY, today, MapChoice(yesterday / "session.db", False), stop_at=80)
    assert run_verb(["run", "--resume", str(today), "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["resumed"][0]["keyframe"] >= metrics["map"]["keyframes"]
    assert metrics["frames"] == metrics["frames_expected"]
    assert error_in_map_m(yesterday, today) < 0.06
    stamps = [keyframe.t_ns for keyframe in keyframes_of(today)]
    loops = read_loops(today / "loops.csv")
    assert any(loop.from_id < metrics["map"]["keyframes"] <= loop.to_id for loop in loops)
    assert all((loop.from_t_ns, loop.to_t_ns) == (stamps[loop.from_id], stamps[loop.to_id]) for loop in loops)
    chained = run(YESTERDAY.replace("camera_hz=10", "camera_hz=9"), tomorrow, MapChoice(today, False))
    assert chained["map"]["keyframes"] == len(poses_of(today))
    assert chained["map"]["found_t_s"] < 6.0
    assert run_verb(["eval", str(today), "--loops"]) == 0


def test_a_run_that_ends_before_gravity_is_known_leaves_the_map_as_it_was(yesterday, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(TODAY, tmp_path / "today", MapChoice(yesterday, False), stop_at=5)
    metrics = json.loads((tmp_path / "today" / "metrics.json").read_text())
    assert metrics["initialisation"]["status"] == "none"
    assert metrics["keyframes"] == 0
    np.testing.assert_allclose(poses_of(tmp_path / "today"), poses_of(yesterday), atol=1e-3)


@pytest.mark.parametrize(
    ("source", "arguments", "code", "message"),
    [
        (TODAY, ["--map", "nowhere/session.db"], 3, "no session at"),
        (TODAY, ["--localize-only"], 2, "give --map"),
        (TODAY + ",rig=mono", ["--map", "MAP"], 2, "other cameras"),
        (TODAY, ["--map", "MAP", "--graph.coupling", "loose"], 2, "tight coupling only"),
        (TODAY, ["--map", "MAP", "--imu.no-enabled"], 2, "must both have an IMU"),
    ],
)
def test_a_map_that_does_not_fit_is_told_in_one_line(source, arguments, code, message, yesterday, tmp_path, capsys):
    given = [str(yesterday) if argument == "MAP" else argument for argument in arguments]
    assert run_verb(["run", source, "--out", str(tmp_path / "run"), "--view.no-enabled", *given]) == code
    error = capsys.readouterr().err.strip()
    assert message in error
    assert len(error.splitlines()) == 1
