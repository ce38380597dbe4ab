"""What a front end answers for every frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from vislam.config import FrontEndConfig
from vislam.core.camera import Rig
from vislam.core.geometry import invert, se3_adjoint, transform
from vislam.core.imu_noise import ImuNoise
from vislam.core.memory import Learned
from vislam.core.messages import Array, Frame, ImuSpan, Keyframe, Observations, Tracking, VoMeasurement
from vislam.vision.two_view import TwoViewEstimate

_NO_KNOWLEDGE = 1e6  # variance in rad^2 and m^2 of a measurement without information


@dataclass(frozen=True, slots=True, eq=False)
class TrackResult:
    """One tracked frame: the motion since the keyframe, what was seen, and the new keyframe if it became one."""

    vo: VoMeasurement
    observations: Observations
    keyframe: Keyframe | None
    median_parallax_px: float  # since the keyframe that `vo` refers to, rotation taken out; 0 when nothing was followed
    reason: str  # why tracking is not ok, or why the frame became a keyframe; empty otherwise
    sigma_px: float = float("nan")  # of a track's pixel, as measured in this run; as stated until enough was seen
    by_depth: bool = False  # vision failed, and the depth image alone places the frame
    outliers: float = 0.0  # share of the followed tracks that do not agree on a motion, before a filter has its say
    others: int = 0  # tracks that agree on another motion than the frame's: something moves by itself

    def with_scatter(self, sigma_px: float, noise: float) -> TrackResult:
        """Return the result with what the run shows of its tracks; `noise` as in `Observations`."""
        return replace(self, sigma_px=sigma_px, observations=replace(self.observations, noise=noise))


@dataclass(frozen=True, slots=True)
class CommonErrors:
    """How motions err together, which their covariances leave out."""

    scale_sigma: float = 0.0  # relative, of all metres
    vo_inflation: float | None = None  # on sigmas, in a loose filter; None: `ekf.vo_inflation`


class FrontEnd(Protocol):
    """Visual odometry that is fed frame by frame."""

    mode: str  # its name in `frontend.mode`
    knows_scale: bool  # whether its motions are in metres
    keyframe_spacing: float  # widens the distances between keyframes; 1, unless a live back end does not keep up

    def track(
        self, frame: Frame, imu: ImuSpan | None, gyro_sigma_rad_s: float = np.inf, T_last_now: Array | None = None
    ) -> TrackResult:
        """Follow the last keyframe into `frame`; `imu` is the bias-corrected span since the previous frame.

        `gyro_sigma_rad_s` is how well the gyroscope's bias is known; infinite: not at all, the span only predicts.
        `T_last_now` [4, 4] is the body's motion since the previous frame where a filter knows it to centimetres: where
        most tracks that vision moves by contradict it, they belong to something else that moves, and the others count.

        Raises DataError when the images do not fit the rig or time does not advance.
        """
        ...

    def begin_at(self, keyframe_id: int, learned: Learned, seeks_place: bool = False) -> None:
        """Number the first keyframe and new tracks as given, and know what is known; before the first frame.

        With `seeks_place` the first keyframes come quickly, as after a loss: chances to recognise the place.
        """
        ...

    @property
    def learned(self) -> Learned:
        """Return what was learned so far, as `begin_at` takes it; what others learn is left out."""
        ...

    @property
    def calibration(self) -> dict[str, float]:
        """Return what was learned of the camera's mount, for the report, with standard deviations."""
        ...


class FrontEndKind(FrontEnd, Protocol):
    """What a mode brings: how it begins, and what its motions have in common."""

    def __init__(self, config: FrontEndConfig, rig: Rig, seed: int) -> None:
        """Take the cameras to look through; raises UsageError when the rig lacks what the front end needs."""
        ...

    @classmethod
    def errors(cls, config: FrontEndConfig, rig: Rig, noise: ImuNoise | None) -> CommonErrors:
        """Return what motions seen by a rig have in common; `noise` is the IMU's, None without one."""
        ...


def identity_motion(t_ns: int, keyframe_id: int, has_scale: bool, tracks: int) -> VoMeasurement:
    """Return the measurement of the very first keyframe: it is where it is, exactly."""
    return VoMeasurement(t_ns, keyframe_id, np.eye(4), np.zeros((6, 6)), has_scale, Tracking.OK, tracks)


def lost_motion(t_ns: int, keyframe_id: int, has_scale: bool, inliers: int = 0) -> VoMeasurement:
    """Return the measurement of a frame whose motion since keyframe `keyframe_id` (-1: none yet) is unknown."""
    covariance: Array = np.eye(6) * _NO_KNOWLEDGE
    return VoMeasurement(t_ns, keyframe_id, None, covariance, has_scale, Tracking.LOST, inliers)


def metric_motion(
    t_ns: int, keyframe_id: int, T_key_cam: Array, covariance: Array, T_body_cam: Array, inliers: int, is_weak: bool
) -> VoMeasurement:
    """Return the measurement of a camera's motion [4, 4] in metres with covariance [6, 6], as the body's."""
    adjoint = se3_adjoint(T_body_cam)
    of_body = adjoint @ covariance @ adjoint.T
    return VoMeasurement(
        t_ns=t_ns,
        keyframe_id=keyframe_id,
        T_keyframe_body=body_motion(T_key_cam, T_body_cam),
        covariance=0.5 * (of_body + of_body.T),
        has_scale=True,
        tracking=Tracking.DEGRADED if is_weak else Tracking.OK,
        inliers=inliers,
    )


def unscaled_motion(
    t_ns: int, keyframe_id: int, view: TwoViewEstimate, R_body_cam: Array, inliers: int, is_weak: bool
) -> VoMeasurement:
    """Return the measurement of a camera's turn and direction in body axes; the perturbation is on the body side."""
    R_key_body = R_body_cam @ view.R_key_cam @ R_body_cam.T
    change = np.zeros((6, 6))
    change[:3, :3] = R_body_cam
    change[3:, 3:] = R_key_body.T @ R_body_cam
    covariance = change @ view.covariance @ change.T
    return VoMeasurement(
        t_ns=t_ns,
        keyframe_id=keyframe_id,
        T_keyframe_body=np.asarray(transform(R_key_body, R_body_cam @ view.direction_key)),
        covariance=0.5 * (covariance + covariance.T),
        has_scale=False,
        tracking=Tracking.DEGRADED if is_weak else Tracking.OK,
        inliers=inliers,
    )


def too_few(frame: Frame, corners: int) -> str:
    """Return why a frame with this number of corners or given tracks cannot start a keyframe."""
    if frame.tracks is not None:
        return f"only {corners} points were given"
    return f"only {corners} corners in an image of mean grey {frame.images[0].mean():.0f}"


def scaled_motion(vo: VoMeasurement) -> Array:
    """Return the motion [4, 4] since the keyframe as far as it is known: without scale, its rotation alone."""
    assert vo.T_keyframe_body is not None
    if vo.has_scale:
        return vo.T_keyframe_body
    return transform(np.ascontiguousarray(vo.T_keyframe_body[:3, :3]), np.zeros(3))


def body_motion(T_cam_a_b: Array, T_body_cam0: Array) -> Array:
    """Return the body's motion [4, 4] when its camera moved by T_cam_a_b [4, 4]."""
    return T_body_cam0 @ T_cam_a_b @ invert(T_body_cam0)
