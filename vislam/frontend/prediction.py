"""Where the camera will be in the next frame: rotation from the gyroscope if there is one, else constant velocity."""

from __future__ import annotations

import numpy as np

from vislam.core.geometry import invert, se3_adjoint, se3_exp, se3_log
from vislam.core.messages import Array, ImuSpan
from vislam.imu.gyro_turns import integrate_gyro


def gyro_rotation(span: ImuSpan) -> Array:
    """Return R_first_last [3, 3] of the body over a span, by trapezoidal integration of the angular rate."""
    t_s = (span.t_ns - span.t_ns[0]).astype(np.float64) * 1e-9
    return np.asarray(integrate_gyro(t_s, np.ascontiguousarray(span.gyro_rad_s))[-1])


class MotionPredictor:
    """Predicts the camera's motion over one frame interval from the last one and from the gyroscope."""

    def __init__(self, T_body_cam0: Array, longest_s: float) -> None:
        """Take the camera's pose on the body and the longest interval over which velocity is worth keeping."""
        self._R_body_cam = T_body_cam0[:3, :3].copy()
        self._longest_s = longest_s
        self._twist_per_s = np.zeros(6)

    def forget(self) -> None:
        """Assume a camera at rest, as after a loss."""
        self._twist_per_s = np.zeros(6)

    def look_through(self, T_body_cam: Array, T_cam_other: Array) -> None:
        """Go on predicting for another camera of the same body, at T_cam_other [4, 4] as the present one sees it."""
        self._R_body_cam = T_body_cam[:3, :3].copy()
        self._twist_per_s = se3_adjoint(np.asarray(invert(T_cam_other))) @ self._twist_per_s

    def observe(self, T_before_now: Array, dt_s: float) -> None:
        """Take note of the motion [4, 4] that was measured over `dt_s` seconds."""
        self._twist_per_s = se3_log(T_before_now) / dt_s

    def predict(self, dt_s: float, imu: ImuSpan | None) -> Array:
        """Return T_now_next [4, 4] of cam0 over the next `dt_s` seconds."""
        twist = self._twist_per_s * dt_s if dt_s <= self._longest_s else np.zeros(6)
        T = np.asarray(se3_exp(twist))
        if imu is not None and len(imu.t_ns) >= 2 and bool(np.isfinite(imu.gyro_rad_s).all()):
            T[:3, :3] = self._R_body_cam.T @ gyro_rotation(imu) @ self._R_body_cam
        return T


def body_motion(T_cam_a_b: Array, T_body_cam0: Array) -> Array:
    """Return the body's motion [4, 4] when its camera moved by T_cam_a_b [4, 4]."""
    return T_body_cam0 @ T_cam_a_b @ invert(T_body_cam0)
