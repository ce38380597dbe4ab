"""The published pose for ROS 2: nav_msgs/Odometry, tf and the health word over DDS, without ROS.

Only its own process imports this.

Needs cyclonedds. The structs below are those of ROS's message packages, field by field; names, topics and the encoding
are those of https://design.ros2.org/articles/topic_and_service_names.html and of rmw_cyclonedds.
"""

import logging
import os
import socket
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import cyclonedds.idl.annotations as annotate
import numpy as np
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import array, float64, int32, sequence, uint32
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


def _message(package: str, name: str, **fields: Any) -> Any:
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


class Ros2:
    """Owns the DDS entities that write /odom, /tf and /vislam/health."""

    def __init__(self, domain: int, allow_remote: bool = False) -> None:
        """Join a domain.

        Args:
            domain: what ROS_DOMAIN_ID is for the others.
            allow_remote: use the interfaces that CYCLONEDDS_URI or the system names; else the loopback one alone.
        """
        others = set(_udp_sockets())
        self._domain = None if allow_remote else Domain(domain, LOOPBACK)
        self._participant = DomainParticipant(domain)
        if not allow_remote:
            hear_loopback_alone(set(_udp_sockets()) - others)
        publisher = Publisher(self._participant)
        self._odom = DataWriter(publisher, Topic(self._participant, "rt/odom", Odometry, qos=QOS), qos=QOS)
        self._tf = DataWriter(publisher, Topic(self._participant, "rt/tf", TFMessage, qos=QOS), qos=QOS)
        self._health = DataWriter(publisher, Topic(self._participant, "rt/vislam/health", UInt32, qos=QOS), qos=QOS)

    def send(self, pose: PublishedPose) -> None:
        """Write all; of a pose not to steer by the health word alone, as an Odometry cannot say so."""
        self._health.write(UInt32(int(pose.health)))
        if Health.INVALID in pose.health or not np.isfinite(pose.pose_covariance).all():
            return
        stamp_ns = pose.t_ns + max(time.time_ns() - time.monotonic_ns() for _ in range(3))  # less when interrupted
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
    return TFMessage(
        [
            TransformStamped(
                Header(_time(stamp_ns), parent), child, Transform(Vector3(*T[:3, 3].tolist()), _quaternion(T))
            )
            for parent, child, T in frames[Health.NOT_IN_MAP in pose.health :]
        ]
    )


def _time(t_ns: int) -> Any:
    return Time(*divmod(t_ns, _NS))


def _quaternion(T: Matrix) -> Any:
    return Quaternion(*quaternion_xyzw_from_rotation(T[:3, :3]).tolist())
