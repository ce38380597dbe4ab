"""Poses from elsewhere: motion capture, tags at known places, another SLAM, an odometry of its own."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vislam.config.ranges import Finite, NonNegative, Positive
from vislam.config.sensors import Vector3
from vislam.core.angles import wrapped
from vislam.core.errors import UsageError
from vislam.core.geometry import (
    quaternion_xyzw_from_rotation,
    rotation_from_quaternion_xyzw,
    so3_exp,
    so3_left_jacobian_inverse,
    so3_log,
    so3_right_jacobian,
)
from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.sensors.alignment import with_starts
from vislam.sensors.body import PARTS, BodyState
from vislam.sensors.measuring_frame import (
    UP,
    FrameKind,
    frame_pose,
    frame_variables,
    lever_point,
    placed,
    thinned_pairs,
)
from vislam.sensors.sensor import Begun, Configured, Variable, noisy

Quaternion = tuple[Finite, Finite, Finite, Finite]
_UNIT = 0.01  # by which a quaternion's norm may be off: four decimals
_FEWEST = 3  # poses; one alone may be wild
_MOST_SCALE = 3.0


@dataclass(frozen=True, slots=True)
class PoseSettings:
    """Settings of `pose`."""

    sigma_m: Positive = 0.01  # per axis
    sigma_rad: Positive = 0.01  # per axis; also how level the frame is
    frame: FrameKind = "own"  # "known": poses are in the world already
    target_m: Vector3 = (0.0, 0.0, 0.0)  # of what is seen, in the body
    target_quaternion_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)  # R_body_target
    time_offset_s: Finite = 0.0  # a reading is of so much after its stamp
    time_offset_sigma_s: NonNegative = 0.0  # above 0 it is estimated


@dataclass(frozen=True, slots=True)
class OdometrySettings:
    """Settings of `odometry`."""

    sigma_m: Positive = 0.02
    sigma_rad: Positive = 0.01  # also what roll and pitch of the frame drift by: they have no variable
    drift_m_per_sqrt_s: Positive = 0.02
    drift_rad_per_sqrt_s: Positive = 0.001
    extent_m: Positive = 20.0  # a turn of the frame about a place so far off moves its origin, too
    target_m: Vector3 = (0.0, 0.0, 0.0)
    target_quaternion_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)
    time_offset_s: Finite = 0.0
    time_offset_sigma_s: NonNegative = 0.0


class GivenPose(Configured):
    """A target's pose in a level frame; residual [6]: turn in the target's axes, then place in the frame's."""

    columns = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    sigma_columns = ("sigma_rad",) * 3 + ("sigma_m",) * 3
    touches = ("rotation", "position", "velocity", "gyro_bias")  # the last two by the time offset only

    def __init__(self, settings: PoseSettings | OdometrySettings, frame: tuple[Variable, ...]) -> None:
        """Take settings and the frame's variables. Raises UsageError for a quaternion that is none."""
        self.settings = s = settings
        if wrong := _why_no_rotation(np.array(s.target_quaternion_xyzw)):
            raise UsageError(f"target_quaternion_xyzw: {wrong}")
        self._R_body_target = rotation_from_quaternion_xyzw(np.array(s.target_quaternion_xyzw))
        self._target_m: Array = np.array(s.target_m, dtype=np.float64)
        offset = (Variable("time_offset_s", s.time_offset_sigma_s, s.time_offset_s),) if s.time_offset_sigma_s else ()
        self.variables = frame + offset
        self._frame = len(frame)

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        """Return measured minus predicted pose [6]."""
        there = body.later(self._offset_s(own))
        R, place = self._predicted(there, own)
        turned = so3_log(np.ascontiguousarray(R.T @ rotation_from_quaternion_xyzw(values[3:])))
        return np.concatenate([turned, values[:3] - place])

    def jacobians(self, values: Array, body: BodyState, own: Array) -> tuple[Array, Array]:
        """Return H [6, 15] and H_own [6, V]."""
        offset_s, frame = self._offset_s(own), own[: self._frame]
        there = body.later(offset_s)
        R, _ = self._predicted(there, own)
        point = placed(there, frame, self._target_m)
        turned = so3_log(np.ascontiguousarray(R.T @ rotation_from_quaternion_xyzw(values[3:])))
        by_turn = so3_left_jacobian_inverse(turned) @ self._R_body_target.T  # by a turn of the later body
        by_place, frame_R = point.H[:, PARTS["rotation"]], frame_pose(frame)[0]
        H, H_own = np.zeros((6, 15)), np.zeros((6, len(own)))
        turn_before = so3_exp(-offset_s * body.rate_rad_s)  # turn of the later body by one of the body
        H[:3, :3], H[3:, :3] = by_turn @ turn_before, by_place @ turn_before
        H[3:, PARTS["position"]] = frame_R
        H[3:, PARTS["velocity"]] = offset_s * frame_R
        by_bias = -offset_s * so3_right_jacobian(offset_s * body.rate_rad_s)
        H[:3, PARTS["gyro_bias"]], H[3:, PARTS["gyro_bias"]] = by_turn @ by_bias, by_place @ by_bias
        if self._frame:
            H_own[:3, 0] = by_turn @ there.R_world_body.T @ frame_R.T @ UP
            H_own[3:, : self._frame] = point.by_frame
        if len(own) > self._frame:
            H_own[:3, -1] = by_turn @ body.rate_rad_s
            H_own[3:, -1] = frame_R @ body.velocity_m_s + by_place @ body.rate_rad_s
        return H, H_own

    def noise(self, values: Array) -> Array:
        """Return the covariance [6, 6] of a pose that brings none."""
        return np.diag([self.settings.sigma_rad**2] * 3 + [self.settings.sigma_m**2] * 3)

    def check(self, values: Array) -> str:
        """Return why a pose is none."""
        return _why_no_rotation(values[3:])

    def begin(self, readings: Sequence[Reading], bodies: Sequence[BodyState]) -> Begun | None:
        """Return the frame of the first few poses that agree."""
        if not self._frame:
            return super().begin(readings, bodies)
        if len(readings) < _FEWEST:
            return None
        readings, bodies = thinned_pairs(readings, bodies)
        there = [body.later(self.settings.time_offset_s) for body in bodies]
        poses = np.array([reading.values for reading in readings])
        covariances = [self.noise(r.values) if r.covariance is None else r.covariance for r in readings]
        sigma_rad, sigma_m = (
            math.sqrt(float(np.median([np.trace(c[part, part]) / 3.0 for c in covariances])))
            for part in (slice(0, 3), slice(3, 6))
        )
        measured = rotation_from_quaternion_xyzw(poses[:, 3:])
        turns = [R @ (body.R_world_body @ self._R_body_target).T for R, body in zip(measured, there, strict=True)]
        headings = np.array([math.atan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1]) for T in turns])
        yaw, scale_yaw = _typical_heading(headings, sigma_rad)
        R = frame_pose(np.array([yaw, 0.0, 0.0, 0.0]))[0]
        world = np.array([body.position_m + body.R_world_body @ self._target_m for body in there])
        shifts = poses[:, :3] - world @ R.T
        shift = np.median(shifts, axis=0)
        sigma_yaw = scale_yaw * sigma_rad  # not less by many poses: what they share, such as a tilt, is in it
        off = float(np.median(np.abs(shifts - shift))) / 0.6745
        reach = float(np.linalg.norm(world[:, :2], axis=1).max())
        sigma_shift = math.hypot(sigma_m, sigma_yaw * reach)
        if scale_yaw > _MOST_SCALE or off > _MOST_SCALE * sigma_shift:
            return None
        found = Begun(np.array([yaw, *shift]), np.array([sigma_yaw, sigma_shift, sigma_shift, sigma_m]))
        return with_starts(found, self.variables)

    def draw(self, body: BodyState, own: Array, rng: np.random.Generator) -> Array:
        """Return the pose of a true body's target."""
        R, place = self._predicted(body.later(self._offset_s(own)), own)
        error = noisy(np.zeros(6), self.noise(np.zeros(7)), rng)
        return np.concatenate([place + error[3:], quaternion_xyzw_from_rotation(R @ so3_exp(error[:3].copy()))])

    def _predicted(self, there: BodyState, own: Array) -> tuple[Array, Array]:
        """Return rotation [3, 3] and place [3] of the target in the frame."""
        frame = own[: self._frame]
        R = frame_pose(frame)[0] @ there.R_world_body @ self._R_body_target
        return R, lever_point(there, frame, self._target_m)

    def _offset_s(self, own: Array) -> float:
        return float(own[-1]) if len(own) > self._frame else self.settings.time_offset_s


