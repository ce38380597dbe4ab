"""The published pose as MAVLink's ODOMETRY (#331), for autopilots. Needs pymavlink: only its own process imports this.

Its stamps are of CLOCK_MONOTONIC. An autopilot learns that clock by TIMESYNC (#111): requests are answered with it.

Axes forward-left-up become forward-right-down by a half turn about x, in `odom` (MAV_FRAME_LOCAL_FRD: its heading is
arbitrary, as that of `odom` is) and in `base` (MAV_FRAME_BODY_FRD). https://mavlink.io/en/messages/common.html#ODOMETRY
"""

import socket
import time
from collections.abc import Callable
from threading import Event, Lock, Thread

import numpy as np
from pymavlink.dialects.v20 import common

from vislam.core.geometry import quaternion_wxyz
from vislam.core.messages import Array
from vislam.hw.descriptor import is_readable
from vislam.hw.health import Health
from vislam.live.notices import MapCells
from vislam.live.wire.published_pose import PublishedPose
from vislam.live.wire.publisher import send_address

_FLIP = np.array([1.0, -1.0, -1.0])
_FLIP_6 = np.tile(_FLIP, 2)
_UPPER = np.triu_indices(6)
_SYSTEM = 1  # the vehicle that the autopilot steers
_HEARTBEAT_NS = 1_000_000_000
_SEEN, _DOUBTED, _BLIND, _FAILED = 100, 50, 25, -1
_LOOK_S = 0.1  # after which the end is looked for
_DATAGRAM = 65536


class Mavlink:
    """Owns a socket that ODOMETRY goes to, with HEARTBEAT once a second, and a thread that answers TIMESYNC at once."""

    def __init__(
        self, to: str, name: str, allow_remote: bool = False, clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        """Open the socket.

        Args:
            to: "udp:HOST:PORT".
            name: of the pose, `live.name`.
            allow_remote: whether a host beyond this machine is meant.
            clock_ns: the clock of the poses' stamps.

        Raises:
            UsageError: an address that is none, or beyond this machine without `allow_remote`.
        """
        family, self._address = send_address(to, name, allow_remote)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._link = common.MAVLink(None, _SYSTEM, common.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY)
        self._heartbeat_ns = 0
        self._clock_ns, self._sending, self._closed = clock_ns, Lock(), Event()
        self._answering = Thread(target=self._answer, daemon=True)
        self._answering.start()

    def send(self, pose: PublishedPose) -> None:
        """Send the pose; without a listener, nothing happens."""
        if pose.published_ns >= self._heartbeat_ns:
            self._heartbeat_ns = pose.published_ns + _HEARTBEAT_NS
            self._send(
                self._link.heartbeat_encode(
                    common.MAV_TYPE_ONBOARD_CONTROLLER, common.MAV_AUTOPILOT_INVALID, 0, 0, common.MAV_STATE_ACTIVE
                )
            )
        self._send(odometry(pose))

    def see(self, cells: MapCells) -> None:
        """Do nothing: there is no message of a map."""

    def _send(self, message: common.MAVLink_message) -> None:
        with self._sending:
            data = message.pack(self._link)
            self._link.seq = (self._link.seq + 1) % 256
            try:
                self._socket.connect(self._address)  # of others nothing is heard, nor beyond loopback if it is there
                self._socket.send(data)
            except OSError:  # no listener there (yet), or one that is too slow
                return

    def _answer(self) -> None:
        while not self._closed.is_set():
            if not is_readable(self._socket.fileno(), _LOOK_S):
                continue
            try:
                data, now_ns = self._socket.recv(_DATAGRAM), self._clock_ns()
            except OSError:  # the refusal of what was sent last
                continue
            for asked_ns in _timesync_requests(data):
                self._send(self._link.timesync_encode(now_ns, asked_ns))

    def close(self) -> None:
        """Close the socket; may be called twice."""
        self._closed.set()
        self._answering.join()
        self._socket.close()


def _timesync_requests(data: bytes) -> list[int]:
    """Return the stamps of an autopilot that a datagram asks to be echoed; of garbage, none."""
    parser = common.MAVLink(None)
    parser.robust_parsing = True
    found = parser.parse_buffer(data) or []
    return [message.ts1 for message in found if message.get_type() == "TIMESYNC" and message.tc1 == 0]


def odometry(pose: PublishedPose) -> common.MAVLink_odometry_message:
    """Return the message; angles of the pose's covariance are about the fixed axes of LOCAL_FRD, as MAVROS has them."""
    T, flips = pose.T_odom_base, np.outer(_FLIP, _FLIP)
    return common.MAVLink_odometry_message(
        pose.t_ns // 1000,  # since boot
        common.MAV_FRAME_LOCAL_FRD,
        common.MAV_FRAME_BODY_FRD,
        *(_FLIP * T[:3, 3]),
        quaternion_wxyz(flips * T[:3, :3]).tolist(),
        *(_FLIP * pose.velocity_m_s),
        *(_FLIP * pose.rate_rad_s),
        _upper(pose.pose_covariance),
        _upper(pose.twist_covariance),
        pose.reset_counter & 0xFF,
        common.MAV_ESTIMATOR_TYPE_VIO,
        quality(pose.health),
    )


def quality(health: Health) -> int:
    """Return MAVLink's quality: 100 with vision, 50 of a doubtful run, 25 blind, -1 for a pose not to steer by."""
    if Health.INVALID in health or Health.LEVELLED not in health:
        return _FAILED
    blind = Health.DEAD_RECKONING | Health.GATE_REJECT
    if Health.VISION_OK not in health or health & blind:
        return _BLIND
    return _DOUBTED if Health.DOUBTFUL in health else _SEEN


def _upper(covariance: Array) -> list[float]:
    """Return the 21 of the upper triangle in forward-right-down axes; NaN where there is no state yet."""
    turned = np.outer(_FLIP_6, _FLIP_6) * covariance
    return np.where(np.isfinite(turned), turned, np.nan)[_UPPER].tolist()
