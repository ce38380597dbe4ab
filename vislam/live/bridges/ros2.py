"""The published pose for ROS 2: nav_msgs/Odometry, tf, map, scan, health word and diagnostics over DDS, without ROS.

Only its own process imports this. Needs cyclonedds.
"""

import math
import time
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from vislam.core.messages import Array
from vislam.hw.health import Health
from vislam.live.bridges.ros2_node import KEPT, Node
from vislam.live.bridges.ros2_types import (
    DiagnosticArray,
    DiagnosticStatus,
    Header,
    KeyValue,
    LaserScan,
    MapMetaData,
    OccupancyGrid,
    Odometry,
    Point,
    Pose,
    PoseWithCovariance,
    Quaternion,
    TFMessage,
    Transform,
    TransformStamped,
    Twist,
    TwistWithCovariance,
    UInt32,
    Vector3,
    quaternion,
    stamp,
)
from vislam.live.notices import MapCells
from vislam.live.wire.published_pose import PublishedPose

_NS = 1_000_000_000
_DIAGNOSED_NS = _NS  # between diagnostics
_SCANNED_NS = _NS // 10  # between scans
_STATES = Health.LEVELLED | Health.VISION_OK | Health.AT_REST | Health.MAG_OK  # bits that are no fault
OK, WARN, ERROR = range(3)
_OCCUPIED = 100
_RAYS = 360
_NEAREST_M, _FARTHEST_M = 0.3, 8.0  # nearer is the cart itself
_STEP = 0.5  # of a cell, between looks along a ray


def occupancy_grid(cells: MapCells, stamp_ns: int) -> Any:
    """Return an `OccupancyGrid` in the frame `map`: 100 where the cart cannot drive, 0 where it can, -1 unknown.

    Its body's size is left to inflation, as nav2 has it; row 0 is at the lowest y.
    """
    rows, columns = cells.states.shape
    origin = Pose(Point(*cells.origin_m, cells.floor_m), Quaternion(0.0, 0.0, 0.0, 1.0))
    info = MapMetaData(stamp(stamp_ns), cells.resolution_m, columns, rows, origin)
    values = np.where(cells.states > 0, np.int8(_OCCUPIED), cells.states)
    return OccupancyGrid(Header(stamp(stamp_ns), "map"), info, values.ravel().tolist())


def scan(cells: MapCells, T_map_base: Array, stamp_ns: int) -> Any:
    """Return a `LaserScan` in the frame `base_link` of what the cart would touch, from a pose [4, 4] in the map.

    Ranges are those to the first cell where the cart cannot drive; infinite where all is free as far as a scan goes,
    NaN where it comes to what was not seen (REP-117).
    """
    yaw = math.atan2(T_map_base[1, 0], T_map_base[0, 0])
    step_rad = 2.0 * math.pi / _RAYS
    bearings = -math.pi + step_rad * np.arange(_RAYS)
    ranges = np.arange(_NEAREST_M, _FARTHEST_M, _STEP * cells.resolution_m)
    ways = np.stack([np.cos(yaw + bearings), np.sin(yaw + bearings)], axis=1)
    places = T_map_base[:2, 3] + ways[:, None] * ranges[:, None]  # [rays, ranges, 2]
    at = np.floor((places - cells.origin_m) / cells.resolution_m).astype(np.int64)
    inside = ((at >= 0) & (at < cells.states.shape[::-1])).all(axis=2)
    column, row = np.where(inside[..., None], at, 0).transpose(2, 0, 1)
    states = np.where(inside, cells.states[row, column], -1)
    ends = states != 0
    first = ends.argmax(axis=1)
    met = np.where(np.take_along_axis(states, first[:, None], axis=1)[:, 0] > 0, ranges[first], np.nan)
    found = np.where(ends.any(axis=1), met, np.inf)
    return LaserScan(
        Header(stamp(stamp_ns), "base_link"), -math.pi, -math.pi + step_rad * (_RAYS - 1), step_rad, 0.0, 0.1,
        _NEAREST_M, _FARTHEST_M, found.tolist(), [],
    )  # fmt: skip


