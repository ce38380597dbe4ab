"""The published pose for ROS 2: nav_msgs/Odometry, tf, the health word and diagnostics over DDS, without ROS.

Only its own process imports this.

Needs cyclonedds. The structs below are those of ROS's message packages, field by field; names, topics and the encoding
are those of https://design.ros2.org/articles/topic_and_service_names.html and of rmw_cyclonedds; how a node is
announced, of https://design.ros2.org/articles/Node_to_Participant_mapping.html.
"""

import logging
import os
import socket
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import cyclonedds.idl.annotations as annotate
import numpy as np
from cyclonedds.core import Entity, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import array, bounded_str, byte, float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from vislam.core.geometry import quaternion_xyzw_from_rotation
from vislam.core.messages import Array as Matrix
from vislam.hw.health import Health
from vislam.live.wire.published_pose import PublishedPose

_LOG = logging.getLogger(__name__)
_NS = 1_000_000_000
# Linux carries multicast on loopback though the interface does not state so: most peers are found by it. Those that are
# set to do without are asked one by one.
LOOPBACK = """<CycloneDDS><Domain Id="any">
  <General><Interfaces><NetworkInterface address="127.0.0.1" multicast="true"/></Interfaces></General>
  <Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
QOS = Qos(
    Policy.Reliability.Reliable(duration(milliseconds=100)),
    Policy.History.KeepLast(10),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)
# for who comes later, as tf2's static broadcaster and rmw_cyclonedds have it
KEPT = Qos(
    Policy.Reliability.Reliable(duration(milliseconds=100)),
    Policy.Durability.TransientLocal,
    Policy.History.KeepLast(1),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)
_DIAGNOSED_NS = _NS  # between diagnostics
GID_BYTES = 24 if os.environ.get("ROS_DISTRO") == "humble" else 16  # since Iron
_STATES = Health.LEVELLED | Health.VISION_OK | Health.AT_REST | Health.MAG_OK  # bits that are no fault
OK, WARN, ERROR = range(3)


def _message(package: str, name: str, /, **fields: Any) -> Any:
    """Return the class of a ROS message."""
    return annotate.final(make_idl_struct(name, f"{package}::msg::dds_::{name}_", fields))


Time = _message("builtin_interfaces", "Time", sec=int32, nanosec=uint32)
Header = _message("std_msgs", "Header", stamp=Time, frame_id=str)
Point = _message("geometry_msgs", "Point", x=float64, y=float64, z=float64)
Vector3 = _message("geometry_msgs", "Vector3", x=float64, y=float64, z=float64)
Quaternion = _message("geometry_msgs", "Quaternion", x=float64, y=float64, z=float64, w=float64)
Pose = _message("geometry_msgs", "Pose", position=Point, orientation=Quaternion)
# rows of x, y, z, rotation about X, Y, Z: of a pose in axes of the header's frame, of a twist in those of the child's
PoseWithCovariance = _message("geometry_msgs", "PoseWithCovariance", pose=Pose, covariance=array[float64, 36])
Twist = _message("geometry_msgs", "Twist", linear=Vector3, angular=Vector3)
TwistWithCovariance = _message("geometry_msgs", "TwistWithCovariance", twist=Twist, covariance=array[float64, 36])
Odometry = _message(
    "nav_msgs", "Odometry", header=Header, child_frame_id=str, pose=PoseWithCovariance, twist=TwistWithCovariance
)
Transform = _message("geometry_msgs", "Transform", translation=Vector3, rotation=Quaternion)
TransformStamped = _message("geometry_msgs", "TransformStamped", header=Header, child_frame_id=str, transform=Transform)
TFMessage = _message("tf2_msgs", "TFMessage", transforms=sequence[TransformStamped])
UInt32 = _message("std_msgs", "UInt32", data=uint32)  # the health word, of which an Odometry has no field
KeyValue = _message("diagnostic_msgs", "KeyValue", key=str, value=str)
DiagnosticStatus = _message(
    "diagnostic_msgs", "DiagnosticStatus", level=byte, name=str, message=str, hardware_id=str, values=sequence[KeyValue]
)
DiagnosticArray = _message("diagnostic_msgs", "DiagnosticArray", header=Header, status=sequence[DiagnosticStatus])
Gid = _message("rmw_dds_common", "Gid", data=array[uint8, GID_BYTES])
NodeEntitiesInfo = _message(
    "rmw_dds_common", "NodeEntitiesInfo", node_namespace=bounded_str[256], node_name=bounded_str[256],
    reader_gid_seq=sequence[Gid], writer_gid_seq=sequence[Gid],
)  # fmt: skip
ParticipantEntitiesInfo = _message(
    "rmw_dds_common", "ParticipantEntitiesInfo", gid=Gid, node_entities_info_seq=sequence[NodeEntitiesInfo]
)


class Ros2:
    """Owns the DDS entities of the node /vislam: /odom, /tf, /tf_static, /vislam/health and /diagnostics."""

    def __init__(self, domain: int, sensors: Mapping[str, Matrix] | None = None, allow_remote: bool = False) -> None:
        """Join a domain.

        Args:
            domain: what ROS_DOMAIN_ID is for the others.
            sensors: `T_base_sensor` [4, 4] by frame.
            allow_remote: use the interfaces that CYCLONEDDS_URI or the system names; else the loopback one alone.
        """
        others = set(_udp_sockets())
        self._domain = None if allow_remote else Domain(domain, LOOPBACK)
        self._participant = DomainParticipant(domain, qos=Qos(Policy.Userdata(b"enclave=/;")))  # what makes it ROS's
        if not allow_remote:
            hear_loopback_alone(set(_udp_sockets()) - others)
        self._publisher = Publisher(self._participant)
        self._odom = self._writer("rt/odom", Odometry)
        self._tf = self._writer("rt/tf", TFMessage)
        self._health = self._writer("rt/vislam/health", UInt32)
        self._diagnostics = self._writer("rt/diagnostics", DiagnosticArray)
        self._static = self._writer("rt/tf_static", TFMessage, KEPT)
        self._static.write(_transforms([("base_link", name, T) for name, T in (sensors or {}).items()], time.time_ns()))
        self._node = self._writer("ros_discovery_info", ParticipantEntitiesInfo, KEPT)
        ours = [_gid(w) for w in (self._odom, self._tf, self._health, self._diagnostics, self._static)]
        node = NodeEntitiesInfo("/", "vislam", [], ours)
        self._node.write(ParticipantEntitiesInfo(_gid(self._participant), [node]))
        self._diagnosed_ns = 0

    def _writer(self, topic: str, kind: Any, qos: Qos = QOS) -> DataWriter[Any]:
        return DataWriter(self._publisher, Topic(self._participant, topic, kind, qos=qos), qos=qos)

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

    def close(self) -> None:
        """Leave the domain; may be called twice."""
        vars(self).clear()  # an entity leaves when it is let go


def _udp_sockets() -> Iterator[int]:
    """Yield the descriptors of this process that are UDP sockets."""
    for entry in filter(Path.is_socket, Path("/proc/self/fd").iterdir()):
        with suppress(OSError), socket.socket(fileno=os.dup(int(entry.name))) as found:  # one that is closed by now
            if found.type == socket.SOCK_DGRAM and found.family in (socket.AF_INET, socket.AF_INET6):
                yield int(entry.name)


def hear_loopback_alone(descriptors: Iterable[int]) -> None:
    """Bind sockets to the loopback device, as Cyclone receives at every address (its issue 2090); warn if refused."""
    for descriptor in descriptors:
        with socket.socket(fileno=os.dup(descriptor)) as bound:
            try:
                bound.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")
            except OSError as error:  # Linux before 5.7 lets root alone do so
                _LOG.warning("ROS 2's port %d hears other machines, too: %s", bound.getsockname()[1], error.strerror)


def odometry(pose: PublishedPose, stamp_ns: int) -> Any:
    """Return an `Odometry`: pose in `odom`, twist in `base_link`; the stamp is of CLOCK_REALTIME, as ROS's are."""
    T = pose.T_odom_base
    return Odometry(
        Header(_time(stamp_ns), "odom"),
        "base_link",
        PoseWithCovariance(Pose(Point(*T[:3, 3].tolist()), _quaternion(T)), pose.pose_covariance.ravel().tolist()),
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
    return DiagnosticArray(Header(_time(stamp_ns), ""), [status])


def _transforms(frames: Iterable[tuple[str, str, Matrix]], stamp_ns: int) -> Any:
    """Return a `TFMessage` of parents, children and `T_parent_child` [4, 4]."""
    return TFMessage(
        [
            TransformStamped(
                Header(_time(stamp_ns), parent), child, Transform(Vector3(*T[:3, 3].tolist()), _quaternion(T))
            )
            for parent, child, T in frames
        ]
    )


def _gid(entity: Entity) -> Any:
    return Gid(list(entity.guid.bytes.ljust(GID_BYTES, b"\0")))


def _time(t_ns: int) -> Any:
    return Time(*divmod(t_ns, _NS))


def _quaternion(T: Matrix) -> Any:
    return Quaternion(*quaternion_xyzw_from_rotation(T[:3, :3]).tolist())
