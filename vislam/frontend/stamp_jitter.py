"""By how much single stamps of a camera are off: those of arrival over USB are by milliseconds, and change each time.

A camera takes images evenly; by how much its stamps are not even bounds the jitter, but some cameras take them unevenly
and say so rightly. The gyroscope decides: a frame whose stamp is late makes the turn before it too large and the one
after it too small, in proportion to the rate and about its axis, while errors of vision are alike about all axes.
"""

from collections import deque

import numpy as np

from vislam.core.geometry import so3_log
from vislam.core.messages import Array, ImuSpan, Tracking, VoMeasurement
from vislam.imu.gyro_turns import gyro_rotation

_STAMPS = 128  # whose unevenness counts
_FEWEST, _EVERY = 8, 8  # of them before it is known, and between two looks
_SHORT = 0.25  # quantile of intervals that no frame is missing in
_OUTLIER = 6.0  # medians of their sizes, at which changes of intervals are cut: four sigmas
_LEAST_S, _MOST_S = 1e-4, 0.01  # a smaller jitter is as good as none, a larger one another fault
_SLACK_RAD = 5e-3  # of a visual rotation from frame to frame, beyond which it is another fault


class StampJitter:
    """Owns the newest stamps, and what turns by vision and gyroscope say of them."""

    def __init__(self) -> None:
        """Start without a jitter."""
        self._stamps_ns: deque[int] = deque(maxlen=_STAMPS)
        self._count = 0
        self._even_s = 0.0  # sigma of the stamps around even ones
        self._keyframe_id, self._R_key_last = -1, np.eye(3)
        self._last: tuple[float, float, Array] | None = None  # rate, and the error along and across it, of a turn
        self._sums = np.zeros(3)  # weighted variance, its weight, and the variance of the sum

    @property
    def sigma_s(self) -> float:
        """Standard deviation of a stamp, in seconds."""
        bound = self._even_s**2
        if bound == 0.0:
            return 0.0
        total, weight, spread = self._sums
        share = weight / spread if spread > 0.0 else 0.0
        found = (1.0 / bound + total * share) / (1.0 / bound**2 + weight * share)  # a prior of bound +- bound
        return float(np.sqrt(np.clip(found, 0.0, bound)))

    def stamp(self, t_ns: int) -> None:
        """Take the stamp of a frame as the camera gave it."""
        self._stamps_ns.append(t_ns)
        self._count += 1
        if self._count < _FEWEST or (self._count > _STAMPS // 4 and self._count % _EVERY):
            return
        steps_s = np.diff(np.array(self._stamps_ns)) * 1e-9
        frames = np.maximum(np.round(steps_s / max(np.quantile(steps_s, _SHORT), 1e-9)), 1.0)
        uneven_s = steps_s - frames * np.median(steps_s / frames)
        changes_s = np.abs(np.diff(uneven_s))  # of three stamps, the middle one twice
        usual_s = np.minimum(changes_s, _OUTLIER * np.median(changes_s))
        even_s = min(float(np.sqrt(np.mean(usual_s**2) / 6.0)), _MOST_S)
        self._even_s = even_s if even_s > _LEAST_S else 0.0

    def see(self, vo: VoMeasurement, span: ImuSpan | None, gyro_bias_rad_s: Array) -> None:
        """Compare the turn since the last frame by vision with that of the samples [N, 3] between the two."""
        is_new, before, self._last = vo.keyframe_id != self._keyframe_id, self._last, None
        R_key_last = np.eye(3) if is_new else self._R_key_last
        self._keyframe_id = vo.keyframe_id
        if vo.T_keyframe_body is None or vo.tracking is Tracking.LOST:
            self._keyframe_id = -1
            return
        self._R_key_last = vo.T_keyframe_body[:3, :3]
        if span is None or self._even_s == 0.0:
            return
        turned = gyro_rotation(ImuSpan(span.t_ns, span.gyro_rad_s - gyro_bias_rad_s, span.accel_m_s2))
        error = so3_log(turned.T @ R_key_last.T @ self._R_key_last)
        mean = so3_log(turned) / (int(span.t_ns[-1] - span.t_ns[0]) * 1e-9)
        rate = float(np.linalg.norm(mean))
        if not 0.0 < np.linalg.norm(error) < _SLACK_RAD + rate * _MOST_S:
            return
        along = float(error @ mean) / max(rate, 1e-9)
        self._last = rate, along, error - along * mean / max(rate, 1e-9)
        if before is not None:
            weight = rate * before[0]
            product = weight * (0.5 * float(self._last[2] @ before[2]) - along * before[1])
            self._sums += product, weight**2, product**2
