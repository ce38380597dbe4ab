"""The camera's clock: what is added to its stamps, so that everything behind it lives in the IMU's time.

The offset that is applied follows the estimate only where that is significant, changes from one frame to the next, and
never so far that time would not advance. While a start is awaited it has to be significant twice in a row: errors of a
tracked rotation last for many frames, which its sigma takes for independent, and a wrong clock voids the attempts.
"""

from dataclasses import replace

import numpy as np

from vislam.config import InitConfig
from vislam.core.geometry import invert, se3_adjoint
from vislam.core.messages import Frame, ImuSpan, NavState, VoMeasurement
from vislam.frontend.stamp_jitter import StampJitter
from vislam.frontend.time_offset import TimeOffset, TimeOffsetEstimate
from vislam.imu import ImuBuffer

_TIME_OFFSET_MIN_S = 0.001  # smaller corrections are not worth a step in time
_NS = 1_000_000_000
_EVERY_FRAMES = 5  # between estimates: they change slowly, and each costs a millisecond
_SIGNIFICANT = 3.0  # sigmas of the estimate
_WIDER = 3.0  # sigmas of the offset by which the gyroscope's word on rotation is widened
_MOST_BACK = 0.5  # of a frame interval, by which stamps may step back at once
_FASTEST_M_S = 1.0  # assumed where the speed is unknown


