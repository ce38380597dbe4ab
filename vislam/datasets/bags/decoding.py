"""Messages decoded through `rosbags`, by its own definitions of the standard types; Foxglove's by ours.

The definitions that a bag brings are never parsed: what is read here is standard, and a definition from outside could
be anything. Where ROS 1's checksum of it differs from the standard's, the topic is refused.
"""

from __future__ import annotations

import struct
from functools import cache
from types import SimpleNamespace
from typing import Any

from vislam.core.errors import DataError, install_line
from vislam.datasets.bags import foxglove
from vislam.datasets.bags.films import why_no_video
from vislam.datasets.bags.stored import DamagedError, Topic

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
VIDEO, PACKET = "foxglove_msgs/msg/CompressedVideo", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
VIDEOS = (VIDEO, PACKET)
IMAGES = (IMAGE, COMPRESSED, *VIDEOS)
CAMERA_INFO, IMU, MAGNETIC = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Imu", "sensor_msgs/msg/MagneticField"
FIX, RANGE, PRESSURE = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Range", "sensor_msgs/msg/FluidPressure"
ODOMETRY, TWIST, JOINTS = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped", "sensor_msgs/msg/JointState"
TWIST_COVARIANCE = "geometry_msgs/msg/TwistWithCovarianceStamped"
POSE, POSE_COVARIANCE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
PATH, POINT = "nav_msgs/msg/Path", "geometry_msgs/msg/PointStamped"  # these two of evaluations alone
TRANSFORM, TRANSFORMS, OLD_TRANSFORMS = (
    "geometry_msgs/msg/TransformStamped",
    "tf2_msgs/msg/TFMessage",
    "tf/msg/tfMessage",
)
POSES = (ODOMETRY, POSE, POSE_COVARIANCE, TRANSFORM)
KNOWN = (
    *IMAGES, CAMERA_INFO, IMU, MAGNETIC, FIX, RANGE, PRESSURE, ODOMETRY, TWIST, TWIST_COVARIANCE, JOINTS,
    POSE, POSE_COVARIANCE, TRANSFORM, TRANSFORMS, OLD_TRANSFORMS, PATH, POINT,
)  # fmt: skip
_TRANSFORMS_SUM = "94810edda583a504dfda3829e70d7eec"
_VIDEO_FIELDS = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format"
_PACKET_1 = (
    "std_msgs/Header header\nuint8[] data\nint32 img_width\nint32 img_height\nstring encoding\nuint64 pts\nuint8 flags"
)
_PACKET_2 = (
    "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\nbool is_bigendian\n"
    "uint8[] data"
)
_UT_PER_TESLA = 1e6
_STAMP = {"<": struct.Struct("<iI"), ">": struct.Struct(">iI")}
_ROS1_STAMP = struct.Struct("<III")


def need_rosbags() -> None:
    """Raise DataError naming the extra where the package is not installed."""
    try:
        _stores()
    except ImportError as error:
        raise DataError(f"bags need {error.name or 'rosbags'}; install it: {install_line('bags')}") from error


def why_unreadable(topic: Topic) -> str:
    """Return why messages of a topic cannot be decoded, empty when they can."""
    if topic.type not in KNOWN:
        return "a type that vislam does not read"
    if topic.type in VIDEOS and (lacks := why_no_video()):
        return lacks
    if topic.schema:
        return topic.refused
    if topic.encoding not in ("ros1", "cdr"):
        return f"encoded as '{topic.encoding}'; ros1, cdr and Foxglove's protobuf and json are read"
    if topic.encoding == "ros1" and topic.digest not in ("", "*", _standard_sum(topic.type)):
        return f"its definition of {topic.type} is not the standard one"
    return ""


