"""Rotations of a camera from its images alone: no gyroscope, no scale, no extrinsics."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import invert, so3_log
from vislam.core.messages import Array, Frame, Tracking
from vislam.frontend import make_frontend
from vislam.frontend.tracker import Tracker
from vislam.vision.two_view import essential_ransac, refine_two_view

_LONGEST_NS = 600_000_000  # between the frames of a pair: longer, and the scene is another
_MOST_TURN_RAD = np.deg2rad(25.0)
_LEAST_ALIVE = 0.5  # share of tracks, below which a new keyframe begins
_MIN_INLIERS = 25
_SEED_PX = 2.0  # of RANSAC


@dataclass(frozen=True, slots=True, eq=False)
class RotationPair:
    """How the camera turned from one frame to a later one."""

    key_ns: int
    t_ns: int
    R_key_cam: Array  # [3, 3]
    covariance: Array  # [3, 3], on the right side


def visual_rotations(frames: Iterator[Frame], camera: Camera, config: FrontEndConfig) -> Iterator[RotationPair]:
    """Yield rotations between keyframes and the frames after them, by epipolar geometry; lost ones are left out."""
    tracker = Tracker(config)
    key_ns, begun = 0, 0
    guess: Array = np.empty((0, 2))
    key_xy: Array = np.empty((0, 2))
    R = np.eye(3)
    for frame in frames:
        if len(tracker) >= _MIN_INLIERS and frame.t_ns - key_ns <= _LONGEST_NS:
            pixels = tracker.follow(frame, guess)
            xy = camera.normalise(pixels)
            found = _between(R, key_xy, xy, camera, config)
            if found is not None:
                R, covariance, good = found
                yield RotationPair(key_ns, frame.t_ns, R, covariance)
                alive = tracker.judge(good)
                guess = np.where(np.isfinite(pixels), pixels, guess)[alive]
                key_xy = key_xy[alive]
                turned = float(np.linalg.norm(so3_log(R)))
                if len(tracker) >= _LEAST_ALIVE * begun and turned < _MOST_TURN_RAD:
                    continue
        tracker.forget()
        tracker.begin(frame, np.zeros(0, dtype=np.bool_), np.empty((0, 2)))
        key_ns, begun, R = frame.t_ns, len(tracker), np.eye(3)
        guess = tracker.pixels.copy()
        key_xy = camera.normalise(tracker.pixels)


def _between(
    R_before: Array, key_xy: Array, xy: Array, camera: Camera, config: FrontEndConfig
) -> tuple[Array, Array, NDArray[np.bool_]] | None:
    """Return rotation, its covariance and which tracks agree; None when too few do."""
    start = essential_ransac(R_before, key_xy, xy, _SEED_PX / camera.fx, _MIN_INLIERS)
    if start is None:
        return None
    estimate = refine_two_view(*start[:2], key_xy, xy, config.track_sigma_px / camera.fx, config.cauchy)
    if not estimate.converged or int(estimate.inliers.sum()) < _MIN_INLIERS:
        return None
    return estimate.R_key_cam, estimate.covariance[:3, :3], estimate.inliers


def metric_rotations(frames: Iterator[Frame], rig: Rig, config: FrontEndConfig) -> Iterator[RotationPair]:
    """Yield rotations of cam0 since the keyframe by stereo or depth odometry, in which no motion passes for a turn."""
    T_cam0_body = invert(rig.T_body_cams[0])
    alone = Rig(rig.cameras, tuple(T_cam0_body @ T for T in rig.T_body_cams), rig.has_depth)
    front = make_frontend(config, alone, 0)
    keyframe_id: int | None = None
    key_ns = last_ns = 0
    for frame in frames:
        vo = front.track(frame, None).vo
        if vo.keyframe_id != keyframe_id:  # the frame before became the keyframe
            keyframe_id, key_ns = vo.keyframe_id, last_ns or frame.t_ns
        last_ns = frame.t_ns
        if vo.T_keyframe_body is not None and vo.tracking is not Tracking.LOST and frame.t_ns > key_ns:
            R = np.ascontiguousarray(vo.T_keyframe_body[:3, :3])
            yield RotationPair(key_ns, frame.t_ns, R, vo.covariance[:3, :3])
