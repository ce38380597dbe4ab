"""The whole pipeline on simulated recordings: the run folder, replay, outages, damage, exit codes."""

import hashlib
import json
import shutil
import subprocess
import sys
from functools import partial
from itertools import takewhile
from pathlib import Path

import cv2
import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.config import load
from vislam.core.messages import Frame, ImuSample
from vislam.datasets.recorder import record
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.report.run_files import read_run
from vislam.runs.sources import open_source
from vislam.sim import open_world
from vislam.trajectory import Trajectory, evaluate, read_tum, write_tum
from worlds.shared import shared

REPLAYED = ("trajectory_ekf.tum", "trajectory_live.tum", "trajectory_graph.tum", "loops.csv", "states_graph.csv")
FAST = {"view.enabled": False}


class Edited:
    """A recording whose events pass through a function first."""

    def __init__(self, recording, edit):
        self._recording, self._edit = recording, edit

    def __getattr__(self, name):
        return getattr(self._recording, name)

    def events(self):
        return self._edit(self._recording.events())


def without(kind, begin_s, end_s, recording):
    """A recording that lacks one kind of value for a while."""
    start_ns = next(v.t_ns for v in recording.events())
    is_in = lambda v: isinstance(v, kind) and begin_s < (v.t_ns - start_ns) * 1e-9 < end_s  # noqa: E731
    return Edited(recording, lambda events: (value for value in events if not is_in(value)))


def run(recording, out, **settings):
    prepare(out, overwrite=False)
    config = load(None, {**FAST, **{name.replace("__", "."): value for name, value in settings.items()}})
    return execute(recording, config, out, "test", [])