def decoded(topic: Topic, data: bytes) -> Any:
    """Return a message with the fields of its type; raises DamagedError when the bytes are none."""
    if topic.schema:
        return foxglove.decoded(topic.schema, topic.encoding, data)
    ros1, *ros2 = _stores()
    type_ = TRANSFORMS if topic.type == OLD_TRANSFORMS else topic.type
    try:
        if topic.encoding == "ros1":
            return _of_video(type_, ros1.deserialize_ros1(data, type_))
        if data[:2] not in (b"\x00\x00", b"\x00\x01"):  # neither order of bytes; others are not plain CDR
            raise DamagedError("message in another representation than plain CDR")
        try:
            return _of_video(type_, ros2[0].deserialize_cdr(data, type_))
        except Exception:
            return ros2[1].deserialize_cdr(data, type_)  # later ones have further fields
    except DamagedError:
        raise
    except Exception as error:  # of whatever kind: these bytes may be anything, and that code is another's
        raise DamagedError(f"message that cannot be read as {topic.type}") from error


def _of_video(type_: str, message: Any) -> Any:
    """Return a message, one of video with the fields of a CompressedImage."""
    if type_ == VIDEO:
        header = SimpleNamespace(stamp=message.timestamp, frame_id=message.frame_id)
        return SimpleNamespace(header=header, format=message.format, data=message.data)
    if type_ == PACKET:
        return SimpleNamespace(header=message.header, format=message.encoding, data=message.data)
    return message


def stamp_ns(topic: Topic, head: bytes) -> int | None:
    """Return the stamp in a message's header by its first bytes; None when there is none or it is impossible."""
    if topic.schema:
        stamp = foxglove.stamp(topic.schema, topic.encoding, head)
        return None if stamp is None else _whole_ns(*stamp)
    try:
        if topic.encoding == "ros1":
            _sequence, seconds, rest_ns = _ROS1_STAMP.unpack_from(bytes(4) + head if topic.type == VIDEO else head)
        else:
            seconds, rest_ns = _STAMP["<" if head[1:2] == b"\x01" else ">"].unpack_from(head, 4)
    except struct.error:
        return None
    return _whole_ns(seconds, rest_ns)


def header_ns(header: Any) -> int | None:
    """Return the stamp in a decoded header, as `stamp_ns`."""
    return _whole_ns(int(header.stamp.sec), int(header.stamp.nanosec))


def pose_numbers(message: Any) -> list[float]:
    """Return position and quaternion x y z w in a message of one of POSES."""
    if hasattr(message, "transform"):
        p, q = message.transform.translation, message.transform.rotation
    else:
        pose = getattr(message.pose, "pose", message.pose)  # within its covariance
        p, q = pose.position, pose.orientation
    return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


def field_ut(message: Any) -> list[float]:
    """Return the field in a message of MAGNETIC."""
    field = message.magnetic_field
    return [field.x * _UT_PER_TESLA, field.y * _UT_PER_TESLA, field.z * _UT_PER_TESLA]


def _whole_ns(seconds: int, rest_ns: int) -> int | None:
    if not 0 <= rest_ns < 10**9 or seconds < 0 or (seconds == 0 and rest_ns == 0):
        return None
    return seconds * 10**9 + rest_ns


@cache
def _stores() -> tuple[Any, Any, Any]:
    """Return definitions of ROS 1 and of two ages of ROS 2. Raises ImportError."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    ros1 = get_typestore(Stores.ROS1_NOETIC)
    ros1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    humble = get_typestore(Stores.ROS2_HUMBLE)
    for store, packet in ((ros1, _PACKET_1), (humble, _PACKET_2)):
        store.register(get_types_from_msg(_VIDEO_FIELDS, VIDEO) | get_types_from_msg(packet, PACKET))
    return ros1, humble, get_typestore(Stores.LATEST)


@cache
def _standard_sum(type_: str) -> str:
    if type_ in (TRANSFORMS, OLD_TRANSFORMS):
        return _TRANSFORMS_SUM
    return str(_stores()[0].generate_msgdef(type_, ros_version=1)[1])
