"""Where a frame is on the floor: how sure that is, and whether it can be believed."""

from dataclasses import dataclass

import numpy as np

from vislam.config import PlanarConfig
from vislam.core.messages import Array, Bools
from vislam.frontend.attempt import DEGRADED_INLIER_RATIO, DEGRADED_INLIERS
from vislam.frontend.planar.fit import Fit, scale_sigma
from vislam.frontend.planar.floor import Turn

STAMP_JITTER_S = 0.002  # of frames, by a webcam over USB; in a turn 1 ms is 0.05 deg
_CORRELATION_M = 10.0  # way over which an error of height or tilt adds up: the size of a room
MIN_POINTS = 20  # of the floor that agree on a motion; fewer: lost
MIN_CELLS = 4  # of 8 parts of the floor in which they lie
_YAW_GATE_DEG = 0.3  # and by at least as much
_LENS_YAW_RAD = 0.001  # of a yaw between keyframe and frame by the gyroscope: scale, axes, time
_GYRO_KNOWN_ALREADY = 3.0  # on its sigma, since filter and graph use the same gyroscope
_DEGRADED_VARIANCE = 25.0  # of residuals over what is expected: five times as noisy as a sharp floor
_SCALE_BY_TILT = 2.9  # per rad: half a degree of tilt is 2.5 % of the way
_UNEXPLAINED_RATIO = 0.3  # of the points that should be on the floor; fewer agree, and something else moves


class Course:
    """Predicts by the velocity seen last and by the gyroscope's yaw. Motions [3] are theta, x, y of the level frame.

    Attributes:
        motion: [3] since the keyframe, of the newest frame; predicted while lost.
        rate: [3] per second, in the level frame of the frame it leads to.
        yaw_rad: since the keyframe, by the gyroscope.
        yaw_sigma_rad: of that, by the gyroscope's bias; infinite: not known.
    """

    def __init__(self, patience_s: float) -> None:
        """Start at rest; after `patience_s` without a frame the velocity is forgotten."""
        self._patience_s = patience_s
        self._is_lost = False
        self.rate: Array = np.zeros(3)
        self.begin()

    def begin(self, at_rest: bool = False) -> None:
        """Begin again at a keyframe; `at_rest` also forgets the velocity."""
        self.motion: Array = np.zeros(3)
        self.yaw_rad, self.yaw_sigma_rad = 0.0, 0.0
        if at_rest:
            self.rate, self._is_lost = np.zeros(3), False

    @property
    def knows_yaw(self) -> bool:
        """Whether the gyroscope has measured the whole yaw since the keyframe."""
        return bool(np.isfinite(self.yaw_sigma_rad))

    def predicted(self, turn: Turn, dt_s: float, gyro_sigma_rad_s: float) -> Array:
        """Return the motion [3] expected `dt_s` after the newest frame, and add up the yaw that the gyroscope gives."""
        if turn.known:
            self.yaw_rad += turn.yaw_rad
            self.yaw_sigma_rad += gyro_sigma_rad_s * dt_s
        else:
            self.yaw_sigma_rad = np.inf
        rate = self.rate if dt_s <= self._patience_s else np.zeros(3)
        yaw = turn.yaw_rad if turn.known else float(rate[0] * dt_s)
        return _composed(self.motion, np.array([yaw, rate[1] * dt_s, rate[2] * dt_s]))

    def follow(self, found: Array, dt_s: float) -> None:
        """Take note of the velocity that leads to the motion found."""
        step = _between(self.motion, found)
        self.rate = step / dt_s if not self._is_lost else np.zeros(3)
        self.motion, self._is_lost = found.copy(), False

    def lose(self, guess: Array) -> None:
        """Go on from the pose that the cart is expected to have, as the frame gave none."""
        self.motion, self._is_lost = guess, True


def _rotated(xy: Array, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * xy[0] - s * xy[1], s * xy[0] + c * xy[1]])


def _composed(motion: Array, step: Array) -> Array:
    """Return a motion [3] followed by a step [3] in the frame it leads to."""
    return np.array([motion[0] + step[0], *(motion[1:] + _rotated(step[1:], motion[0]))])


