"""A finished run as one MCAP file, which ROS 2 tools, Foxglove and rosbags open.

What is made once of the whole run (path, clouds, grids, extrinsics) stands at the first stamp, so that a player shows
it from the beginning. The same run gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from vislam.core.camera import Rig
from vislam.core.errors import DataError, UsageError
from vislam.core.files import partial_folder
from vislam.core.geometry import invert_many
from vislam.core.messages import Array, NavState
from vislam.mapping.drive.grid import read_grid
from vislam.mapping.formats.ply import read_ply
from vislam.runs.loaded import KeyframeStates, LoadedRun, load_run
from vislam.runs.offline.ros_messages import BASE, MAP, ODOM, UNKNOWN_VARIANCE, RosMessages, kept_for_late_joiners
from vislam.runs.session import Session
from vislam.trajectory import Trajectory
from vislam.trajectory.motion_numbers import motion_of, motion_parts

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Writer

_CLOUD_POINTS = 1 << 20  # of one message: 16 MiB
_PATH_POSES = 10_000  # of the one message that draws a line; the poses themselves are all there
_VERSION: Literal[8] = 8  # of rosbag2's metadata: ROS 2 Humble reads no later one
_UNKNOWN_6, _UNKNOWN_3 = UNKNOWN_VARIANCE * np.eye(6), UNKNOWN_VARIANCE * np.eye(3)


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written: messages by topic, and what was left out, with the reason."""

    path: Path
    messages: dict[str, int]
    left_out: dict[str, str]


def export_mcap(run: Path, path: Path) -> Exported:
    """Write the results of a run as MCAP.

    Args:
        run: the folder of the run.
        path: a new file, NAME.mcap; it appears whole or not at all.

    Raises:
        UsageError: the file exists or has another suffix, or rosbags is not installed.
        DataError: there is no run, it has no pose, or a file of it is damaged.
        StorageError: the file cannot be written.
    """
    if path.suffix != ".mcap":
        raise UsageError(f"--mcap {path} must end in .mcap, by which other programs know the format")
    if path.exists():
        raise UsageError(f"--mcap {path} exists; choose another name, or remove it")
    messages = RosMessages()
    loaded = load_run(run)
    poses, frame = _placed(loaded)
    with _bag(path) as bag:
        topics = _Topics(bag, messages)
        first_ns = min(int(line.t_ns[0]) for line in (poses, loaded.trajectories.get("ekf", poses)) if len(line))
        _write_once(topics, loaded, poses, frame, first_ns)
        _write_poses(topics, loaded, poses, frame)
        return Exported(path, dict(sorted(topics.counts.items())), topics.left_out)


class _Topics:
    """Opens topics as they come, and counts what was written to each."""

    def __init__(self, bag: Writer, messages: RosMessages) -> None:
        self.make = messages
        self.counts: dict[str, int] = {}
        self.left_out: dict[str, str] = {}
        self._bag = bag
        self._open: dict[str, Connection] = {}

    def write(self, topic: str, kind: str, t_ns: int, data: bytes, once: bool = False) -> None:
        if topic not in self._open:
            qos = [kept_for_late_joiners()] if once else []
            self._open[topic] = self._bag.add_connection(
                topic, kind, typestore=self.make.store, offered_qos_profiles=qos
            )
            self.counts[topic] = 0
        self._bag.write(self._open[topic], t_ns, data)
        self.counts[topic] += 1


def _placed(loaded: LoadedRun) -> tuple[Trajectory, str]:
    """Return the best trajectory of a run and its frame: the graph's in map, else the filter's in odom."""
    for name, frame in (("graph", MAP), ("ekf", ODOM)):
        if len(found := loaded.trajectories.get(name, ())):
            assert isinstance(found, Trajectory)
            return found, frame
    raise DataError(
        f"{loaded.folder} has neither trajectory_graph.tum nor trajectory_ekf.tum with a pose; "
        f"`vislam run --resume {loaded.folder}` where it was killed"
    )


