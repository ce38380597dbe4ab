"""What may enter a window: a first state and keyframes, checked before anything is changed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vislam.core.errors import DataError, UsageError
from vislam.core.messages import Array, ImuSpan, KeyframePacket, NavState
from vislam.window.calibration import Calibration
from vislam.window.equations import STATE, Prior, first_pose_prior, first_prior
from vislam.window.posterior import GAUGE_SIGMA_M, GAUGE_SIGMA_RAD
from vislam.window.tracks import check_observations


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """The first state of a window: a full one, or where there is no IMU its pose alone."""

    state: NavState | None
    T_local_body: Array  # [4, 4]

    @classmethod
    def of(cls, state: NavState | None, T_local_body: Array | None, has_imu: bool) -> Start:
        """Return a start that was checked; DataError on numbers that cannot be used, UsageError on a missing state."""
        if has_imu and state is None:
            raise UsageError("a window with an IMU starts from a full state; initialise the inertial states first")
        if state is not None:
            _check_state(state)
        if T_local_body is not None and not np.isfinite(T_local_body).all():
            raise DataError("the first pose of the window is not finite; initialise again")
        if has_imu and state is not None:
            return cls(state, state.T_world_body)
        return cls(None, np.eye(4) if T_local_body is None else T_local_body.copy())

    def equations(self, calibration: Calibration) -> tuple[Array, Prior]:
        """Return the state [21] of the first keyframe and the prior on it."""
        x, start, gauge = np.zeros(STATE), self.state, (GAUGE_SIGMA_M, GAUGE_SIGMA_RAD)
        x[:9], x[9:12] = self.T_local_body[:3, :3].ravel(), self.T_local_body[:3, 3]
        if start is None:
            return x, first_pose_prior(*gauge, calibration.values, calibration.start_sigmas)
        x[12:15], x[15:18], x[18:21] = start.velocity_world_m_s, start.gyro_bias_rad_s, start.accel_bias_m_s2
        return x, first_prior(start, *gauge, calibration.values, calibration.start_sigmas)


def _check_state(state: NavState) -> None:
    """Raise DataError unless a first state is finite and its covariance positive semidefinite."""
    values = [state.T_world_body, state.velocity_world_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2]
    if not all(np.isfinite(v).all() for v in values) or not np.isfinite(state.covariance).all():
        raise DataError("the first state of the window is not finite; initialise again")
    if float(np.linalg.eigvalsh(0.5 * (state.covariance + state.covariance.T))[0]) < -1e-9:
        raise DataError("the covariance of the window's first state has a negative eigenvalue; initialise again")


def check_packet(packet: KeyframePacket, T_odom_body: Array | None, newest: tuple[int, int] | None) -> None:
    """Raise DataError unless a keyframe is finite and follows the newest one, of which id and time are given."""
    where = f"keyframe {packet.keyframe.id} at {packet.keyframe.t_ns} ns"
    check_observations(packet.observations, where)
    if not np.isfinite(packet.time_offset_s):
        raise DataError(f"{where}: its time offset is {packet.time_offset_s}; it must be a number of seconds")
    if T_odom_body is not None and not np.isfinite(T_odom_body).all():
        raise DataError(f"{where}: its pose by odometry is not finite; leave it out")
    T_vo = packet.vo.T_keyframe_body
    if T_vo is not None and not np.isfinite(T_vo).all():
        raise DataError(f"{where}: its motion by visual odometry is not finite; report it as lost instead")
    if newest is None:
        return
    newest_id, newest_t_ns = newest
    if packet.keyframe.t_ns <= newest_t_ns or packet.keyframe.id <= newest_id:
        raise DataError(
            f"{where} does not follow keyframe {newest_id} at {newest_t_ns} ns; add keyframes in time order"
        )
    if packet.imu is not None:
        _check_span(packet.imu, newest_t_ns, packet.keyframe.t_ns, where)


def _check_span(span: ImuSpan, t0_ns: int, t1_ns: int, where: str) -> None:
    if len(span.t_ns) == 0:
        return
    if not (np.isfinite(span.gyro_rad_s).all() and np.isfinite(span.accel_m_s2).all()):
        raise DataError(f"{where}: its inertial span has values that are not finite; leave such samples out")
    if len(span.t_ns) > 1 and int(np.diff(span.t_ns).min()) <= 0:
        raise DataError(f"{where}: its inertial span goes back in time; sort the samples and drop duplicates")
    if int(span.t_ns[0]) != t0_ns or int(span.t_ns[-1]) != t1_ns:
        raise DataError(
            f"{where}: its inertial span covers [{span.t_ns[0]}, {span.t_ns[-1]}] ns instead of [{t0_ns}, {t1_ns}]; "
            "cut it with ImuBuffer.span"
        )
