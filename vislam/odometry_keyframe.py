"""A keyframe between the front half and the back end, and how one that waited for gravity gets its time and state."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vislam.geometry import transform
from vislam.imu import preintegrate
from vislam.messages import Array, ImuSpan, KeyframePacket, NavState

_UNKNOWN_VELOCITY_M_S = 3.0  # sigma for a keyframe whose velocity the initialisation did not estimate


@dataclass(frozen=True, slots=True, eq=False)
class OdometryKeyframe:
    """A keyframe on its way to the back end, with the pose that odometry gave it."""

    packet: KeyframePacket
    T_odom_body: Array  # [4, 4]


def restamped(packet: KeyframePacket, shift_ns: int) -> KeyframePacket:
    """Return the packet `shift_ns` later in the IMU's time; its inertial data have to be cut anew."""
    keyframe, t_ns = packet.keyframe, packet.keyframe.t_ns + shift_ns
    return replace(
        packet,
        keyframe=replace(keyframe, t_ns=t_ns, frame=replace(keyframe.frame, t_ns=t_ns)),
        vo=replace(packet.vo, t_ns=packet.vo.t_ns + shift_ns),
        time_offset_s=packet.time_offset_s + shift_ns * 1e-9,
    )


def pose_before(state: NavState, span: ImuSpan, gravity_m_s2: float) -> Array:
    """Return the pose [4, 4] at the begin of a span that ends at `state`, by dead reckoning backwards in time."""
    piece = preintegrate(span, state.gyro_bias_rad_s, state.accel_bias_m_s2)
    dt, gravity = piece.dt_s, np.array([0.0, 0.0, -gravity_m_s2])
    R = state.T_world_body[:3, :3] @ piece.dR.T
    velocity = state.velocity_world_m_s - gravity * dt - R @ piece.dv_m_s
    return transform(R, state.T_world_body[:3, 3] - velocity * dt - 0.5 * dt * dt * gravity - R @ piece.dp_m)


def first_keyframe_state(first: NavState, keyframe: OdometryKeyframe) -> NavState:
    """Return the state of the first keyframe, given the state of the first frame that the initialisation used.

    If that frame came later, the keyframe's velocity is unknown, and its covariance says so.
    """
    t_ns = keyframe.packet.keyframe.t_ns
    if first.t_ns == t_ns:
        return replace(first, T_world_body=keyframe.T_odom_body)
    covariance = first.covariance.copy()
    covariance[6:9, :] = covariance[:, 6:9] = 0.0
    covariance[6:9, 6:9] = np.eye(3) * _UNKNOWN_VELOCITY_M_S**2
    return NavState(t_ns, keyframe.T_odom_body, np.zeros(3), first.gyro_bias_rad_s, first.accel_bias_m_s2, covariance)
