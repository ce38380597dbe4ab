"""Runs without an IMU: what is final of them stands upright, or says why not."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from needs import missing
from vislam.cli import run_verb
from vislam.config import Config, ImuConfig, MapConfig, ViewConfig
from vislam.core.angles import angle_deg
from vislam.core.errors import UsageError
from vislam.core.up import Up, parse_up, turn_to_z
from vislam.datasets import open_dataset
from vislam.datasets.recorder import record
from vislam.runs import execute
from vislam.runs.folder import MapChoice, prepare
from vislam.runs.levelled import onto_map, with_planes
from vislam.runs.offline.rebuild import map_settings, rebuild
from vislam.runs.report import write_report
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
    answer = rebuild(out, map_settings(out).map, tmp_path, "graph", None)
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
    """Return a folder with the first third of a recording in TUM's layout."""
    (folder / recording.name).mkdir(parents=True)
    for entry in recording.iterdir():
        (folder / recording.name / entry.name).symlink_to(entry)
    images = folder / recording.name / "rgb.txt"
    lines = images.read_text(encoding="utf-8").splitlines()
    images.unlink()
    images.write_text("\n".join(lines[: len(lines) // 3]) + "\n", encoding="utf-8")
    return folder / recording.name


@pytest.mark.parametrize(("name", "up"), [("tum_fr1_desk", (0, 0, 1)), ("hololens_000", (0, 1, 0))])
def test_recordings_stand_upright(name, up, data_root, tmp_path):
    path = data_root / name
    if not path.is_dir():
        missing(f"needs {path}")
    config = replace(CONFIG, map=MapConfig(products=("cloud",)))
    out, third = tmp_path / "run", f"tum:{begun(path, tmp_path / 'recording')}"
    prepare(out, False)
    execute(open_source(third, 0), config, out, source=third, command=["test"])
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


def test_a_run_in_the_map_of_another_takes_its_up(auto, source, tmp_path):
    old, out = auto
    prepare(tmp_path / "run", False)
    begin = MapChoice(out, False)
    metrics = execute(open_source(source, 0), CONFIG, tmp_path / "run", source=source, command=["test"], base=begin)
    assert metrics["map"]["found_t_s"] is not None
    assert metrics["up"]["source"] == "map"
    np.testing.assert_array_equal(metrics["up"]["direction"], old["up"]["direction"])
    assert lean_deg(tmp_path / "run") < 2.0


def test_what_is_optimized_later_stands_upright_too(auto, tmp_path):
    _, out = auto
    copy = tmp_path / "run"
    shutil.copytree(out, copy)
    assert run_verb(["optimize", str(copy)]) == 0
    assert lean_deg(copy, "batch") < 2.0
    R = [read_tum(copy / f"trajectory_{name}.tum").T_world_body[:, :3, :3] for name in ("batch", "graph")]
    turned = [angle_deg(a[:, 2], b[:, 2]) for a, b in zip(*R, strict=False)]
    assert max(turned) < 2.0
