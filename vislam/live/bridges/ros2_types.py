"""Messages of ROS as structs of DDS, field by field those of ROS's message packages. Needs cyclonedds."""

import os
from typing import Any

import cyclonedds.idl.annotations as annotate
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import array, bounded_str, byte, float32, float64, int8, int32, sequence, uint8, uint32

from vislam.core.geometry import quaternion_xyzw_from_rotation
from vislam.core.messages import Array as Matrix

_NS = 1_000_000_000
GID_BYTES = 24 if os.environ.get("ROS_DISTRO") == "humble" else 16  # since Iron


def message(package: str, name: str, /, **fields: Any) -> Any:
    """Return the class of a ROS message."""
    return annotate.final(make_idl_struct(name, f"{package}::msg::dds_::{name}_", fields))


Time = message("builtin_interfaces", "Time", sec=int32, nanosec=uint32)
Header = message("std_msgs", "Header", stamp=Time, frame_id=str)
Point = message("geometry_msgs", "Point", x=float64, y=float64, z=float64)
Vector3 = message("geometry_msgs", "Vector3", x=float64, y=float64, z=float64)
Quaternion = message("geometry_msgs", "Quaternion", x=float64, y=float64, z=float64, w=float64)
Pose = message("geometry_msgs", "Pose", position=Point, orientation=Quaternion)
# rows of x, y, z, rotation about X, Y, Z: of a pose in axes of the header's frame, of a twist in those of the child's
PoseWithCovariance = message("geometry_msgs", "PoseWithCovariance", pose=Pose, covariance=array[float64, 36])
Twist = message("geometry_msgs", "Twist", linear=Vector3, angular=Vector3)
TwistWithCovariance = message("geometry_msgs", "TwistWithCovariance", twist=Twist, covariance=array[float64, 36])
Odometry = message(
    "nav_msgs", "Odometry", header=Header, child_frame_id=str, pose=PoseWithCovariance, twist=TwistWithCovariance
)
Transform = message("geometry_msgs", "Transform", translation=Vector3, rotation=Quaternion)
TransformStamped = message("geometry_msgs", "TransformStamped", header=Header, child_frame_id=str, transform=Transform)
TFMessage = message("tf2_msgs", "TFMessage", transforms=sequence[TransformStamped])
UInt32 = message("std_msgs", "UInt32", data=uint32)  # the health word, of which an Odometry has no field
KeyValue = message("diagnostic_msgs", "KeyValue", key=str, value=str)
DiagnosticStatus = message(
    "diagnostic_msgs", "DiagnosticStatus", level=byte, name=str, message=str, hardware_id=str, values=sequence[KeyValue]
)
DiagnosticArray = message("diagnostic_msgs", "DiagnosticArray", header=Header, status=sequence[DiagnosticStatus])
PoseStamped = message("geometry_msgs", "PoseStamped", header=Header, pose=Pose)
PoseWithCovarianceStamped = message(
    "geometry_msgs", "PoseWithCovarianceStamped", header=Header, pose=PoseWithCovariance
)
MapMetaData = message(
    "nav_msgs", "MapMetaData", map_load_time=Time, resolution=float32, width=uint32, height=uint32, origin=Pose
)
OccupancyGrid = message("nav_msgs", "OccupancyGrid", header=Header, info=MapMetaData, data=sequence[int8])
LaserScan = message(
    "sensor_msgs", "LaserScan", header=Header, angle_min=float32, angle_max=float32, angle_increment=float32,
    time_increment=float32, scan_time=float32, range_min=float32, range_max=float32, ranges=sequence[float32],
    intensities=sequence[float32],
)  # fmt: skip
Gid = message("rmw_dds_common", "Gid", data=array[uint8, GID_BYTES])
NodeEntitiesInfo = message(
    "rmw_dds_common", "NodeEntitiesInfo", node_namespace=bounded_str[256], node_name=bounded_str[256],
    reader_gid_seq=sequence[Gid], writer_gid_seq=sequence[Gid],
)  # fmt: skip
ParticipantEntitiesInfo = message(
    "rmw_dds_common", "ParticipantEntitiesInfo", gid=Gid, node_entities_info_seq=sequence[NodeEntitiesInfo]
)


def stamp(t_ns: int) -> Any:
    """Return a `Time`."""
    return Time(*divmod(t_ns, _NS))


def quaternion(T: Matrix) -> Any:
    """Return the `Quaternion` of a pose [4, 4]."""
    return Quaternion(*quaternion_xyzw_from_rotation(T[:3, :3]).tolist())
