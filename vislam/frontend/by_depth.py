"""Frames that vision cannot place, by their depth image: against the last keyframes', from where motion predicts them.

In the dark and before bare walls a depth camera still measures depth. Directions that the shape of the room does not
constrain (along a wall or a corridor) are kept from the prediction, with its growing uncertainty: where that becomes
too large, the frame is lost as without depth.
"""

from dataclasses import dataclass, replace

import numpy as np

from vislam.config import FrontEndConfig
from vislam.core.geometry import invert, se3_adjoint, se3_exp, se3_log
from vislam.core.messages import Array, Frame, Keyframe, Tracking, VoMeasurement
from vislam.frontend.local_surfaces import WIDER, LocalSurfaces, is_alike
from vislam.frontend.result import metric_motion
from vislam.frontend.tracker import MIN_START_CORNERS
from vislam.frontend.view import sees
from vislam.vision.depth_alignment import DepthAlignment, Prior, align_depth

_DEPTH_ALONE_RENEW = 0.6  # overlap below which a new keyframe begins; each costs drift
_DEPTH_ALONE_OVERLAP = 0.4  # of its surface that falls on the last keyframes'; less fits by chance
# between the exposures of depth and colour of a frame: TUM's pairs are up to 16 ms apart, and depth is stamped late
DEPTH_APART_S = 0.03
_TURN_WALK, _SPEED_WALK = 2.0, 0.7  # rad/s and m/s per root of a second: 6 rad/s^2, 2 m/s^2 of a hand over 0.1 s
_TURN_SIGMA, _SPEED_SIGMA = 0.3, 0.2  # rad/s and m/s, of the rates from the last two frames that vision placed
_CHI2 = 22.5  # six degrees of freedom, exceeded once in 1000: depth and prediction contradict each other
_GYRO_SIGMA_RAD, _BIAS_RAD_S = 0.002, 0.2  # of a turn by the gyroscope, and of its bias where that is unknown


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A frame placed by its depth."""

    T_key_cam: Array  # [4, 4]
    covariance: Array  # [6, 6] of its right perturbation, rotation first
    reason: str  # why it should become a keyframe, or an empty string

    def motion(self, t_ns: int, keyframe_id: int, T_body_cam: Array) -> VoMeasurement:
        """Return the same as a measurement of the body's motion, degraded."""
        vo = metric_motion(t_ns, keyframe_id, self.T_key_cam, self.covariance, T_body_cam, 0, is_weak=True)
        return replace(vo, by_surfaces=True)


@dataclass(frozen=True, slots=True)
class Moved:
    """What is predicted of the camera since the last frame."""

    T_before: Array  # [4, 4] in the keyframe
    T_guess: Array  # [4, 4] now
    dt_s: float
    key_twist_per_s: Array  # [6] velocity of the camera at the keyframe
    depth_delay_s: float  # by which depth is taken later than its stamps say
    gyro_sigma_rad_s: float | None  # of its bias, where a gyroscope measured the turn; infinite: unknown


