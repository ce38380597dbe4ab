"""What a run without a camera writes: nothing of it is lost, and its report says and draws only what is there."""

import csv
import json
import re

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from vislam.cli import run_verb
from vislam.config import VerdictConfig, load
from vislam.core import Reading
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.further_sensors import FurtherReadings
from vislam.runs.offline.export_mcap import export_mcap
from vislam.runs.report import write_report
from vislam.runs.sources import open_source
from vislam.runs.verdict import Evidence, judge
from vislam.sensors import load_sensor_setup
from vislam.trajectory import align, associate, read_tum
from worlds.bag_writer import Message, types_of, write_bag

URI = "points:cart-drive,rig=none,duration_s=6"


@pytest.fixture(scope="module")
def blind(tmp_path_factory):
    out = tmp_path_factory.mktemp("blind") / "run"
    prepare(out, overwrite=False)
    return out, execute(open_source(URI), load(None, {"view.enabled": False}), out, URI, [])


def test_no_frame_without_a_camera_is_lost_or_ok(blind):
    out, metrics = blind
    with open(out / "tracking.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 60
    assert {(row["tracking"], row["localisation"]) for row in rows} == {("blind", "tracking")}
    assert metrics["counters"]["front"]["frames_lost"] == metrics["counters"]["ekf"]["vo_lost"] == 0


def test_its_report_has_no_word_and_no_band_of_vision(blind):
    page = write_report(blind[0]).read_text()
    data = json.loads(re.search(r'id="view-data">(.*?)</script>', page)[1])
    assert data["tracking"] == {} and not data["has_camera"]
    said = re.sub(r"<script.*?</script>|<style.*?</style>|<details.*?</details>", "", page, flags=re.DOTALL)
    assert "Mode: no camera, inertial." in said
    for word in ("inliers", "lost, in", "vision was degraded", "red lost", "<h2>Loops</h2>", "loops of"):
        assert word not in said


def test_a_run_without_a_camera_goes_on_where_it_was_ended(blind, tmp_path):
    def ends(*_: object) -> None:
        ended.append(1)
        if len(ended) == 35:
            raise KeyboardInterrupt

    ended: list[int] = []
    out, config = tmp_path / "run", load(None, {"view.enabled": False})
    prepare(out, overwrite=False)
    with pytest.raises(KeyboardInterrupt):
        execute(open_source(URI), config, out, URI, [], ends)
    assert run_verb(["run", "--resume", str(out)]) == 0
    assert (out / "tracking.csv").read_text() == (blind[0] / "tracking.csv").read_text()
    whole, again = (read_tum(of / "trajectory_graph.tum").positions_m for of in (blind[0], out))
    assert whole.shape == again.shape and np.abs(whole - again).max() < 0.1  # an IMU alone drifts
    export_mcap(out, tmp_path / "a.mcap")
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        sent = [reader.deserialize(raw, of.msgtype) for of, _, raw in reader.messages() if of.topic == "/odom"]
    causal = read_tum(out / "trajectory_ekf.tum")
    assert len(sent) == len(causal) > 50
    assert all(0.0 < message.twist.covariance[0] < 1.0 and message.pose.covariance[0] < 1e3 for message in sent)
    steps = np.linalg.norm(np.diff(causal.positions_m, axis=0), axis=1) / np.diff(causal.t_ns * 1e-9)
    speeds = [np.linalg.norm([m.twist.twist.linear.x, m.twist.twist.linear.y, m.twist.twist.linear.z]) for m in sent]
    assert np.abs(steps - 0.5 * (np.array(speeds)[1:] + speeds[:-1])).max() < 0.1


def test_a_map_is_refused_where_there_is_no_camera_to_recognise_it(blind, tmp_path, capsys):
    seeing = "points:cart-drive,rig=stereo,duration_s=1"
    for k, (uri, words) in enumerate(((URI, "recognises no place"), (seeing, "made without a camera"))):
        assert run_verb(["run", uri, "--map", str(blind[0]), "--out", str(tmp_path / f"run{k}")]) == 2
        assert re.search(f"^vislam: .*{words}.*leave --map away$", capsys.readouterr().err.strip())


def test_an_imu_alone_is_told_what_it_lacks(blind):
    evidence = Evidence(is_alone=True, sigma_m=3.0)
    assert "an IMU alone does not see the way" in judge(evidence, VerdictConfig()).reasons[0]
    assert blind[1]["verdict"]["evidence"]["is_alone"]


def test_a_bag_of_imu_and_wheels_is_driven(tmp_path):
    types, recording, messages = types_of("mcap"), open_source("points:cart-drive,rig=none,duration_s=15"), []
    (tmp_path / "simulated.toml").write_text('[sensors.wheels]\nkind = "wheels"\nsimulated_hz = 20.0\n')
    setup = load_sensor_setup(tmp_path / "simulated.toml")
    for value in FurtherReadings(recording, setup, 0).among(recording.events()):
        if isinstance(value, Reading):
            joints = types.make(
                "sensor_msgs/msg/JointState", header=types.header(value.t_ns, ""), name=["left", "right"],
                position=np.array([]), velocity=value.values / 0.1, effort=np.array([]),
            )  # fmt: skip
            messages.append(Message(value.t_ns, "/joints", joints))
        else:
            imu = types.imu(value.t_ns, [*value.gyro_rad_s, *value.accel_m_s2])
            messages.append(Message(value.t_ns, "/imu", imu))
    bag = write_bag(tmp_path, "mcap", messages)
    noise = (
        "gyroscope_noise_density: 4e-4\ngyroscope_random_walk: 2e-5\naccelerometer_noise_density: 3e-3\n"
        "accelerometer_random_walk: 3e-4\nrate_hz: 200\n"
    )
    (tmp_path / "drive.imu.yaml").write_text(noise)
    (tmp_path / "cart.toml").write_text(
        '[sensors.wheels]\nkind = "wheels"\nfile = "drive"\ntopic = "/joints"\n'
        'joints = {left = "left", right = "right", radius_m = 0.1}\n'
    )
    out = tmp_path / "run"
    options = ["--sensors.file", str(tmp_path / "cart.toml"), "--view.no-enabled"]
    assert run_verb(["run", str(bag), "--out", str(out), *options]) == 0
    pairs = associate(recording.truth(), read_tum(out / "trajectory_graph.tum"))
    assert pairs.aligned(align(pairs, "yaw")).position_errors_m().max() < 0.1