class Pose(GivenPose):
    """A pose in a frame that stays where it is."""

    Settings = PoseSettings

    def __init__(self, settings: PoseSettings | None = None) -> None:
        """Take settings; the defaults without any."""
        settings = settings or PoseSettings()
        super().__init__(settings, frame_variables(settings.frame))


class Odometry(GivenPose):
    """A pose in a frame that drifts: it measures the motion between any two times, the surer the closer they are.

    Translation and heading of the frame walk. Its roll and pitch do not; what they drift by belongs into `sigma_rad`.
    """

    Settings = OdometrySettings

    def __init__(self, settings: OdometrySettings | None = None) -> None:
        """Take settings; the defaults without any."""
        s = settings or OdometrySettings()
        walk_m = math.hypot(s.drift_m_per_sqrt_s, s.extent_m * s.drift_rad_per_sqrt_s)
        super().__init__(s, frame_variables("own", walk_m, s.drift_rad_per_sqrt_s))


def _typical_heading(headings: Array, sigma: float) -> tuple[float, float]:
    """Return the median of headings near one another, and by what they are off from it, in sigmas, at least 1."""
    middle = math.atan2(float(np.median(np.sin(headings))), float(np.median(np.cos(headings))))
    away = np.array([wrapped(float(heading) - middle) for heading in headings])
    yaw = middle + float(np.median(away))
    off = float(np.median(np.abs(away - np.median(away)))) / 0.6745
    return wrapped(yaw), max(1.0, off / sigma)


def _why_no_rotation(quaternion: Array) -> str:
    norm = float(np.linalg.norm(quaternion))
    return "" if abs(norm - 1.0) <= _UNIT else f"a quaternion of norm {norm:g}, 1 is asked; order is x, y, z, w"