class ByDepth:
    """Follows the camera by depth while vision fails: pose in the keyframe and velocity with their covariance [12, 12].

    A velocity that nothing measures walks at random, so what depth does not see grows unsure as it should.
    """

    def __init__(self, config: FrontEndConfig, surfaces: LocalSurfaces) -> None:
        """Take the surfaces that frames are placed by."""
        self._config = config
        self._surfaces = surfaces
        self._covariance: Array | None = None  # [12, 12] pose and velocity; None while vision works
        self._of_vision: Array = np.zeros((6, 6))  # the last frame that it placed

    def note(self, vo: VoMeasurement, is_keyframe: bool, by_depth: bool, T_body_cam: Array) -> None:
        """Take note of a frame's result; by vision, it ends what was followed by depth."""
        if vo.tracking is not Tracking.LOST and not by_depth:
            adjoint = se3_adjoint(np.asarray(invert(T_body_cam)))
            self._of_vision, self._covariance = adjoint @ vo.covariance @ adjoint.T, None
        elif is_keyframe and by_depth and self._covariance is not None:
            self._covariance[:6, :] = self._covariance[:, :6] = 0.0
        elif is_keyframe:
            self._covariance = None
        if is_keyframe and not by_depth:
            self._of_vision = np.zeros((6, 6))

    def place(self, frame: Frame, keyframe: Keyframe, moved: Moved, tracks: int) -> Placed | None:
        """Return where depth puts a frame that vision could not place; None where that is not to be trusted.

        `tracks` is with how many the keyframe is followed: a frame that could begin with more, ends it.
        """
        covariance = self._predicted(moved)
        if not self._is_known(covariance):
            return None
        model, of_frame = self._surfaces.kept, self._surfaces.of(frame)
        if not model or of_frame is None:
            return None
        at_key, now = _velocities(moved)
        T_cam_depth = se3_exp((frame.depth_lag_s + moved.depth_delay_s) * now)
        to_cam = se3_adjoint(T_cam_depth)
        to_depth = np.linalg.inv(to_cam)
        off = DEPTH_APART_S**2 * (np.outer(now, now) + np.outer(at_key, at_key))
        known = to_depth @ (covariance[:6, :6] + off) @ to_depth.T + 1e-10 * np.eye(6)
        prior = Prior(np.asarray(moved.T_guess @ T_cam_depth), known)
        found = align_depth(of_frame, model, prior, WIDER * self._config.depth_sigma_rho)
        if not self._is_trusted(found, prior):
            return None
        of_pose = to_cam @ found.covariance @ to_cam.T + off
        self._covariance = _updated(covariance, of_pose)
        if not self._is_known(of_pose):
            return None
        T_key_cam = np.asarray(found.T_model_cam @ invert(T_cam_depth))
        return Placed(T_key_cam, of_pose, self._keyframe_reason(frame, keyframe, found, tracks))

    def _predicted(self, moved: Moved) -> Array:
        """Return the covariance [12, 12] after the motion, and keep it."""
        before, dt = self._covariance, moved.dt_s
        if before is None:
            before = np.zeros((12, 12))
            before[:6, :6] = self._of_vision
            before[6:, 6:] = np.diag(np.repeat([_TURN_SIGMA**2, _SPEED_SIGMA**2], 3))
        F = np.eye(12)
        F[:6, :6] = se3_adjoint(np.asarray(invert(moved.T_guess) @ moved.T_before))
        F[:6, 6:] = dt * np.eye(6)
        walk = np.diag(np.repeat([_TURN_WALK**2, _SPEED_WALK**2], 3))
        if moved.gyro_sigma_rad_s is not None:  # a gyroscope measures the turn: the rate known before is not used
            F[:3, 6:9] = 0.0
            bias_rad_s = min(moved.gyro_sigma_rad_s, _BIAS_RAD_S)
            walk[:3, :3] = 0.0
            before = before.copy()
            before[:3, :3] += (_GYRO_SIGMA_RAD**2 + (bias_rad_s * dt) ** 2) * np.eye(3)
        after = F @ before @ F.T
        after[:6, :6] += walk * dt**3 / 3.0
        after[:6, 6:] += walk * dt**2 / 2.0
        after[6:, :6] += walk * dt**2 / 2.0
        after[6:, 6:] += walk * dt
        self._covariance = 0.5 * (after + after.T)
        return self._covariance

    def _is_known(self, covariance: Array) -> bool:
        """Return whether a pose is known well enough for depth to go on from it."""
        turn, way = (float(np.linalg.eigvalsh(covariance[k : k + 3, k : k + 3])[-1]) for k in (0, 3))
        most_m = self._config.depth_alone_sigma_m
        return turn <= most_m**2 and way <= most_m**2  # a radian moves what is a metre away by one

    def _is_trusted(self, found: DepthAlignment, prior: Prior) -> bool:
        change = se3_log(invert(prior.T_model_cam) @ found.T_model_cam)
        chi2 = float(change @ np.linalg.solve(prior.covariance, change))
        return found.converged and found.overlap >= _DEPTH_ALONE_OVERLAP and is_alike(found) and chi2 <= _CHI2

    def _keyframe_reason(self, frame: Frame, keyframe: Keyframe, found: DepthAlignment, tracks: int) -> str:
        config = self._config
        dt_s = (frame.t_ns - keyframe.t_ns) * 1e-9
        if dt_s < config.keyframe_min_interval_s:
            return ""
        if tracks < MIN_START_CORNERS and frame.images and sees(frame, 0, config):
            return "there is something to see again"
        if found.overlap < _DEPTH_ALONE_RENEW:
            return f"only {found.overlap:.0%} of the depth overlaps"
        return f"{dt_s:.1f} s since the last keyframe" if dt_s >= config.keyframe_max_interval_s else ""


def _velocities(moved: Moved) -> tuple[Array, Array]:
    """Return the camera's velocities [6] at the keyframe and now, in its own frame now, rotation first."""
    now = se3_log(invert(moved.T_before) @ moved.T_guess) / moved.dt_s
    return se3_adjoint(np.asarray(invert(moved.T_guess))) @ moved.key_twist_per_s, now


def _updated(covariance: Array, of_pose: Array) -> Array:
    """Return the covariance [12, 12] of pose and velocity where the pose has become known to `of_pose` [6, 6]."""
    gain = np.linalg.solve(covariance[:6, :6] + 1e-10 * np.eye(6), covariance[:6, 6:]).T
    out = covariance.copy()
    out[:6, :6] = of_pose
    out[6:, :6] = gain @ of_pose
    out[:6, 6:] = out[6:, :6].T
    out[6:, 6:] -= gain @ (covariance[:6, :6] - of_pose) @ gain.T
    return 0.5 * (out + out.T)
