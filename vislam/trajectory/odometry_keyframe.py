"""A keyframe between the front half and the back end, and how one that waited for gravity gets its time and state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from vislam.core.messages import Array, ImuSpan, KeyframePacket, NavState
from vislam.imu import shifted
from vislam.trajectory import Trajectory

_UNKNOWN_VELOCITY_M_S = 3.0  # sigma for a keyframe whose velocity the initialisation did not estimate


@dataclass(frozen=True, slots=True, eq=False)
class OdometryKeyframe:
    """A keyframe on its way to the back end, with the pose that odometry gave it."""

    packet: KeyframePacket
    T_odom_body: Array  # [4, 4]


class WaitingKeyframes:
    """Keyframes in the frame of visual odometry, oldest first, that wait until gravity is known."""

    def __init__(self) -> None:
        """Begin with none."""
        self._keyframes: list[OdometryKeyframe] = []
        self._provisional: list[Array | None] = []

    def add(self, keyframe: OdometryKeyframe, T_odom_body: Array | None = None) -> None:
        """Let a keyframe wait; `T_odom_body` [4, 4] is where a provisional start has it, if there is one."""
        self._keyframes.append(keyframe)
        self._provisional.append(T_odom_body)

    @property
    def provisional(self) -> dict[int, Array]:
        """Poses by time, of those that a provisional start placed."""
        return {
            w.packet.keyframe.t_ns: T for w, T in zip(self._keyframes, self._provisional, strict=True) if T is not None
        }

    def waited_s(self, now_t_ns: int) -> float:
        """Return how long the first has waited."""
        return (now_t_ns - self._keyframes[0].packet.keyframe.t_ns) * 1e-9

    def restamp(self, shift_ns: int, cut: Callable[[int, int], ImuSpan | None]) -> None:
        """Bring all `shift_ns` later in the IMU's time; `cut` gives the inertial data between two times, if any."""
        before_ns: int | None = None
        for i, waiting in enumerate(self._keyframes):
            packet = _restamped(waiting.packet, shift_ns)
            t_ns = packet.keyframe.t_ns
            imu = waiting.packet.imu
            if before_ns is not None and imu is not None:
                imu = cut(before_ns, t_ns) or shifted(imu, shift_ns)  # at the ends of the data
            self._keyframes[i] = replace(waiting, packet=replace(packet, imu=imu))
            before_ns = t_ns

    @property
    def t_ns(self) -> list[int]:
        """Their times."""
        return [waiting.packet.keyframe.t_ns for waiting in self._keyframes]

    def between(self, path: Trajectory) -> dict[int, Array]:
        """Return the poses, by time, of those within a path."""
        return {t_ns: path.at(t_ns) for t_ns in self.t_ns if len(path) and path.t_ns[0] <= t_ns <= path.t_ns[-1]}

    def release(self, T_odom_vo: Array, solved: Mapping[int, Array]) -> list[OdometryKeyframe]:
        """Return all in `odom`, at the pose that was solved for their time, if any; none waits any longer."""
        waiting, self._keyframes, self._provisional = self._keyframes, [], []
        return [
            OdometryKeyframe(w.packet, solved.get(w.packet.keyframe.t_ns, T_odom_vo @ w.T_odom_body)) for w in waiting
        ]


def _restamped(packet: KeyframePacket, shift_ns: int) -> KeyframePacket:
    """Return the packet `shift_ns` later in the IMU's time; its inertial data have to be cut again."""
    keyframe, t_ns = packet.keyframe, packet.keyframe.t_ns + shift_ns
    return replace(
        packet,
        keyframe=replace(keyframe, t_ns=t_ns, frame=replace(keyframe.frame, t_ns=t_ns)),
        vo=replace(packet.vo, t_ns=packet.vo.t_ns + shift_ns),
        time_offset_s=packet.time_offset_s + shift_ns * 1e-9,
    )


def first_keyframe_state(first: NavState, keyframe: OdometryKeyframe) -> NavState:
    """Return the state of the first keyframe, given the state of the first frame that the initialisation used.

    If that frame came later, the keyframe's velocity is unknown, and its covariance is large.
    """
    t_ns = keyframe.packet.keyframe.t_ns
    if first.t_ns == t_ns:
        return replace(first, T_world_body=keyframe.T_odom_body)
    covariance = first.covariance.copy()
    covariance[6:9, :] = covariance[:, 6:9] = 0.0
    covariance[6:9, 6:9] = np.eye(3) * _UNKNOWN_VELOCITY_M_S**2
    return NavState(t_ns, keyframe.T_odom_body, np.zeros(3), first.gyro_bias_rad_s, first.accel_bias_m_s2, covariance)
