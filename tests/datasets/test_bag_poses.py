"""Topics of bags evaluated as trajectories, each type of message, as estimate and as reference."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.cli import run_verb
from vislam.core import DataError
from vislam.datasets.bags import trajectory_of_topic
from worlds.bag_writer import Message, Types, types_of, write_bag

START_NS, COUNT = 1_700_000_000_000_000_000, 60
KINDS = ("bag", "db3", "mcap", "mcap-zstd")


def pose(k: int) -> tuple[int, list[float], list[float]]:
    t = 0.1 * k
    turn = Rotation.from_euler("ZY", [0.2 * t, 0.1]).as_quat()
    return START_NS + k * 100_000_000, [3 * np.cos(0.2 * t), 3 * np.sin(0.2 * t), 0.1 * t], turn.tolist()


def with_covariance(types: Types, k: int) -> Any:
    _, place, turn = pose(k)
    return types.make("geometry_msgs/msg/PoseWithCovariance", pose=types.pose(place, turn), covariance=np.zeros(36))


def odometry(types: Types, k: int) -> Any:
    twist = types.make("geometry_msgs/msg/Twist", linear=types.vector([0, 0, 0]), angular=types.vector([0, 0, 0]))
    return types.make(
        "nav_msgs/msg/Odometry", header=types.header(pose(k)[0], "odom"), child_frame_id="base",
        pose=with_covariance(types, k),
        twist=types.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )  # fmt: skip


def way(types: Types, upto: int, timed: bool = True) -> Any:
    poses = [types.pose_stamped(t if timed else 0, *rest) for t, *rest in map(pose, range(upto))]
    return types.make("nav_msgs/msg/Path", header=types.header(pose(upto)[0], "map"), poses=poses)


def messages(types: Types) -> Iterator[Message]:
    for k in range(COUNT):
        t, place, turn = pose(k)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_quat(turn).as_matrix(), place
        header = types.header(t, "map")
        yield Message(t, "/odom", odometry(types, k))
        yield Message(t, "/pose", types.pose_stamped(t, place, turn))
        yield Message(t, "/vicon", types.transforms(t, [("world", "body", T)]).transforms[0])
        covered = types.make(
            "geometry_msgs/msg/PoseWithCovarianceStamped", header=header, pose=with_covariance(types, k)
        )
        yield Message(t, "/amcl", covered)
        yield Message(
            t, "/leica", types.make("geometry_msgs/msg/PointStamped", header=header, point=types.point(place))
        )
        if k % 10 == 9:
            yield Message(t, "/path", way(types, k + 1))
            yield Message(t, "/untimed", way(types, k + 1, timed=False))
    yield Message(t, "/path", way(types, 5))  # a planner began anew


@pytest.mark.parametrize("kind", KINDS)
def test_every_type_gives_its_poses(kind: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path, kind, messages(types_of(kind)))
    wanted = [pose(k) for k in range(COUNT)]
    for topic in ("odom", "/pose", "/vicon", "/amcl", "/leica", "/path"):
        found, words = trajectory_of_topic(path, topic)
        assert found.t_ns.tolist() == [t for t, _, _ in wanted], topic
        np.testing.assert_allclose(found.positions_m, [place for _, place, _ in wanted])
        assert found.has_rotation == (topic != "/leica")
        assert f"{topic.strip('/')}, " in words and "60 poses over 5.9 s" in words
        if found.has_rotation:
            R = Rotation.from_quat([turn for _, _, turn in wanted]).as_matrix()
            np.testing.assert_allclose(found.T_world_body[:, :3, :3], R, atol=1e-12)
    with pytest.raises(DataError, match="no times of their own"):
        trajectory_of_topic(path, "/untimed")
    with pytest.raises(DataError, match=r"which topic holds the poses.*/amcl, /leica, /odom"):
        trajectory_of_topic(path, "")
    with pytest.raises(DataError, match=r"topic=/none: no such topic; .*/odom"):
        trajectory_of_topic(path, "/none")


def test_a_bag_is_evaluated_against_a_topic_of_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = str(write_bag(tmp_path, "mcap", messages(types_of("mcap"))))
    assert run_verb(["eval", bag, "--topic", "/odom", "--reference", bag, "--reference-topic", "/path", "--json"]) == 0
    entry = json.loads(capsys.readouterr().out)["drive"]
    assert (entry["matched"], entry["coverage"]) == (60, 1.0)
    assert entry["ate_rmse_m"] < 1e-9
    assert "/odom, Odometry; 60 poses" in entry["estimate"] and "/path, Path; 60 poses" in entry["reference"]
    text = tmp_path / "a.tum"
    text.write_text("1 0 0 0 0 0 0 1\n")
    assert run_verb(["eval", str(text), "--topic", "/odom", "--reference", bag]) == 2
    assert run_verb(["eval", bag, "--topic", "/none", "--reference", bag]) == 3


def test_one_topic_of_poses_needs_no_name_and_a_damaged_bag_gives_one_line(tmp_path: Path) -> None:
    types = types_of("bag")
    path = write_bag(tmp_path, "bag", (m for m in messages(types) if m.topic == "/path"))
    assert len(trajectory_of_topic(path, "")[0]) == COUNT
    path.write_bytes(b"#ROSBAG V2.0\n" + bytes(200))
    with pytest.raises(DataError):
        trajectory_of_topic(path, "/path")


@pytest.mark.parametrize("kind", KINDS)
def test_two_frames_of_a_tree_of_transforms_are_a_trajectory(kind: str, tmp_path: Path) -> None:
    types = types_of(kind)

    def moved(x_m: float) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3], T[0, 3] = Rotation.from_euler("Z", 0.1 * x_m).as_matrix(), x_m
        return T

    tree = (
        Message(t, "/tf", types.transforms(t, [("odom", "base_link", moved(0.1 * k)), ("map", "odom", moved(5.0))]))
        for k in range(COUNT)
        for t in [START_NS + k * 100_000_000]
    )
    still = Message(START_NS, "/tf_static", types.transforms(START_NS, [("base_link", "imu", moved(2.0))]))
    path = write_bag(tmp_path, kind, [*tree, still])
    found, words = trajectory_of_topic(path, "/tf:odom:/base_link")
    np.testing.assert_allclose(found.positions_m[:, 0], 0.1 * np.arange(COUNT))
    assert found.has_rotation and words.startswith("/tf:odom:/base_link, ") and "60 poses over 5.9 s" in words
    found, _ = trajectory_of_topic(path, "/tf:map:imu")
    wanted = [moved(5.0) @ moved(0.1 * k) @ moved(2.0) for k in range(COUNT)]
    np.testing.assert_allclose(found.T_world_body, wanted, atol=1e-12)
    for name, told in (
        ("/tf", "topic=/tf: it holds transforms between many frames; name two: /tf:odom:base_link"),
        ("tf:base_link:map", "no transform base_link:map on /tf; there are base_link:imu, map:odom, odom:base_link"),
        ("/tf:base_link:imu", "no transform base_link:imu on /tf"),  # which keeps still
        ("/tf:odom", "no transform odom on /tf; there are base_link:imu, map:odom, odom:base_link"),
        ("/none:a:b", "topic=/none: no such topic"),
    ):
        with pytest.raises(DataError) as refused:
            trajectory_of_topic(path, name)
        assert told in str(refused.value)