class CameraClock:
    """Owns the offset that is applied and the estimator behind it.

    Attributes:
        applied_ns: what was added to the newest stamp of the camera.
        drift: by how many seconds more that gets in a second of the camera; 0 but for `init.clock_drift`.
        changes: how often that was changed.
    """

    def __init__(self, config: InitConfig) -> None:
        """Start from the configured offset."""
        self._config = config
        self._offset, self._jitter = TimeOffset(config), StampJitter()
        self.applied_ns = round(config.time_offset_s * _NS)
        self.drift = 0.0
        self.changes = 0
        self._offset_ns = self.applied_ns  # applied at the camera's time ...
        self._offset_t_ns = 0  # ... since which the drift counts
        self._corrected_ns = 0  # by changes of the offset so far ...
        self._keyframe_ns = 0  # ... and when the newest keyframe was stamped
        self._twist = self._keyframe_twist = np.zeros(6)  # of the body at the newest frame and keyframe
        self._frames = 0
        self._wanted_before_ns = 0  # the significant change that rotations asked for last
        self._last_t_ns: int | None = None  # of the frame before, by the camera
        self._interval_ns = 0

    @property
    def estimate(self) -> TimeOffsetEstimate:
        """Offset, gyro bias and misalignment of the axes, estimated from rotations."""
        return self._offset.estimate

    @property
    def applied_s(self) -> float:
        """What was added to the newest stamp of the camera."""
        return self.applied_ns / _NS

    def offset_ns(self, camera_t_ns: int) -> int:
        """Return what is to be added to a stamp of the camera, by what is known now."""
        return self._offset_ns + round(self.drift * (camera_t_ns - self._offset_t_ns))

    @property
    def drift_sigma(self) -> float:
        """How well the drift is known; 0: it is not estimated."""
        return self._offset.estimate.drift_sigma if self._config.clock_drift and self._config.time_offset else 0.0

    @property
    def sigma_s(self) -> float:
        """How far the applied offset may be off."""
        return self._offset.sigma_s

    @property
    def jitter_s(self) -> float:
        """Standard deviation of single stamps."""
        return self._jitter.sigma_s

    def start_at(self, applied_s: float, sigma_s: float) -> None:
        """Take the offset that an earlier run applied and how well it knew that."""
        self.applied_ns = self._offset_ns = round(applied_s * _NS)
        self._offset.tell(applied_s, sigma_s)

    def in_imu_time(self, frame: Frame) -> Frame:
        """Return the frame with its stamp in the IMU's time."""
        if self._last_t_ns is not None:
            self._interval_ns = frame.t_ns - self._last_t_ns
        self._last_t_ns = frame.t_ns
        self._jitter.stamp(frame.t_ns)
        self.applied_ns = self.offset_ns(frame.t_ns)
        return replace(frame, t_ns=frame.t_ns + self.applied_ns) if self.applied_ns else frame

    def took_keyframe(self) -> None:
        """Take note that the newest frame became a keyframe."""
        self._keyframe_ns, self._keyframe_twist = self._corrected_ns, self._twist

    def gyro_sigma_rad_s(self, span: ImuSpan) -> float:
        """Return the sigma of a mean rate over a span for want of the exact time: it grows with the change of rate."""
        change = float(np.linalg.norm(span.gyro_rad_s[-1] - span.gyro_rad_s[0]))
        return _WIDER * self.sigma_s * change / ((int(span.t_ns[-1]) - int(span.t_ns[0])) / _NS)

    def loosened(self, vo: VoMeasurement, span: ImuSpan | None, state: NavState | None) -> VoMeasurement:
        """Return a motion with the noise that comes of two stamps made with different offsets; usually as it is."""
        shift_s = abs(self._corrected_ns - self._keyframe_ns) / _NS
        if shift_s == 0.0 or vo.T_keyframe_body is None:
            return vo
        rate = 1.0 if span is None else float(np.linalg.norm(span.gyro_rad_s, axis=1).max())
        speed = _FASTEST_M_S if state is None else float(np.linalg.norm(state.velocity_world_m_s))
        along = speed * shift_s if vo.has_scale else 1.0  # a direction over a short way is unknown then
        extra = np.diag(np.repeat([(rate * shift_s) ** 2, along**2], 3))
        return replace(vo, covariance=vo.covariance + extra)

    def jittered(self, vo: VoMeasurement, span: ImuSpan | None, state: NavState | None) -> VoMeasurement:
        """Return a motion as one between the times of its stamps, each of which is off by the jitter.

        Between the images, whose own poses a graph has, it is as good as ever.
        """
        self._jitter.see(vo, span, np.zeros(3) if state is None else state.gyro_bias_rad_s)
        self._twist = np.zeros(6)
        if span is not None:
            self._twist[:3] = span.gyro_rad_s.mean(axis=0)
        if state is not None and vo.has_scale:  # of a way without scale the direction stays
            self._twist[3:] = state.T_world_body[:3, :3].T @ state.velocity_world_m_s
        jitter_s = self.jitter_s
        if jitter_s == 0.0 or vo.T_keyframe_body is None:
            return vo
        ends = np.array([self._twist, se3_adjoint(invert(vo.T_keyframe_body)) @ self._keyframe_twist])
        return replace(vo, covariance=vo.covariance + jitter_s**2 * ends.T @ ends)

    def follow(self, vo: VoMeasurement, buffer: ImuBuffer, is_started: bool) -> int:
        """Learn from the newest frame's motion and return by how many ns the applied offset changes from now on.

        Args:
            vo: its motion, stamped in the IMU's time.
            buffer: the inertial data around it.
            is_started: gravity is known, so that nothing is lost by a change that is taken back.
        """
        self._offset.add(vo.t_ns - self.applied_ns, vo)
        self._frames += 1
        wanted = self._offset.wanted_ns()
        oldest_ns, newest_ns = buffer.oldest_t_ns, buffer.newest_t_ns
        if oldest_ns is None or newest_ns is None or wanted is None or self._frames % _EVERY_FRAMES:
            return 0
        span = buffer.span(max(wanted[0], oldest_ns), min(wanted[1], newest_ns))
        if span is None:
            return 0
        self._offset.solve(span)
        wanted_ns, before_ns = self._significant_ns(), self._wanted_before_ns
        self._wanted_before_ns = wanted_ns
        return self._change(wanted_ns if is_started or wanted_ns * before_ns > 0 else 0)

    def tell(self, further_s: float, sigma_s: float) -> int:
        """Take an offset beyond what is applied, found by other means; return the change as `follow` does."""
        self._offset.tell(self.applied_s + further_s, sigma_s)
        return self._change(self._significant_ns())

    def _significant_ns(self) -> int:
        """Return by how much the estimate differs from what is applied; 0 where that may be chance or is too little."""
        found, now_ns = self._offset.estimate, self._last_t_ns
        if now_ns is None:
            return 0
        shift_ns = round(found.at(now_ns) * _NS) - self.applied_ns
        needed_s = max(_SIGNIFICANT * found.sigma_s, _TIME_OFFSET_MIN_S)
        return shift_ns if abs(shift_ns) >= needed_s * _NS else 0

    def _change(self, shift_ns: int) -> int:
        found, now_ns = self._offset.estimate, self._last_t_ns
        if now_ns is None:
            return 0
        if self._config.clock_drift and abs(found.drift) > _SIGNIFICANT * found.drift_sigma:
            self._offset_ns, self._offset_t_ns, self.drift = self.applied_ns, now_ns, found.drift
        if shift_ns == 0:
            return 0
        shift_ns = max(shift_ns, -round(_MOST_BACK * self._interval_ns))
        self.applied_ns += shift_ns
        self._offset_ns += shift_ns
        self._corrected_ns += shift_ns
        self.changes += 1
        return shift_ns
