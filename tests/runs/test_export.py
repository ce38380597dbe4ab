"""A run as MCAP: read back with rosbags, it says what the files of the run say."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader
from rosbags.rosbag2.storage_mcap import McapReader
from scipy.spatial.transform import Rotation

from run_folder import FRAMES, PERIOD_NS, START_NS, make_run
from vislam.cli import run_verb
from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.core.geometry import se3_exp
from vislam.core.memory import FrameEntry
from vislam.core.messages import NavState
from vislam.mapping.drive.grid import Grid, read_grid, write_grid
from vislam.mapping.formats.ply import write_ply
from vislam.runs.loaded import load_run
from vislam.runs.offline import export_mcap as exporting
from vislam.runs.offline.export_mcap import export_mcap
from vislam.runs.session import SessionWriter
from vislam.trajectory import Trajectory, write_states_csv, write_tum
from vislam.trajectory.motion_numbers import motion_of

CAMERA = Camera(640, 480, 458.0, 457.0, 320.0, 240.0)
RIG = Rig((CAMERA, CAMERA), (se3_exp(np.array([0.1, -0.2, 1.5, 0.01, 0.02, 0.03])), np.eye(4)))
POINTS, COLORS = 700, np.arange(2100).reshape(700, 3).astype(np.uint8)
CELLS = np.array([[0, 0, 1], [-1, 0, 1]], np.int8)
GRID = Grid(CELLS, 0.05, (-1.5, 2.25), -0.3)


def points() -> np.ndarray:
    return np.random.default_rng(2).normal(size=(POINTS, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with a map and a session; its session has the filter's motion at every frame."""
    folder = make_run(tmp_path_factory.mktemp("exported") / "run", loops=2)
    write_ply(folder / "map" / "cloud.ply", points(), COLORS)
    write_grid(folder / "map", GRID)
    write_grid(folder / "map", Grid(1 - np.abs(CELLS), 0.1, (0.0, 0.0), 0.0), "drive")
    writer = SessionWriter.create(folder / "session.db", {"config": {}}, RIG, None, 9.81)
    ekf = load_run(folder).trajectories["ekf"]
    for k, (t_ns, T) in enumerate(zip(ekf.t_ns.tolist(), ekf.T_world_body, strict=True)):
        writer.add_frame(FrameEntry(t_ns, k // 10, None, T, motion=motion_of(state_of(t_ns, T, k))))
    writer.close(finished=True)
    return folder


def state_of(t_ns: int, T: np.ndarray, k: int) -> NavState:
    """Return another state for each frame."""
    A = np.random.default_rng(k).normal(size=(15, 15))
    return NavState(t_ns, T, np.array([0.01 * k, -0.4, 0.3]), np.zeros(3), np.zeros(3), 1e-6 * (A @ A.T))


@pytest.fixture(scope="module")
def exported(run):
    path = run.parent / "desk.mcap"
    export_mcap(run, path)
    return path


@pytest.fixture(scope="module")
def found(exported):
    return read(exported)


def read(path: Path) -> dict[str, list]:
    """Return what AnyReader finds, by topic: stamp and message."""
    found: dict[str, list] = {}
    with AnyReader([path]) as reader:
        for connection, t_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((t_ns, message, connection))
    return found


def stamp_ns(message) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def matrix(position, q) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = [position.x, position.y, position.z]
    return T


def test_every_result_of_a_run_is_there(run, found):
    counts = {topic: len(messages) for topic, messages in found.items()}
    once = dict.fromkeys(("/tf_static", "/vislam/path", "/vislam/cloud", "/vislam/grid", "/vislam/drive"), 1)
    assert counts == {"/tf": FRAMES, "/odom": FRAMES, "/vislam/pose": FRAMES, **once}


def test_poses_are_those_of_the_graph(run, found):
    graph = load_run(run).trajectories["graph"]
    messages = found["/vislam/pose"]
    assert [t for t, _, _ in messages] == graph.t_ns.tolist() == [stamp_ns(m) for _, m, _ in messages]
    assert {m.header.frame_id for _, m, _ in messages} == {"map"}
    poses = np.array([matrix(m.pose.position, m.pose.orientation) for _, m, _ in messages])
    np.testing.assert_allclose(poses, graph.T_world_body, atol=1e-12)
    [(t_ns, path, _)] = found["/vislam/path"]
    assert (t_ns, len(path.poses)) == (START_NS, FRAMES)
    np.testing.assert_array_equal([matrix(p.pose.position, p.pose.orientation) for p in path.poses], poses)


def test_transforms_lead_from_the_map_to_the_body(run, found):
    loaded = load_run(run)
    for k, (_, message, _) in enumerate(found["/tf"]):
        first, second = message.transforms
        names = (first.header.frame_id, first.child_frame_id, second.header.frame_id, second.child_frame_id)
        assert names == ("map", "odom", "odom", "base_link")
        T_map_odom, T_odom_body = (matrix(t.transform.translation, t.transform.rotation) for t in (first, second))
        np.testing.assert_allclose(T_odom_body, loaded.trajectories["ekf"].T_world_body[k], atol=1e-12)
        np.testing.assert_allclose(T_map_odom @ T_odom_body, loaded.trajectories["graph"].T_world_body[k], atol=1e-9)
    [(_, message, connection)] = found["/tf_static"]
    assert connection.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"
    for k, mounted in enumerate(message.transforms):
        assert (mounted.header.frame_id, mounted.child_frame_id) == ("base_link", f"cam{k}")
        T = matrix(mounted.transform.translation, mounted.transform.rotation)
        np.testing.assert_allclose(T, RIG.T_body_cams[k], atol=1e-12)


def test_where_the_filter_has_no_pose_odom_is_the_map(run, tmp_path):
    bare = make_run(tmp_path / "run", loops=2)
    path = bare / "trajectory_ekf.tum"
    path.write_text("\n".join(path.read_text().splitlines()[:1] + path.read_text().splitlines()[5:]) + "\n")
    export_mcap(bare, tmp_path / "a.mcap")
    read_back = read(tmp_path / "a.mcap")
    assert (len(read_back["/odom"]), len(read_back["/tf"])) == (FRAMES - 4, FRAMES)
    first = read_back["/tf"][0][1].transforms
    np.testing.assert_allclose(
        matrix(first[0].transform.translation, first[0].transform.rotation), np.eye(4), atol=1e-12
    )
    pose = load_run(bare).trajectories["graph"].T_world_body[0]
    np.testing.assert_allclose(matrix(first[1].transform.translation, first[1].transform.rotation), pose, atol=1e-12)


def test_every_odometry_has_the_velocity_and_covariance_of_the_filter_at_its_frame(run, found):
    poses = load_run(run).trajectories["ekf"].T_world_body
    for k, (t_ns, message, _) in enumerate(found["/odom"]):
        state, linear, R = state_of(t_ns, poses[k], k), message.twist.twist.linear, poses[k, :3, :3]
        np.testing.assert_allclose(R @ [linear.x, linear.y, linear.z], state.velocity_world_m_s, atol=1e-12)
        covariance = message.pose.covariance.reshape(6, 6)
        np.testing.assert_allclose(covariance[:3, :3], state.covariance[3:6, 3:6], atol=1e-15)
        np.testing.assert_allclose(covariance[3:, 3:], R @ state.covariance[:3, :3] @ R.T, atol=1e-15)
        assert message.twist.covariance.reshape(6, 6)[:3, :3].diagonal().max() < 0.01
    assert k == FRAMES - 1


def test_chunks_are_packed(exported):
    reader = McapReader(exported)
    reader.open()
    reader.read_index()
    assert {chunk.compression for chunk in reader.chunks} == {"zstd"}


def test_without_a_session_odometry_has_the_covariance_of_its_keyframes_alone(run, tmp_path):
    bare = shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("session.db"))
    export_mcap(bare, tmp_path / "a.mcap")
    loaded = load_run(bare)
    states, messages = loaded.states["ekf"], read(tmp_path / "a.mcap")["/odom"]
    k = 5
    _, message, _ = messages[10 * k]
    assert stamp_ns(message) == states.t_ns[k] == START_NS + 10 * k * PERIOD_NS
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
    covariance = message.pose.covariance.reshape(6, 6)
    R = loaded.trajectories["ekf"].T_world_body[10 * k, :3, :3]
    np.testing.assert_allclose(covariance[:3, :3], states.covariance[k, 3:6, 3:6])
    np.testing.assert_allclose(covariance[3:, 3:], R @ states.covariance[k, :3, :3] @ R.T, atol=1e-15)
    assert message.twist.covariance.reshape(6, 6)[5, 5] == 1e9  # no state holds the rate
    _, between, _ = messages[10 * k + 1]
    assert np.diag(between.pose.covariance.reshape(6, 6)).tolist() == [1e9] * 6


def test_the_covariances_of_a_turned_and_moving_body_are_those_of_samples(tmp_path):
    rng = np.random.default_rng(7)
    A = rng.normal(size=(15, 15))
    covariance, R = 1e-6 * (A @ A.T), Rotation.from_rotvec([0.3, -0.7, 1.1]).as_matrix()
    velocity_world = np.array([1.2, -0.4, 0.3])
    T = np.eye(4)
    T[:3, :3] = R
    for name in ("ekf", "graph"):
        write_tum(Trajectory(np.array([START_NS]), T[None]), tmp_path / f"trajectory_{name}.tum")
    state = NavState(START_NS, T, velocity_world, np.zeros(3), np.zeros(3), covariance)
    write_states_csv(tmp_path / "states_ekf.csv", [0], [state])
    export_mcap(tmp_path, tmp_path / "a.mcap")
    [(_, message, _)] = read(tmp_path / "a.mcap")["/odom"]
    linear, of_pose = message.twist.twist.linear, message.pose.covariance.reshape(6, 6)
    of_velocity = message.twist.covariance.reshape(6, 6)[:3, :3]
    np.testing.assert_allclose([linear.x, linear.y, linear.z], R.T @ velocity_world, atol=1e-8)
    errors = rng.multivariate_normal(np.zeros(15), covariance, 200_000)
    turned = errors[:, :3] @ R.T  # exp(R d) R is R exp(d)
    np.testing.assert_allclose(of_pose, np.cov(np.hstack([errors[:, 3:6], turned]).T), atol=2e-7)
    back = Rotation.from_matrix(R) * Rotation.from_rotvec(errors[:, :3])
    moved = back.inv().apply(velocity_world + errors[:, 6:9])
    np.testing.assert_allclose(of_velocity, np.cov(moved.T), atol=2e-7)


def cloud_of(message) -> tuple[np.ndarray, np.ndarray]:
    assert [(f.name, f.offset, f.datatype, f.count) for f in message.fields] == [
        (name, 4 * k, 7, 1) for k, name in enumerate(("x", "y", "z", "rgb"))
    ]
    rows = np.frombuffer(message.data.tobytes(), np.dtype([("xyz", "<f4", 3), ("rgb", "<u4")]))
    assert (message.width * message.height, message.point_step, message.row_step) == (len(rows), 16, 16 * len(rows))
    rgb = np.stack([rows["rgb"] >> 16, rows["rgb"] >> 8 & 255, rows["rgb"] & 255], axis=1)
    return rows["xyz"], rgb.astype(np.uint8)


def test_the_cloud_comes_back_with_its_colours(found):
    [(_, message, _)] = found["/vislam/cloud"]
    xyz, rgb = cloud_of(message)
    np.testing.assert_array_equal(xyz, points())
    np.testing.assert_array_equal(rgb, COLORS)
    assert message.header.frame_id == "map"


def test_a_large_cloud_comes_in_bounded_messages(run, tmp_path, monkeypatch):
    monkeypatch.setattr(exporting, "_CLOUD_POINTS", 256)
    monkeypatch.setattr(exporting, "_PATH_POSES", 100)
    export_mcap(run, tmp_path / "a.mcap")
    found = read(tmp_path / "a.mcap")
    parts = [cloud_of(message)[0] for _, message, _ in found["/vislam/cloud"]]
    assert [len(part) for part in parts] == [256, 256, 188]
    np.testing.assert_array_equal(np.concatenate(parts), points())
    assert len(found["/vislam/path"][0][1].poses) == 100


def test_grids_begin_at_their_lowest_corner(found):
    [(_, message, _)] = found["/vislam/grid"]
    assert (message.info.width, message.info.height) == (3, 2)
    assert message.info.resolution == pytest.approx(0.05)
    assert (message.info.origin.position.x, message.info.origin.position.y) == (-1.5, 2.25)
    np.testing.assert_array_equal(message.data.reshape(2, 3), [[0, 0, 100], [-1, 0, 100]])


def test_two_exports_are_the_same_bytes(run, exported, tmp_path):
    again = tmp_path / exported.name
    export_mcap(run, again)
    assert again.read_bytes() == exported.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == [exported.name]


def test_a_run_without_a_map_says_what_it_leaves_out(tmp_path, capsys):
    bare = make_run(tmp_path / "run", loops=2)
    assert run_verb(["export", str(bare), "--mcap", str(tmp_path / "a.mcap")]) == 0
    told = capsys.readouterr().out
    assert f"left out /vislam/cloud: {bare}/map/cloud.ply is not there; `vislam map {bare} --products cloud`" in told
    assert "left out /tf_static" in told and "/vislam/pose: 1200\n" in told
    assert "/vislam/cloud" not in read(tmp_path / "a.mcap")


def test_without_a_graph_the_filter_is_exported_in_odom(run, tmp_path):
    bare = make_run(tmp_path / "run", loops=2)
    (bare / "trajectory_graph.tum").unlink()
    (bare / "states_ekf.csv").unlink()
    export_mcap(bare, tmp_path / "a.mcap")
    found = read(tmp_path / "a.mcap")
    assert found["/vislam/pose"][0][1].header.frame_id == "odom"
    assert [t.child_frame_id for t in found["/tf"][0][1].transforms] == ["base_link"]
    assert found["/odom"][0][1].pose.covariance[0] == 1e9


@pytest.mark.parametrize(
    ("name", "code", "told"),
    [
        ("a.bag", 2, "must end in .mcap"),
        ("there.mcap", 2, "exists; choose another name"),
        ("no/folder/a.mcap", 3, "cannot be written"),
    ],
)
def test_a_file_that_cannot_be_is_refused(run, tmp_path, capsys, name, code, told):
    (tmp_path / "there.mcap").touch()
    assert run_verb(["export", str(run), "--mcap", str(tmp_path / name)]) == code
    said = capsys.readouterr().err
    assert told in said and len(said.splitlines()) == 1


def test_what_is_no_run_is_refused_and_leaves_no_file(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "absent", tmp_path / "empty"):
        assert run_verb(["export", str(folder), "--mcap", str(tmp_path / "a.mcap")]) == 3
        assert len(capsys.readouterr().err.splitlines()) == 1
    only = make_run(tmp_path / "only", loops=2)
    for name in ("ekf", "graph", "live"):
        (only / f"trajectory_{name}.tum").unlink()
    assert run_verb(["export", str(only), "--mcap", str(tmp_path / "a.mcap")]) == 3
    assert "neither trajectory_graph.tum nor" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.mcap")) and not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("name", ["map/cloud.ply", "map/grid.pgm", "map/grid.yaml", "session.db"])
def test_a_damaged_file_is_named_and_no_half_is_left(run, tmp_path, capsys, name):
    copied = shutil.copytree(run, tmp_path / "run")
    content = (copied / name).read_bytes()
    (copied / name).write_bytes(content[: len(content) // 2])
    assert run_verb(["export", str(copied), "--mcap", str(tmp_path / "a.mcap")]) == 3
    said = capsys.readouterr().err
    assert name in said and len(said.splitlines()) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_a_stamp_before_1970_cannot_be_told_in_ros(tmp_path, capsys):
    write_tum(Trajectory(np.array([-5]), np.eye(4)[None]), tmp_path / "trajectory_graph.tum")
    assert run_verb(["export", str(tmp_path), "--mcap", str(tmp_path / "a.mcap")]) == 3
    assert "a stamp of -5 ns cannot be expressed in ROS" in capsys.readouterr().err


def test_without_rosbags_the_extra_is_named(run, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    assert run_verb(["export", str(run), "--mcap", str(tmp_path / "a.mcap")]) == 2
    assert ".[bags]" in capsys.readouterr().err


@given(cut=st.integers(0, 200), at=st.integers(0, 199), byte=st.integers(0, 255), of_image=st.booleans())
def test_damaged_grids_are_read_or_refused(tmp_path_factory, cut, at, byte, of_image):
    folder = tmp_path_factory.mktemp("grid")
    write_grid(folder, GRID)
    path = folder / ("grid.pgm" if of_image else "grid.yaml")
    content = bytearray(path.read_bytes()[: cut or None])
    if content:
        content[at % len(content)] = byte
    path.write_bytes(content)
    try:
        grid = read_grid(folder)
    except DataError as error:
        assert "grid." in str(error)
    else:
        assert grid.cells.size and set(np.unique(grid.cells)) <= {-1, 0, 1}