def room(duration_s=8.0, **options):
    return open_world("handheld-room", duration_s=duration_s, image_width_px=320, camera_hz=10.0, **options)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A simulated recording on disk, drawn once for all workers."""
    return shared(tmp_path_factory, "small-room", lambda folder: record(room(), folder / "room")) / "room"


@pytest.fixture(scope="module")
def small_room(recorded):
    """The same, read once and replayed often."""
    recording = open_source(str(recorded))
    values = list(recording.events())
    return Edited(recording, lambda _: iter(values))


@pytest.fixture(scope="module")
def finished(recorded, tmp_path_factory):
    """A run with everything that a run can leave."""
    make = lambda folder: run(open_source(str(recorded)), folder / "run", view__enabled=True)  # noqa: E731
    return shared(tmp_path_factory, "small-room-run", make) / "run"


@pytest.fixture
def damaged(recorded, tmp_path):
    """A copy of the recording to break."""
    shutil.copytree(recorded, tmp_path / "damaged")
    return tmp_path / "damaged"


def test_a_run_leaves_the_documented_folder(small_room, finished):
    metrics = json.loads((finished / "metrics.json").read_text())
    names = {str(p.relative_to(finished)) for p in finished.rglob("*") if p.is_file()}
    assert names >= {
        "manifest.json", "config.json", "metrics.json", "trajectory_ekf.tum", "trajectory_live.tum",
        "trajectory_graph.tum", "trajectory_truth.tum", "states_ekf.csv", "states_graph.csv", "loops.csv",
        "tracking.csv", "session.db", "run.rrd", "map/cloud.ply", "map/octomap.bt", "map/grid.pgm", "map/grid.yaml",
    }  # fmt: skip
    assert metrics["frames"] == small_room.frame_count
    assert len(read_tum(finished / "trajectory_graph.tum")) == small_room.frame_count
    assert metrics["initialisation"]["status"] == "static"
    cost, stages_ms = metrics["cost"], metrics["cost"]["stages_cpu_ms_per_frame"]
    assert sum(stages_ms.values()) == pytest.approx(cost["cpu_ms_per_frame"])
    stages = {"read", "track", "ekf", "ekf predict", "loop", "graph", "map", "view", "pictures", "other"}
    assert stages <= stages_ms.keys()
    assert cost["first_pose_s"] == pytest.approx(metrics["initialisation"]["t_s"], abs=1.0)
    assert 0.0 < cost["first_pose_cpu_s"] < cost["cpu_s"]
    assert metrics["accuracy"]["graph"]["ate_rmse_m"] < 0.02
    assert metrics["accuracy"]["ekf"]["ate_rmse_m"] < 0.03
    print(metrics["truth"]["summary"])
    assert metrics["truth"]["error_m"] < 0.002 and "noise" in metrics["truth"]["summary"]  # it is exact
    assert json.loads((finished / "config.json").read_text())["view"]["enabled"] is True
    assert read_run(finished).unread == {}


def test_a_dry_run_prints_what_the_run_writes_down(recorded, finished, tmp_path, capsys):
    assert run_verb(["run", str(recorded), "--out", str(tmp_path / "new"), "--view.enabled", "--dry-run"]) == 0
    assert json.loads(capsys.readouterr().out)["config"] == json.loads((finished / "config.json").read_text())
    assert not (tmp_path / "new").exists()


def test_replay_in_a_fresh_process_gives_identical_bytes(recorded, finished, tmp_path):
    """As in one that has run other things before, and shows the run."""
    command = [sys.executable, "-m", "vislam", "run", str(recorded), "--out", str(tmp_path / "again")]
    subprocess.run([*command, "--view.no-enabled"], check=True, capture_output=True, timeout=600)
    digests = []
    for out in (finished, tmp_path / "again"):
        files = [*(out / f for f in REPLAYED), *sorted((out / "map").iterdir())]
        digests.append({f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in files})
    assert digests[0] == digests[1]
    assert len(digests[0]) >= len(REPLAYED) + 4


@pytest.mark.parametrize(("rig", "duration_s", "bound_m"), [("stereo", 6.0, 0.03), ("mono", 10.0, 0.25)])
def test_other_rigs_find_the_trajectory(rig, duration_s, bound_m, tmp_path):
    metrics = run(room(duration_s, rig=rig), tmp_path / "run", map__enabled=False)
    assert metrics["mode"] == rig
    assert metrics["accuracy"]["graph"]["coverage"] > 0.8
    assert metrics["accuracy"]["graph"]["ate_rmse_m"] < bound_m


def test_the_imu_bridges_three_seconds_without_images(small_room, tmp_path):
    metrics = run(without(Frame, 3.0, 6.0, small_room), tmp_path / "run")
    lost = metrics["counters"]["front"]["frames_lost"]
    tracking = (tmp_path / "run" / "tracking.csv").read_text()
    assert lost >= 1 or "relocalised" in tracking
    assert metrics["accuracy"]["graph"]["ate_max_m"] < 0.5  # dead reckoning without the IMU would be metres off
    states = tracking.splitlines()[-5:]
    assert all(",ok," in row for row in states), "tracking did not recover"


def test_an_imu_hole_of_one_second_is_counted_and_survived(small_room, tmp_path):
    metrics = run(without(ImuSample, 4.0, 5.0, small_room), tmp_path / "run", map__enabled=False)
    assert metrics["counters"]["front"]["imu_outages"] > 0
    assert metrics["accuracy"]["graph"]["ate_rmse_m"] < 0.05
    assert metrics["coverage_frames"] == 1.0


@pytest.mark.parametrize(("imu", "most_m"), [(False, 0.02), (True, 0.5)])  # a filter that was turned meanwhile errs
def test_a_clock_that_steps_back_is_named_and_what_follows_is_tied_to_nothing_before(recorded, tmp_path, imu, most_m):
    shutil.copytree(recorded, tmp_path / "room")
    clean, back_ns = open_source(str(recorded)), 1_000_000_000
    first_ns = next(value.t_ns for value in clean.events() if isinstance(value, Frame))
    for table in (tmp_path / "room").rglob("data.csv"):
        if "mocap" not in str(table):
            lines = [line.partition(",") for line in table.read_text().splitlines()]
            late = [t.isdigit() and int(t) > first_ns + 4_000_000_000 for t, _, _ in lines]
            moved = [str(int(t) - back_ns) if is_late else t for (t, _, _), is_late in zip(lines, late, strict=True)]
            table.write_text("".join(f"{t}{line[1]}{line[2]}\n" for t, line in zip(moved, lines, strict=True)))
    source = open_source(str(tmp_path / "room"))
    metrics = run(source, tmp_path / "run", map__enabled=False, imu__enabled=imu)
    steps = {event["stream"]: event for event in metrics["events"] if event["happening"] == "step back"}
    assert {"cam0", "imu0"} <= set(steps)
    assert all(abs(event["from_s"] - 4.0) < 0.15 and abs(event["to_s"] - 3.0) < 0.15 for event in steps.values())
    assert "the clock stepped back" in metrics["verdict"]["reasons"][0]
    assert metrics["counters"]["front"]["submaps"] == 2
    odometry, truth = read_tum(tmp_path / "run" / "trajectory_ekf.tum"), clean.truth()
    after = odometry.t_ns > first_ns + 4_000_000_000
    moved = Trajectory(odometry.t_ns[after] + back_ns, odometry.T_world_body[after])
    assert evaluate(moved, truth, "yaw" if imu else "se3")["ate_rmse_m"] < most_m


def test_duplicate_backward_and_nan_samples_are_counted_not_used(small_room, tmp_path):
    def disturbed(events):
        for n, value in enumerate(events):
            yield value
            if isinstance(value, ImuSample) and n % 97 == 0:
                yield value
                yield ImuSample(value.t_ns - 20_000_000, value.gyro_rad_s + 5.0, value.accel_m_s2)
                yield ImuSample(value.t_ns + 1, value.gyro_rad_s * np.nan, value.accel_m_s2)

    metrics = run(Edited(small_room, disturbed), tmp_path / "run", map__enabled=False)
    imu = metrics["counters"]["imu"]
    assert imu["duplicate"] > 10
    assert imu["late"] > 10
    assert imu["unusable"] > 10
    assert metrics["accuracy"]["graph"]["ate_rmse_m"] < 0.02


@pytest.mark.parametrize("give_up_s", [3.0, 30.0])
def test_an_accelerometer_in_the_wrong_unit_is_told_and_done_without(small_room, tmp_path, give_up_s):
    def halved(events):
        for value in events:
            if isinstance(value, ImuSample):
                yield ImuSample(value.t_ns, value.gyro_rad_s, 0.5 * value.accel_m_s2)
            else:
                yield value

    metrics = run(Edited(small_room, halved), tmp_path / "run", map__enabled=False, init__give_up_s=give_up_s)
    assert metrics["initialisation"]["status"] == "none"
    assert any(
        "gravity was not found" in reason and "expected 9.81" in reason for reason in metrics["verdict"]["reasons"]
    )
    assert metrics["accuracy"]["graph"]["ate_rmse_m"] < 0.02
    assert metrics["coverage_frames"] == 1.0


def test_a_recording_cut_short_plays_to_its_end(damaged, tmp_path):
    for name in ("cam0", "depth0", "imu0"):
        path = damaged / "mav0" / name / "data.csv"
        text = path.read_bytes()
        path.write_bytes(text[: int(len(text) * 0.7)])
    out = tmp_path / "run"
    assert run_verb(["run", str(damaged), "--out", str(out), "--view.no-enabled"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert 50 < metrics["frames"] < 60
    assert metrics["problems"]


def test_unreadable_images_are_skipped_and_reported(damaged, tmp_path):
    images = sorted((damaged / "mav0" / "cam0" / "data").iterdir())
    images[30].unlink()
    images[50].write_bytes(b"not an image")
    out = tmp_path / "run"
    assert run_verb(["run", str(damaged), "--out", str(out), "--view.no-enabled"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"] == len(images) - 2
    assert sum(metrics["problems"].values()) >= 2
    assert metrics["accuracy"]["graph"]["ate_rmse_m"] < 0.02


def test_calibration_for_another_image_size_is_a_data_error(damaged, tmp_path, capsys):
    path = damaged / "mav0" / "cam0" / "sensor.yaml"
    path.write_text(path.read_text().replace("320", "752"))
    assert run_verb(["run", str(damaged), "--out", str(tmp_path / "run")]) == 3
    assert "calibration" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["run", "lidar:x", "--out", "{out}"], 2, "lidar"),
        (["run", "{empty}", "--out", "{out}"], 3, "empty"),
        (["run", "{absent}", "--out", "{out}"], 3, "does not exist"),
        (["run", "sim:atlantis", "--out", "{out}"], 2, "atlantis"),
        (["run", "sim:handheld-room", "--out", "{empty}/..", "--config", "{absent}"], 2, "cannot be read"),
        (["run", "sim:handheld-room,rig=mono", "--out", "{out}", "--frontend.mode", "rgbd"], 2, "rgbd"),
        (["dance"], 2, "no verb"),
        (["eval", "{absent}"], 2, "reference"),
        (["doctor", "{absent}"], 3, "does not exist"),
        (["report", "{absent}"], 3, "absent"),
    ],
)
def test_wrong_calls_end_with_one_line_and_the_documented_code(arguments, code, message, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    places = {"out": tmp_path / "out", "empty": tmp_path / "empty", "absent": tmp_path / "absent"}
    assert run_verb([argument.format(**places) for argument in arguments]) == code
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1


def test_a_run_is_never_overwritten_by_accident(tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("five years")
    assert run_verb(["run", "sim:handheld-room", "--out", str(tmp_path / "mine"), "--overwrite"]) == 2
    assert "is not a run" in capsys.readouterr().err
    assert (tmp_path / "mine" / "thesis.tex").read_text() == "five years"


def test_overwriting_leaves_nothing_of_the_old_run(finished, tmp_path):
    out = shutil.copytree(finished, tmp_path / "run")
    assert (out / "map" / "cloud.ply").is_file()
    prepare(out, overwrite=True)
    assert [p for p in out.rglob("*") if p.is_file()] == []


def test_a_full_disk_ends_with_a_storage_error_and_keeps_what_was_written(recorded, tmp_path):
    out = tmp_path / "run"
    script = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000));"
        f"from vislam.cli import run_verb; sys.exit(run_verb(['run', {str(recorded)!r}, '--out', {str(out)!r},"
        " '--view.no-enabled']))"
    )
    done = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True, timeout=600)
    assert done.returncode == 3, done.stderr
    assert "Traceback" not in done.stderr
    assert "free disk space" in done.stderr
    assert (out / "manifest.json").is_file()


def test_an_interrupt_keeps_what_was_computed_and_asks_no_more_of_the_images(small_room, tmp_path, monkeypatch):
    monkeypatch.setattr("vislam.runs.evidence.contradicted_extrinsics", lambda *_: pytest.fail("asked"))

    def interrupted(events):
        for n, value in enumerate(events):
            if n == 1200:
                raise KeyboardInterrupt
            yield value

    with pytest.raises(KeyboardInterrupt):
        run(Edited(small_room, interrupted), tmp_path / "run", map__enabled=False, verdict__probability=0.01)
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["frames"] > 40 and metrics["verdict"]["state"] == "doubtful"
    assert "stopped early" in metrics["warnings"][0]


def test_evaluation_of_a_run_equals_its_report(finished, tmp_path, capsys):
    out = shutil.copytree(finished, tmp_path / "run")
    truth, report = read_tum(out / "trajectory_truth.tum"), json.loads((out / "metrics.json").read_text())["accuracy"]
    longer = np.append(truth.t_ns, truth.t_ns[-1] + np.arange(1, 400) * 50_000_000)  # a truth that goes on
    poses = np.concatenate([truth.T_world_body, np.tile(truth.T_world_body[-1], (399, 1, 1))])
    for wanted in (truth, Trajectory(longer, poses)):
        write_tum(wanted, out / "trajectory_truth.tum")
        capsys.readouterr()
        assert run_verb(["eval", str(out), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found.keys() == report.keys()
        for name, entry in report.items():
            assert found[name]["alignment"] == entry["alignment"] == "yaw"
            for key in ("ate_rmse_m", "rotation_rmse_deg", "rpe_1s_m", "rpe_1s_deg", "scale", "coverage"):
                assert found[name][key] == pytest.approx(entry[key], rel=1e-5, abs=1e-6), (name, key)
    assert run_verb(["eval", str(out), "--align", "se3"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "aligned by SE(3)" in said and "aligned as asked" in said


def test_evaluation_fails_on_too_little_coverage(finished, tmp_path, capsys):
    out = shutil.copytree(finished, tmp_path / "run")
    assert run_verb(["eval", str(out), "--min-coverage", "0.5"]) == 0
    assert run_verb(["eval", str(out), "--min-coverage", "0.999"]) == 4
    assert "covers" in capsys.readouterr().err


def test_black_images_end_as_tracking_lost(tmp_path):
    def dark(events):
        for value in events:
            if isinstance(value, Frame):
                black = tuple(np.zeros_like(image) for image in value.images)
                yield Frame(value.t_ns, value.index, black, None, value.depth_m)
            else:
                yield value

    world = room(3.0)
    prepare(tmp_path / "run", overwrite=False)
    with pytest.raises(Exception, match="frames have a pose") as error:
        execute(Edited(world, dark), load(None, FAST), tmp_path / "run", "test", [])
    assert error.value.exit_code == 4
    assert Path(tmp_path / "run" / "metrics.json").is_file()


@pytest.mark.data
def test_a_truth_is_fitted_once_where_vision_is_simulated_on_it(data_root, tmp_path):
    """Vision and truth agree exactly then; what the real IMU sees otherwise is no error of the truth any more."""
    recording = open_source(f"points:{data_root / 'euroc_v202_imu'},rig=stereo,duration_s=8,tracks=60,camera_hz=10")
    metrics = run(recording, tmp_path / "run", map__enabled=False)
    assert any(kind.endswith(": undone") for kind in metrics["problems"])
    assert metrics["accuracy"]["graph"] and metrics["truth"] == {}


@pytest.mark.data
def test_two_seconds_of_real_stereo_and_imu(data_root, tmp_path):
    from vislam.datasets import open_dataset

    recording = open_dataset(f"euroc:{data_root / 'euroc_mh01_17s'}")
    end_ns = int(recording.frames.t_ns[0]) + 5_000_000_000
    beginning = partial(takewhile, lambda value: value.t_ns < end_ns)
    metrics = run(Edited(recording, beginning), tmp_path / "run", map__enabled=False)
    assert metrics["initialisation"]["status"] == "moving"
    assert metrics["accuracy"]["graph"]["ate_rmse_m"] < 0.02
    assert cv2.getNumThreads() == 1