def _between(a: Array, b: Array) -> Array:
    """Return the step [3] that leads from motion a to motion b, in the frame that a leads to."""
    return np.array([b[0] - a[0], *_rotated(b[1:] - a[1:], -a[0])])


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where a frame is relative to the keyframe."""

    T_key_cam: Array  # [4, 4]
    covariance: Array  # [6, 6] of the camera's motion
    fit: Fit
    pixels: Array  # [N, 2] of all tracks, NaN where not found
    xy: Array  # [N, 2] on z = 1
    candidates: int  # tracks that should be on the floor
    good: Bools  # [N] tracks that agree with the motion, on the floor or off it
    failure: str
    weakness: str

    @property
    def agreeing(self) -> int:
        """How many points on the floor agree on the motion."""
        return int(np.count_nonzero(self.fit.inliers))


def yaw_prior(course: Course) -> tuple[float, float] | None:
    """Return the yaw since the keyframe by the gyroscope, and the sigma with which a fit may use it."""
    if not course.knows_yaw:
        return None
    return course.yaw_rad, _GYRO_KNOWN_ALREADY * (_LENS_YAW_RAD + course.yaw_sigma_rad)


def by_tilt(fit: Fit, T_key_cam: Array, tilt_covariance: Array, config: PlanarConfig) -> Array:
    """Return the covariance [6, 6] by which errors of the mean tilt, which last, exceed those of each motion.

    Their share of the way adds up over `correlation_m`, while a filter takes errors of motions for independent.
    """
    way = T_key_cam[:3, :3].T @ T_key_cam[:3, 3]
    length = float(np.linalg.norm(way))
    out = np.zeros((6, 6))
    if length < 1e-6:
        return out
    if config.method == "split":
        relative = float(_SCALE_BY_TILT * np.sqrt(tilt_covariance[1, 1]))
    else:
        relative = scale_sigma(fit, tilt_covariance)
    out[3:, 3:] = relative**2 * max(length, _CORRELATION_M) / length * np.outer(way, way)
    return out


def by_jitter(rate: Array, R_level_cam: Array, jitter_s: float) -> Array:
    """Return the covariance [6, 6] of a motion whose ends were stamped a little early or late, at a rate [3]."""
    turning, moving = R_level_cam[2] * rate[0], rate[1:] @ R_level_cam[:2]
    step = np.concatenate([turning, moving]) * jitter_s
    return 2.0 * np.outer(step, step)


def failure(fit: Fit, candidates: int, course: Course, config: PlanarConfig) -> str:
    """Return why a fit cannot be believed, or an empty string."""
    if fit.failure:
        return fit.failure
    agree, is_split = int(np.count_nonzero(fit.inliers)), config.method == "split"
    if agree < MIN_POINTS and not is_split:
        return f"only {agree} of {candidates} points on the floor agree on a motion"
    if agree < _UNEXPLAINED_RATIO * candidates:
        return f"only {agree} of {candidates} points that should be on the floor agree on a motion"
    if is_split or not course.knows_yaw:
        return ""
    # the prior pulls: what is left of a contradiction is the smaller, the weaker the floor is
    jitter_rad = np.sqrt(2.0) * STAMP_JITTER_S * course.rate[0]  # of the stamps at both ends
    gyro_rad = _LENS_YAW_RAD + course.yaw_sigma_rad
    sigma_rad = float(np.sqrt(fit.covariance[0, 0] + gyro_rad**2 + jitter_rad**2))
    limit = max(config.yaw_gate_sigmas * sigma_rad, np.deg2rad(_YAW_GATE_DEG))
    off = abs(float(fit.motion[0]) - course.yaw_rad)
    if off > limit:
        return f"the floor turned by {np.rad2deg(off):.2f} deg more or less than the gyroscope says"
    return ""


def weakness(fit: Fit, candidates: int, cells: int) -> str:
    """Return why the tracking is degraded, or an empty string; `cells` of the floor hold points that agree."""
    agree = int(np.count_nonzero(fit.inliers))
    if cells < MIN_CELLS:
        return f"points on the floor in only {cells} of 8 parts of the image"
    if agree < DEGRADED_INLIERS:
        return f"only {agree} points on the floor agree"
    if agree < DEGRADED_INLIER_RATIO * candidates:
        return f"only {agree} of {candidates} points that should be on the floor agree"
    if fit.variance > _DEGRADED_VARIANCE:
        return f"points on the floor are {np.sqrt(fit.variance):.0f} times as noisy as expected"
    return ""
