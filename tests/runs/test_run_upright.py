"""Runs without an IMU: what is final of them stands upright, or says why not."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from needs import missing
from session_entries import editing
from vislam.cli import run_verb
from vislam.config import Config, ImuConfig, MapConfig, ViewConfig
from vislam.core.angles import angle_deg
from vislam.core.errors import UsageError
from vislam.core.geometry import invert
from vislam.core.up import Up, parse_up, turn_to_z
from vislam.datasets import open_dataset
from vislam.datasets.recorder import record
from vislam.runs import execute, resume
from vislam.runs.folder import MapChoice, prepare, read_setup
from vislam.runs.levelled import onto_map, stored_up, with_planes
from vislam.runs.offline.rebuild import map_settings, rebuild
from vislam.runs.report import write_report
from vislam.runs.session import Session
from vislam.runs.sources import open_source
from vislam.sim import open_world
from vislam.trajectory import align, associate, read_tum

CONFIG = Config(imu=ImuConfig(enabled=False), map=MapConfig(), view=ViewConfig(enabled=False))


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("upright") / "recording"
    record(open_world("handheld-room", duration_s=4.0, camera_hz=5.0, image_width_px=320), folder)
    return str(folder)


def run(source, out, up="auto"):
    prepare(out, False)
    return execute(open_source(source, 0), replace(CONFIG, up=up), out, source=source, command=["test"])


@pytest.fixture(scope="module")
def auto(source, tmp_path_factory):
    out = tmp_path_factory.mktemp("upright") / "run"
    return run(source, out), out


def lean_deg(out, name="graph", up=(0.0, 0.0, 1.0)):
    """By how much z of a trajectory's frame leans against up of the truth."""
    truth = read_tum(out / "trajectory_truth.tum")
    R = align(associate(read_tum(out / f"trajectory_{name}.tum"), truth), "se3")[:3, :3]
    return angle_deg(R[:, 2], np.array(up))


def test_the_final_trajectory_and_the_map_stand_upright(auto):
    metrics, out = auto
    up = metrics["up"]
    assert up["source"] == "planes"
    assert lean_deg(out, "live") > 5.0  # as published: the first image leans
    assert lean_deg(out) < 2.0
    assert up["sigma_deg"] < 2.0
    assert {"grid.pgm", "drive.pgm", "picture_octree.png"} <= {path.name for path in (out / "map").iterdir()}
    live = onto_map(read_tum(out / "trajectory_live.tum"), "live", metrics)
    graph = read_tum(out / "trajectory_graph.tum")
    assert np.linalg.norm(live.positions_m - graph.positions_m, axis=1).max() < 0.1
    R = np.array(up["R_map_odom"])
    np.testing.assert_allclose(R @ up["direction"], [0.0, 0.0, 1.0], atol=1e-9)


def test_the_map_made_again_is_that_of_the_run(auto, tmp_path):
    _, out = auto
    answer = rebuild(out, map_settings(out).map, tmp_path, "graph")
    assert answer["up"]["source"] == "planes"
    for name in ("cloud.ply", "octomap.bt", "grid.pgm", "drive.pgm"):
        assert (tmp_path / name).read_bytes() == (out / "map" / name).read_bytes()


def test_what_a_run_says_of_up_is_in_its_words(auto):
    _, out = auto
    assert "Up by planes to" in write_report(out).read_text()


def test_nothing_level_is_written_where_up_is_unknown(source, tmp_path):
    metrics = run(source, tmp_path / "run", "none")
    assert metrics["up"]["source"] == "unknown"
    assert metrics["up"]["direction"] is None
    assert any("--up" in warning and "grid" in warning for warning in metrics["warnings"])
    names = {path.name for path in (tmp_path / "run" / "map").iterdir()}
    assert "cloud.ply" in names
    assert not names & {"grid.pgm", "grid.yaml", "drive.pgm", "drive.yaml", "picture_octree.png"}
    assert "no grid is written" in write_report(tmp_path / "run").read_text()


def test_a_vector_that_was_told_is_taken(auto, source, tmp_path):
    known = ",".join(str(x) for x in auto[0]["up"]["direction_cam0"])
    metrics = run(source, tmp_path / "run", known)
    assert metrics["up"]["source"] == "told"
    assert lean_deg(tmp_path / "run") < 2.0
    both = [(out / "map" / "octomap.bt").stat().st_size for out in (auto[1], tmp_path / "run")]
    assert both[0] == pytest.approx(both[1], rel=0.02)