def _write_once(topics: _Topics, loaded: LoadedRun, poses: Trajectory, frame: str, t_ns: int) -> None:
    """Write what is said once: the path, the extrinsics, the map."""
    stride = -(-len(poses) // _PATH_POSES)
    line = topics.make.path(t_ns, poses.t_ns[::stride].tolist(), poses.T_world_body[::stride], frame)
    topics.write("/vislam/path", "nav_msgs/msg/Path", t_ns, line, once=True)
    rig = _rig(loaded.folder)
    if isinstance(rig, Rig):
        mounted = [(BASE, f"cam{i}", T) for i, T in enumerate(rig.T_body_cams)]
        topics.write("/tf_static", "tf2_msgs/msg/TFMessage", t_ns, topics.make.transforms(t_ns, mounted), once=True)
    else:
        topics.left_out["/tf_static"] = rig
    _write_cloud(topics, loaded.folder, t_ns)
    for name in ("grid", "drive"):
        if not (loaded.folder / "map" / f"{name}.yaml").is_file():
            topics.left_out[f"/vislam/{name}"] = _not_there(loaded.folder, name, f"{name}.yaml")
            continue
        data = topics.make.grid(t_ns, read_grid(loaded.folder / "map", name), MAP)
        topics.write(f"/vislam/{name}", "nav_msgs/msg/OccupancyGrid", t_ns, data, once=True)


def _write_cloud(topics: _Topics, run: Path, t_ns: int) -> None:
    path = run / "map" / "cloud.ply"
    if not path.is_file():
        topics.left_out["/vislam/cloud"] = _not_there(run, "cloud", path.name)
        return
    points, colors = read_ply(path)
    for start in range(0, max(len(points), 1), _CLOUD_POINTS):
        part = slice(start, start + _CLOUD_POINTS)
        data = topics.make.cloud(t_ns, points[part], colors[part], MAP)
        topics.write("/vislam/cloud", "sensor_msgs/msg/PointCloud2", t_ns, data, once=True)


def _not_there(run: Path, product: str, name: str) -> str:
    return f"{run / 'map' / name} is not there; `vislam map {run} --products {product}` makes it"


def _rig(run: Path) -> Rig | str:
    """Return the cameras of a run, or why they are not known."""
    if not (run / "session.db").is_file():
        return f"{run / 'session.db'}, which holds the cameras' poses, is not there"
    with Session(run / "session.db") as session:
        return session.rig()


def _write_poses(topics: _Topics, loaded: LoadedRun, poses: Trajectory, frame: str) -> None:
    """Write poses, odometry and transforms in the order of their time."""
    ekf = loaded.trajectories.get("ekf")
    causal = {} if ekf is None else dict(zip(ekf.t_ns.tolist(), ekf.T_world_body, strict=True))
    if not causal:
        topics.left_out["/odom"] = f"{loaded.folder / 'trajectory_ekf.tum'} is not there, or holds no pose"
    motions = _motions(loaded)
    placed = dict(zip(poses.t_ns.tolist(), poses.T_world_body, strict=True))
    for t_ns in sorted({*causal, *placed}):
        T_odom_body, T_map_body = causal.get(t_ns), placed.get(t_ns)
        if T_odom_body is not None:
            _write_odometry(topics, t_ns, T_odom_body, motions.get(t_ns))
        if T_map_body is not None:
            topics.write(
                "/vislam/pose", "geometry_msgs/msg/PoseStamped", t_ns, topics.make.pose(t_ns, T_map_body, frame)
            )
        if frame == MAP and T_map_body is not None:
            tied = _tree(T_map_body, T_odom_body)
            topics.write("/tf", "tf2_msgs/msg/TFMessage", t_ns, topics.make.transforms(t_ns, tied))
        elif frame == ODOM and T_odom_body is not None:
            tied = [(ODOM, BASE, T_odom_body)]
            topics.write("/tf", "tf2_msgs/msg/TFMessage", t_ns, topics.make.transforms(t_ns, tied))


def _tree(T_map_body: Array, T_odom_body: Array | None) -> list[tuple[str, str, Array]]:
    """Return map -> odom -> base_link, whose product is the pose in the map; without the filter's, odom is the map."""
    T_odom_body = T_map_body if T_odom_body is None else T_odom_body
    return [(MAP, ODOM, T_map_body @ invert_many(T_odom_body[None])[0]), (ODOM, BASE, T_odom_body)]


def _motions(loaded: LoadedRun) -> dict[int, Array]:
    """Return the motion [30] of the filter by stamp: of every frame, of keyframes alone in a run of before."""
    keyframes = loaded.states.get("ekf")
    found = {} if keyframes is None else {state.t_ns: motion_of(state) for state in _as_states(keyframes)}
    if (path := loaded.folder / "session.db").is_file():
        with Session(path) as session:
            found |= {frame.t_ns: frame.motion for frame in session.frames() if frame.motion is not None}
    return found


def _as_states(states: KeyframeStates) -> Iterator[NavState]:
    columns = (states.T_world_body, states.velocity_world_m_s, states.gyro_bias_rad_s, states.accel_bias_m_s2)
    for t_ns, *values in zip(states.t_ns.tolist(), *columns, states.covariance, strict=True):
        yield NavState(t_ns, *values)


def _write_odometry(topics: _Topics, t_ns: int, T_odom_body: Array, motion: Array | None) -> None:
    velocity, of_pose, of_velocity = np.zeros(3), _UNKNOWN_6, _UNKNOWN_3
    if motion is not None:
        moves, pose, moving = motion_parts(motion)
        of_pose = pose if np.isfinite(pose).all() else of_pose
        if np.isfinite(moves).all() and np.isfinite(moving).all():
            velocity, of_velocity = moves, moving
    data = topics.make.odometry(t_ns, T_odom_body, velocity, of_pose, of_velocity)
    topics.write("/odom", "nav_msgs/msg/Odometry", t_ns, data)


@contextmanager
def _bag(path: Path) -> Iterator[Writer]:
    """Open a bag that becomes the file `path` when the block ends well, and vanishes when it does not."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    with partial_folder(path) as folder:
        bag = Writer(folder / path.stem, version=_VERSION, storage_plugin=StoragePlugin.MCAP)
        bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)  # of MCAP's chunks
        bag.open()
        try:
            yield bag
        except BaseException:
            bag.abort()
            raise
        bag.close()
        (folder / path.stem / path.name).replace(path)