class Ros2:
    """Owns the node /vislam: /odom, /tf, /tf_static, /map, /scan, /vislam/health and /diagnostics."""

    def __init__(self, domain: int, sensors: Mapping[str, Array] | None = None, allow_remote: bool = False) -> None:
        """Join a domain.

        Args:
            domain: what ROS_DOMAIN_ID is for the others.
            sensors: `T_base_sensor` [4, 4] by frame.
            allow_remote: use the interfaces that CYCLONEDDS_URI or the system names; else the loopback one alone.
        """
        self.node = Node(domain, "vislam", allow_remote)
        self._odom = self.node.writer("odom", Odometry)
        self._tf = self.node.writer("tf", TFMessage)
        self._health = self.node.writer("vislam/health", UInt32)
        self._diagnostics = self.node.writer("diagnostics", DiagnosticArray)
        self._static = self.node.writer("tf_static", TFMessage, KEPT)
        self._static.write(_transforms([("base_link", name, T) for name, T in (sensors or {}).items()], time.time_ns()))
        self._map = self.node.writer("map", OccupancyGrid, KEPT)
        self._scan = self.node.writer("scan", LaserScan)
        self.node.announce()
        self._cells: MapCells | None = None
        self._diagnosed_ns = self._scanned_ns = 0

    def see(self, cells: MapCells) -> None:
        """Write the map as it is now."""
        self._cells = cells
        self._map.write(occupancy_grid(cells, time.time_ns()))

    def send(self, pose: PublishedPose) -> None:
        """Write all; of a pose not to steer by health word and diagnostics alone, as an Odometry cannot say so."""
        self._health.write(UInt32(int(pose.health)))
        clock_ns = max(time.time_ns() - time.monotonic_ns() for _ in range(3))  # less when interrupted
        if pose.published_ns - self._diagnosed_ns >= _DIAGNOSED_NS:
            self._diagnosed_ns = pose.published_ns
            self._diagnostics.write(diagnosis(pose, pose.published_ns + clock_ns))
        if Health.INVALID in pose.health or not np.isfinite(pose.pose_covariance).all():
            return
        stamp_ns = pose.t_ns + clock_ns
        self._odom.write(odometry(pose, stamp_ns))
        self._tf.write(transforms(pose, stamp_ns))
        is_due = pose.published_ns - self._scanned_ns >= _SCANNED_NS
        if is_due and self._cells is not None and Health.NOT_IN_MAP not in pose.health:
            self._scanned_ns = pose.published_ns
            self._scan.write(scan(self._cells, pose.T_map_base, stamp_ns))

    def close(self) -> None:
        """Leave the domain; may be called twice."""
        vars(self).clear()  # an entity leaves when it is let go


def odometry(pose: PublishedPose, stamp_ns: int) -> Any:
    """Return an `Odometry`: pose in `odom`, twist in `base_link`; the stamp is of CLOCK_REALTIME, as ROS's are."""
    T = pose.T_odom_base
    return Odometry(
        Header(stamp(stamp_ns), "odom"),
        "base_link",
        PoseWithCovariance(Pose(Point(*T[:3, 3].tolist()), quaternion(T)), pose.pose_covariance.ravel().tolist()),
        TwistWithCovariance(
            Twist(Vector3(*pose.velocity_m_s.tolist()), Vector3(*pose.rate_rad_s.tolist())),
            pose.twist_covariance.ravel().tolist(),
        ),
    )


def transforms(pose: PublishedPose, stamp_ns: int) -> Any:
    """Return a `TFMessage`.

    odom -> base_link, which never jumps, and map -> odom, which loops correct, while the place is known.
    """
    frames = (("map", "odom", pose.T_map_odom), ("odom", "base_link", pose.T_odom_base))
    return _transforms(frames[Health.NOT_IN_MAP in pose.health :], stamp_ns)


def diagnosis(pose: PublishedPose, stamp_ns: int) -> Any:
    """Return a `DiagnosticArray`: an error of a pose not to steer by, a warning of any fault; each bit by its name."""
    faults = pose.health & ~_STATES
    is_bad = Health.INVALID in pose.health or Health.LEVELLED not in pose.health
    names = [str(bit.name) for bit in faults] + ([] if Health.LEVELLED in pose.health else ["not LEVELLED"])
    values = [KeyValue(str(bit.name), str(bit in pose.health)) for bit in Health]
    level = ERROR if is_bad else WARN if faults else OK
    status = DiagnosticStatus(level, "vislam: pose", ", ".join(names) or "OK", "vislam", values)
    return DiagnosticArray(Header(stamp(stamp_ns), ""), [status])


def _transforms(frames: Iterable[tuple[str, str, Array]], stamp_ns: int) -> Any:
    """Return a `TFMessage` of parents, children and `T_parent_child` [4, 4]."""
    return TFMessage(
        [
            TransformStamped(
                Header(stamp(stamp_ns), parent), child, Transform(Vector3(*T[:3, 3].tolist()), quaternion(T))
            )
            for parent, child, T in frames
        ]
    )