def test_the_first_image_may_be_told_to_be_upright(source, tmp_path):
    metrics = run(source, tmp_path / "run", "camera")
    assert metrics["up"]["direction"] == [0.0, 0.0, 1.0]
    assert lean_deg(tmp_path / "run") == pytest.approx(lean_deg(tmp_path / "run", "live"), abs=0.5)


@pytest.mark.parametrize("text", ["down", "0,0", "0,0,0", "1,2,nan", "1,2,3,4", ""])
def test_a_direction_that_is_none_is_refused_before_anything_is_made(text, tmp_path, capsys):
    assert run_verb(["run", "sim:handheld-room", "--out", str(tmp_path / "run"), f"--up={text}"]) == 2
    said = capsys.readouterr().err
    assert "--up" in said and "X,Y,Z" in said
    assert not (tmp_path / "run").exists()


def test_an_imu_knows_better(source, tmp_path):
    with pytest.raises(UsageError, match="--up is for runs without an IMU"):
        execute(open_source(source, 0), Config(up="camera"), tmp_path, source=source, command=["test"])


def test_a_vector_may_begin_with_a_minus():
    np.testing.assert_allclose(parse_up("-3,0,-4"), [-0.6, 0.0, -0.8])


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, 0, -0.8)])
def test_turning_up_onto_z_is_a_rotation(up):
    R = turn_to_z(np.array(up, float))
    np.testing.assert_allclose(R @ up, [0.0, 0.0, 1.0], atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


# --- the accelerometer's file


def small_tum(root: Path, rows: list[str]) -> Path:
    """TUM's layout with three images and an accelerometer's file."""
    import cv2

    folder = root / "rgbd_dataset_freiburg1_small"
    (folder / "rgb").mkdir(parents=True)
    names = []
    for k in range(3):
        cv2.imwrite(str(folder / "rgb" / f"{k}.png"), np.full((480, 640), 60 * k, np.uint8))
        names.append(f"{1.0 + k} rgb/{k}.png")
    (folder / "rgb.txt").write_text("\n".join(names) + "\n")
    (folder / "accelerometer.txt").write_text("# timestamp ax ay az\n" + "\n".join(rows) + "\n")
    return folder


def test_rows_of_the_accelerometer_that_cannot_be_used_are_counted(tmp_path):
    rows = ["1.0 -0.1 7.2 -6.6", "1.1 nan 7.2 -6.6", "1.05 x 7.2 -6.6", "1.2 0 7 -6", "1.15 0 7 -6", "1.3 0 7 -6"]
    recording = open_dataset(str(small_tum(tmp_path, rows)))
    t_ns, forces = recording.forces()
    assert t_ns.tolist() == [1_000_000_000, 1_200_000_000, 1_300_000_000]
    np.testing.assert_allclose(forces[0], [0.1, -7.2, -6.6])  # in camera axes: y is down
    told = " ".join(recording.problems)
    assert "NaN" in told and "backward" in told


def test_a_recording_without_an_accelerometer_has_no_forces(tmp_path):
    folder = small_tum(tmp_path, [])
    (folder / "accelerometer.txt").unlink()
    assert open_dataset(str(folder)).forces() is None


# --- recordings


def begun(recording: Path, folder: Path) -> Path:
    """Return a folder with the first sixth of a recording in TUM's layout."""
    (folder / recording.name).mkdir(parents=True)
    for entry in recording.iterdir():
        (folder / recording.name / entry.name).symlink_to(entry)
    images = folder / recording.name / "rgb.txt"
    lines = images.read_text(encoding="utf-8").splitlines()
    images.unlink()
    images.write_text("\n".join(lines[: len(lines) // 6]) + "\n", encoding="utf-8")
    return folder / recording.name


@pytest.mark.parametrize(("name", "up"), [("tum_fr1_desk", (0, 0, 1)), ("hololens_000", (0, 1, 0))])
def test_recordings_stand_upright(name, up, data_root, tmp_path):
    path = data_root / name
    if not path.is_dir():
        missing(f"needs {path}")
    config = replace(CONFIG, map=MapConfig(products=("cloud",)))
    out, quarter = tmp_path / "run", f"tum:{begun(path, tmp_path / 'recording')}"
    prepare(out, False)
    execute(open_source(quarter, 0), config, out, source=quarter, command=["test"])
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["up"]["source"] == ("accelerometer" if name == "tum_fr1_desk" else "planes")
    assert lean_deg(out, up=up) < 2.0
    assert metrics["up"]["from_planes_deg"] is None or metrics["up"]["from_planes_deg"] < 3.0


# --- two who say it, and runs that go on


def said(source, lean_deg, sigma_deg):
    angle = np.deg2rad(lean_deg)
    return Up(source, np.array([np.sin(angle), 0.0, np.cos(angle)]), sigma_deg, 1.0, f"{source} says so")


def test_an_accelerometer_and_surfaces_that_agree_are_weighted_by_their_sigmas():
    both = with_planes(said("accelerometer", 1.0, 1.0), said("planes", -1.0, 0.5))
    assert both.source == "accelerometer"
    assert angle_deg(both.direction, np.array([0.0, 0.0, 1.0])) == pytest.approx(0.6, abs=0.01)
    assert both.direction[0] < 0.0
    assert both.sigma_deg == 0.5  # not smaller: both go by one trajectory
    assert "agree to 2.0 deg" in both.reason


def test_surfaces_that_contradict_the_accelerometer_move_nothing():
    first = said("accelerometer", 0.0, 1.0)
    assert with_planes(first, said("planes", 20.0, 0.5)) is first
    assert with_planes(first, Up.unknown("no surfaces")) is first


def run_in_map(recording, base, out, up="auto"):
    prepare(out, False)
    begin, config = MapChoice(base, False), replace(CONFIG, up=up)
    return execute(recording, config, out, source="again", command=["test"], base=begin)


@pytest.fixture(scope="module")
def again(auto, source, tmp_path_factory):
    out = tmp_path_factory.mktemp("upright") / "again"
    return run_in_map(open_source(source, 0), auto[1], out), out


def stored(out):
    """What a session has: poses in map and odom of all keyframes, and up as a run that begins in it has it."""
    session = Session(out / "session.db")
    keyframes, up = list(session.keyframes()), stored_up(session.info())
    session.close()
    return np.array([[k.T_map_body, k.T_odom_body] for k in keyframes]), up


def test_a_run_in_the_map_of_another_takes_its_up(auto, again):
    (old, _), (metrics, out) = auto, again
    assert metrics["map"]["found_t_s"] is not None
    assert metrics["up"]["source"] == "map"
    np.testing.assert_array_equal(metrics["up"]["direction"], [0.0, 0.0, 1.0])  # its own frame is level
    np.testing.assert_array_equal(metrics["up"]["R_map_odom"], np.eye(3))
    ups = [np.array(m["up"]["direction_cam0"]) for m in (old, metrics)]  # both begin with the same image
    assert angle_deg(*ups) < 1.0
    assert lean_deg(out) < 2.0


def test_files_session_and_published_pose_of_a_run_in_a_map_are_in_one_level_frame(auto, again):
    old, new = auto[1], again[1]
    assert lean_deg(new, "live") < 2.0
    paths = {out: [read_tum(out / f"trajectory_{name}.tum") for name in ("live", "graph")] for out in (old, new)}
    live, built = paths[new]
    for other in (built, paths[old][1]):  # the same recording: the old run's files say where it was, too
        apart = [invert(a) @ b for a, b in zip(live.T_world_body, other.at(live.t_ns), strict=True)]
        assert max(np.linalg.norm(T[:3, 3]) for T in apart) < 0.05
        assert max(angle_deg(T[:3, 2], np.array([0.0, 0.0, 1.0])) for T in apart) < 1.0
    count, T_level_map = len(stored(old)[0]), stored(old)[1].T_level_map
    assert angle_deg(T_level_map[:3, 2], np.array([0.0, 0.0, 1.0])) > 5.0
    turned = T_level_map @ stored(old)[0]
    np.testing.assert_allclose(stored(new)[0][:count, 1], turned[:, 1], atol=1e-12)
    assert np.abs(stored(new)[0][:count, 0] - turned[:, 0]).max() < 0.05  # loops move the map a little
    np.testing.assert_array_equal(stored(new)[1].direction, [0.0, 0.0, 1.0])
    grids = [(out / "map" / "grid.yaml").read_text() for out in (old, new)]
    assert [line.split(":")[0] for line in grids[0].splitlines()] == [
        line.split(":")[0] for line in grids[1].splitlines()
    ]


def test_a_run_in_a_map_that_is_turned_replays_to_the_same_bytes(auto, again, source, tmp_path):
    run_in_map(open_source(source, 0), auto[1], tmp_path / "run")
    names = (
        "trajectory_live.tum",
        "trajectory_graph.tum",
        "loops.csv",
        "tracking.csv",
        "map/octomap.bt",
        "map/grid.pgm",
    )
    for name in names:
        assert (tmp_path / "run" / name).read_bytes() == (again[1] / name).read_bytes(), name


def as_written_before(out, T_level_map, up):
    """Make of a run in a map what version 0.1 left: in the axes of the first run's first image, `up` beside it."""
    with editing(out / "session.db") as db:
        for k, *blobs in db.execute("SELECT id, T_map_body, T_odom_body FROM keyframes").fetchall():
            T = [(invert(T_level_map) @ np.frombuffer(blob, "<f8").reshape(4, 4)).tobytes() for blob in blobs]
            db.execute("UPDATE keyframes SET T_map_body = ?, T_odom_body = ? WHERE id = ?", (*T, k))
        base = json.loads(db.execute("SELECT value FROM info WHERE key = 'map'").fetchone()[0])
        for key, value in (("map", {**base, "up": up.entry()}), ("up", replace(up, source="map").entry())):
            db.execute("UPDATE info SET value = ? WHERE key = ?", (json.dumps(value), key))


def test_a_session_of_the_version_before_is_turned_when_a_run_begins_in_it(auto, again, source, tmp_path):
    before = tmp_path / "before"
    shutil.copytree(again[1], before)
    up = stored(auto[1])[1]
    as_written_before(before, up.T_level_map, up)
    np.testing.assert_array_equal(stored(before)[1].direction, up.direction)
    runs = [tmp_path / "one", tmp_path / "other"]
    for base, out in zip((again[1], before), runs, strict=True):
        assert run_in_map(open_source(source, 0), base, out)["map"]["found_t_s"] is not None
        assert max(lean_deg(out, name) for name in ("live", "graph")) < 2.0
    one, other = (stored(out) for out in runs)
    np.testing.assert_allclose(one[0], other[0], atol=1e-6)
    np.testing.assert_array_equal(one[1].direction, other[1].direction)


def test_a_run_in_a_level_map_that_was_ended_goes_on_in_its_frame(auto, source, tmp_path):
    def stop(done, total, note):
        if done == 12:
            raise KeyboardInterrupt

    out = tmp_path / "run"
    prepare(out, False)
    with pytest.raises(KeyboardInterrupt):
        execute(open_source(source, 0), CONFIG, out, "again", ["test"], stop, MapChoice(auto[1], False))
    _, config, base = read_setup(out)
    metrics = resume(open_source(source, 0), config, out, "again", ["test"], base=base)
    assert len(metrics["resumed"]) == 1
    assert metrics["up"]["source"] == "map"
    assert max(lean_deg(out, name) for name in ("live", "graph")) < 2.0
    live, built = (read_tum(out / f"trajectory_{name}.tum") for name in ("live", "graph"))
    assert np.linalg.norm(live.positions_m - built.at(live.t_ns)[:, :3, 3], axis=1).max() < 0.05


def test_a_map_stays_level_where_a_run_is_not_found_in_it_or_told_otherwise(auto, source, tmp_path):
    elsewhere = open_world("handheld-room", duration_s=2.0, camera_hz=5.0, image_width_px=320, world_seed=3)
    metrics = run_in_map(elsewhere, auto[1], tmp_path / "elsewhere")
    assert metrics["map"]["found_t_s"] is None
    assert metrics["up"]["source"] == "unknown"  # of its own frame: the surfaces that it saw are in no map
    with editing(tmp_path / "elsewhere" / "session.db") as db:  # as version 0.1 stored it: of that frame, too
        db.execute("INSERT INTO info VALUES ('up', ?, 0)", (json.dumps(said("floor", 30.0, 1.0).entry()),))
    poses, up = stored(tmp_path / "elsewhere")
    np.testing.assert_array_equal(up.direction, [0.0, 0.0, 1.0])
    old = stored(auto[1])
    np.testing.assert_allclose(poses[: len(old[0]), 1], old[1].T_level_map @ old[0][:, 1], atol=1e-12)
    assert (tmp_path / "elsewhere" / "map" / "grid.pgm").is_file()
    metrics = run_in_map(open_source(source, 0), auto[1], tmp_path / "told", "camera")
    assert metrics["up"]["source"] == "map"
    assert "--up camera is not used" in metrics["up"]["reason"]


def test_what_is_optimized_later_stands_upright_too(auto, tmp_path):
    _, out = auto
    copy = tmp_path / "run"
    shutil.copytree(out, copy)
    assert run_verb(["optimize", str(copy)]) == 0
    assert lean_deg(copy, "batch") < 2.0
    R = [read_tum(copy / f"trajectory_{name}.tum").T_world_body[:, :3, :3] for name in ("batch", "graph")]
    turned = [angle_deg(a[:, 2], b[:, 2]) for a, b in zip(*R, strict=False)]
    assert max(turned) < 2.0
