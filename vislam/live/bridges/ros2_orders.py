"""What ROS 2 may ask of a cart that `vislam drive` has armed: goal_pose, initialpose and cmd_vel, bounded.

Nothing else opens these topics: without an armed cart there is no reader. Needs cyclonedds.
"""

import logging
import math
import time
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.internal import InvalidSample
from cyclonedds.sub import DataReader

from vislam.live.bridges.ros2_node import QOS, Node
from vislam.live.bridges.ros2_types import PoseStamped, PoseWithCovarianceStamped, Twist
from vislam.live.driving.orders import Goal, Place, Steer

_LOG = logging.getLogger(__name__)
_MOST = 10  # messages of a topic that wait
_FARTHEST_M = 1e4
_NORM = 0.1  # that the norm of a quaternion may be off 1
_TILT = 0.1  # of a goal's heading out of the floor, as a sine
_GOAL_S, _PLACE_S = 0.2, 1.0  # between goals, and places, that are taken
_SAID_S = 1.0  # between words on what was refused
# any writer's reliability fits; of what waits the newest is kept, whatever is sent
_NEWEST = Qos(
    Policy.Reliability.BestEffort, Policy.History.KeepLast(1), Policy.ResourceLimits(4, 1, 4),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)  # fmt: skip


class Ros2Orders:
    """Owns the node /vislam_drive, which listens."""

    def __init__(self, domain: int, allow_remote: bool = False) -> None:
        """Join a domain, as `Ros2` does."""
        self._node = Node(domain, "vislam_drive", allow_remote)
        goals = self._node.reader("goal_pose", PoseStamped, QOS)
        places = self._node.reader("initialpose", PoseWithCovarianceStamped, QOS)
        twists = self._node.reader("cmd_vel", Twist, _NEWEST)
        self._node.announce()
        self._kinds = (goals, goal_of, _GOAL_S), (places, place_of, _PLACE_S), (twists, steer_of, 0.0)
        self._taken_s = dict.fromkeys((goal_of, place_of, steer_of), -math.inf)
        self._said_s = -math.inf

    def take(self) -> Goal | Place | Steer | None:
        """Return what was asked: of several the newest, a goal before a place before a twist; others go on waiting."""
        now_s = time.monotonic()
        for reader, read, apart_s in self._kinds:
            if now_s - self._taken_s[read] < apart_s:
                continue
            for message in _newest(reader):
                self._taken_s[read], order = now_s, read(message)
                if not isinstance(order, str):
                    return order
                self._refuse(order, now_s)
        return None

    def close(self) -> None:
        """Leave the domain; may be called twice."""
        vars(self).clear()

    def _refuse(self, reason: str, now_s: float) -> None:
        if now_s - self._said_s >= _SAID_S:
            self._said_s = now_s
            _LOG.warning("%s", reason)


def _newest(reader: DataReader[Any]) -> list[Any]:
    """Return the newest message that waits, if any; that a writer has left is none."""
    return [message for message in reader.take(N=_MOST) if not isinstance(message, InvalidSample)][-1:]


def goal_of(message: Any) -> Goal | str:
    """Return the goal of a `PoseStamped`, or why it is none."""
    yaw_rad = _heading("goal_pose", message.header.frame_id, message.pose)
    place = message.pose.position
    return yaw_rad if isinstance(yaw_rad, str) else Goal(place.x, place.y, yaw_rad)


def place_of(message: Any) -> Place | str:
    """Return the place of a `PoseWithCovarianceStamped`, or why it is none."""
    yaw_rad = _heading("initialpose", message.header.frame_id, message.pose.pose)
    place = message.pose.pose.position
    return yaw_rad if isinstance(yaw_rad, str) else Place((place.x, place.y, place.z), yaw_rad)


def _heading(topic: str, frame_id: str, pose: Any) -> float | str:
    """Return the heading of a `Pose` on the floor of the map, or why it is none."""
    place, q = pose.position, pose.orientation
    frame = frame_id.removeprefix("/")
    if frame != "map":
        return f"a {topic} is in the frame '{frame[:40]}'; give it in 'map'"
    if not all(abs(value) <= _FARTHEST_M for value in (place.x, place.y, place.z)):  # NaN is not
        return f"a {topic} at {place.x:g}, {place.y:g}, {place.z:g} m is nowhere"
    norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
    if not abs(norm - 1.0) <= _NORM or not 2.0 * abs(q.x * q.z - q.w * q.y) <= _TILT:
        return f"a {topic} has no heading on the floor: its quaternion is none, or tilted"
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def steer_of(message: Any) -> Steer | str:
    """Return what a `Twist` asks of wheels, or why it is nothing; its size is bounded by who steers."""
    if not math.isfinite(message.linear.x) or not math.isfinite(message.angular.z):
        return "a cmd_vel is no number"
    return Steer(message.linear.x, message.angular.z)
