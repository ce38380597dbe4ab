"""Values of vislam as ROS 2 messages in CDR, through the types of `rosbags`; nothing of ROS is needed.

Frames are those of REP-105: `map`, `odom` and `base_link`, which is the run's body. Units are ROS's: metres, radians,
seconds.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError, UsageError, install_line
from vislam.core.geometry import quaternion_xyzw_from_rotation
from vislam.core.messages import Array
from vislam.mapping.drive.grid import GridImage

if TYPE_CHECKING:
    from rosbags.interfaces import Qos

MAP, ODOM, BASE = "map", "odom", "base_link"
UNKNOWN_VARIANCE = 1e9  # of what a run does not say: zero would claim certainty
_LATEST_NS = 2**31 * 10**9  # ROS counts seconds in 32 bits with a sign
_POINT = np.dtype([("xyz", "<f4", 3), ("bgr", "u1", 3), ("none", "u1")])


class RosMessages:
    """Makes messages of one set of types; each method returns CDR bytes, little-endian."""

    def __init__(self) -> None:
        """Load the types; raises UsageError where rosbags is not installed."""
        try:
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise UsageError(f"--mcap needs rosbags, of the extra 'bags': {install_line('bags')}") from error
        self.store = get_typestore(Stores.ROS2_HUMBLE)

    def pose(self, t_ns: int, T_frame_body: Array, frame: str) -> bytes:
        """Return a geometry_msgs/PoseStamped."""
        return self._bytes(
            "geometry_msgs/msg/PoseStamped", header=self._header(t_ns, frame), pose=self._pose(T_frame_body)
        )

    def path(self, t_ns: int, stamps_ns: Iterable[int], poses: Array, frame: str) -> bytes:
        """Return a nav_msgs/Path of poses [N, 4, 4]."""
        stamped = [
            self._make("geometry_msgs/msg/PoseStamped", header=self._header(at_ns, frame), pose=self._pose(T))
            for at_ns, T in zip(stamps_ns, poses, strict=True)
        ]
        return self._bytes("nav_msgs/msg/Path", header=self._header(t_ns, frame), poses=stamped)

    def odometry(
        self,
        t_ns: int,
        T_odom_body: Array,
        velocity_body_m_s: Array,
        pose_covariance: Array,
        velocity_covariance: Array,
    ) -> bytes:
        """Return a nav_msgs/Odometry; the angular rate is not known to a run, as its variance shows.

        Args:
            t_ns: its stamp.
            T_odom_body: [4, 4].
            velocity_body_m_s: [3] in axes of the body.
            pose_covariance: [6, 6] position, then rotation about X, Y, Z, in axes of `odom`.
            velocity_covariance: [3, 3] in axes of the body.
        """
        twist = np.diag(np.full(6, UNKNOWN_VARIANCE))
        twist[:3, :3] = velocity_covariance
        zero = self._vector(np.zeros(3))
        return self._bytes(
            "nav_msgs/msg/Odometry",
            header=self._header(t_ns, ODOM),
            child_frame_id=BASE,
            pose=self._make(
                "geometry_msgs/msg/PoseWithCovariance", pose=self._pose(T_odom_body), covariance=pose_covariance.ravel()
            ),
            twist=self._make(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self._make("geometry_msgs/msg/Twist", linear=self._vector(velocity_body_m_s), angular=zero),
                covariance=twist.ravel(),
            ),
        )

    def transforms(self, t_ns: int, frames: Iterable[tuple[str, str, Array]]) -> bytes:
        """Return a tf2_msgs/TFMessage of `T_parent_child` [4, 4] by the names of both."""
        made = [
            self._make(
                "geometry_msgs/msg/TransformStamped",
                header=self._header(t_ns, parent),
                child_frame_id=child,
                transform=self._make(
                    "geometry_msgs/msg/Transform", translation=self._vector(T[:3, 3]), rotation=self._quaternion(T)
                ),
            )
            for parent, child, T in frames
        ]
        return self._bytes("tf2_msgs/msg/TFMessage", transforms=made)

    def cloud(self, t_ns: int, points_m: NDArray[np.float32], colors: NDArray[np.uint8], frame: str) -> bytes:
        """Return a sensor_msgs/PointCloud2 of points [N, 3] with RGB colours [N, 3], packed as PCL's `rgb`."""
        rows = np.zeros(len(points_m), _POINT)
        rows["xyz"], rows["bgr"] = points_m, colors[:, ::-1]
        float32 = self.store.types["sensor_msgs/msg/PointField"].FLOAT32  # type: ignore[attr-defined]
        fields = [
            self._make("sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=float32, count=1)
            for k, name in enumerate(("x", "y", "z", "rgb"))
        ]
        return self._bytes(
            "sensor_msgs/msg/PointCloud2",
            header=self._header(t_ns, frame),
            height=1,
            width=len(rows),
            fields=fields,
            is_bigendian=False,
            point_step=_POINT.itemsize,
            row_step=_POINT.itemsize * len(rows),
            data=rows.view(np.uint8),
            is_dense=True,
        )

    def grid(self, t_ns: int, grid: GridImage, frame: str) -> bytes:
        """Return a nav_msgs/OccupancyGrid: 100 occupied, 0 free, -1 unknown, rows from the lowest y."""
        T = np.eye(4)
        T[:2, 3] = grid.origin_m
        rows, columns = grid.cells.shape[0], grid.cells.shape[1]
        info = self._make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=self._time(t_ns),
            resolution=grid.resolution_m,
            width=columns,
            height=rows,
            origin=self._pose(T),
        )
        data = np.where(grid.cells == 1, np.int8(100), grid.cells).ravel()
        return self._bytes("nav_msgs/msg/OccupancyGrid", header=self._header(t_ns, frame), info=info, data=data)

    def _bytes(self, kind: str, **fields: Any) -> bytes:
        return bytes(self.store.serialize_cdr(self._make(kind, **fields), kind))

    def _make(self, kind: str, **fields: Any) -> Any:
        made: Any = self.store.types[kind]
        return made(**fields)

    def _time(self, t_ns: int) -> Any:
        if not 0 <= t_ns < _LATEST_NS:
            raise DataError(f"a stamp of {t_ns} ns cannot be expressed in ROS, whose seconds are 0 to 2^31 - 1")
        return self._make("builtin_interfaces/msg/Time", sec=t_ns // 10**9, nanosec=t_ns % 10**9)

    def _header(self, t_ns: int, frame: str) -> Any:
        return self._make("std_msgs/msg/Header", stamp=self._time(t_ns), frame_id=frame)

    def _vector(self, v: Array) -> Any:
        x, y, z = v.tolist()
        return self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _quaternion(self, T: Array) -> Any:
        x, y, z, w = quaternion_xyzw_from_rotation(T[:3, :3]).tolist()
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _pose(self, T: Array) -> Any:
        x, y, z = T[:3, 3].tolist()
        position = self._make("geometry_msgs/msg/Point", x=x, y=y, z=z)
        return self._make("geometry_msgs/msg/Pose", position=position, orientation=self._quaternion(T))


def kept_for_late_joiners() -> Qos:
    """Return the QoS of what is sent once: a later subscriber gets it, too (ROS's latched topics)."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    always = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_ALL, 0, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL,
        always, always, QosLiveliness.AUTOMATIC, always, False,
    )  # fmt: skip
