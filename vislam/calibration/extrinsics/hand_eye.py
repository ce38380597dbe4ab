"""Rotation between camera and IMU and the offset of their clocks, from turns that both saw.

Start by correlating the speeds of turning and aligning the rotation vectors (Kabsch), then robust Gauss-Newton over
rotation, offset and gyro bias on the errors of `imu/gyro_turns.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import invert, so3_exp, so3_log
from vislam.core.jackknife import jackknife_variances, moves_without
from vislam.core.messages import Array, Frame, Tracking
from vislam.frontend import make_frontend
from vislam.frontend.tracker import Tracker
from vislam.imu.gyro_turns import SeenTurns, integrated, turn_errors, turns_between
from vislam.vision.two_view import essential_ransac, refine_two_view

_LONGEST_NS = 600_000_000  # between the frames of a pair: longer, and the scene is another
_MOST_TURN_RAD = np.deg2rad(25.0)
_LEAST_ALIVE = 0.5  # share of tracks, below which a new keyframe begins
_MIN_INLIERS = 25
_SEED_PX = 2.0  # of RANSAC
_REACH_S = 0.25  # offsets that are looked for
_GRID_S = 0.005
_ROUNDS = 15
_CONVERGED = 1e-3  # sigmas
_CAUCHY = 3.0
_FLOOR_RAD = 1e-4  # of a visual rotation: none is better
_BLOCKS = 20  # of time, whose omission shows the effect of errors that last
_BIAS_SIGMA = 1.0  # rad/s, prior: keeps the problem regular without a turn


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


@dataclass(frozen=True, slots=True, eq=False)
class HandEye:
    """The answer, with covariance [7, 7] of rotation (body axes), offset in s and gyro bias."""

    R_body_cam: Array  # [3, 3]
    time_offset_s: float  # to be added to the camera's stamps
    gyro_bias_rad_s: Array  # [3]
    covariance: Array
    pairs: int
    residual_rad: Array  # [pairs] length of what is left
    times_s: Array  # [pairs] when, from the first sample
    correlation: Array  # [G, 2] offset in s and correlation of the speeds
    misfit: float  # chi-square per degree of freedom, of the visual covariances
    grouping: float  # how much more blocks of time contradict each other than single pairs would
    turned_rad: Array  # [3] root of the sum of squared turns along the principal axes, the largest first

    @property
    def sigmas(self) -> Array:
        """Standard deviations [7]: rotation in rad, offset in s, bias in rad/s."""
        return np.sqrt(np.diag(self.covariance))


def solve_hand_eye(pairs: list[RotationPair], t_ns: NDArray[np.int64], gyro_rad_s: Array) -> HandEye | None:
    """Estimate from pairs of frames and samples [N] of the gyroscope; None when fewer than 30 pairs overlap them."""
    problem = _Problem.of(pairs, t_ns, gyro_rad_s)
    if len(problem.seen.key_s) < 30:
        return None
    correlation = _correlate(problem)
    offset = float(correlation[int(np.argmax(correlation[:, 1])), 0])
    x_R = problem.kabsch(offset)
    td_bias = np.concatenate([[offset], np.zeros(3)])
    H, weights, r, J = np.eye(7), np.ones(len(problem.seen.key_s)), np.zeros(0), np.zeros(0)
    scale = 1.0
    for _ in range(_ROUNDS):
        r, J = problem.linearise(x_R, td_bias)
        chi2 = np.sum(r**2, axis=1) / 3.0
        scale = max(float(np.sqrt(np.median(chi2) / 0.79)), 0.1)  # 0.79: median of chi2 of 3, over 3
        weights = 1.0 / (1.0 + chi2 / (_CAUCHY * scale) ** 2) / scale**2
        H = np.einsum("n,nia,nib->ab", weights, J, J)
        H[4:, 4:] += np.eye(3) / _BIAS_SIGMA**2
        g = np.einsum("n,nia,ni->a", weights, J, r)
        g[4:] += td_bias[1:] / _BIAS_SIGMA**2
        try:
            step = -np.linalg.solve(H, g)
        except np.linalg.LinAlgError:
            break
        length = float(np.linalg.norm(step[:3]))
        step[:3] *= min(1.0, 0.5 / max(length, 1e-12))
        x_R = x_R @ so3_exp(step[:3].copy())
        td_bias = td_bias + step[3:]
        td_bias[0] = float(np.clip(td_bias[0], -_REACH_S, _REACH_S))
        if float(np.sqrt(step @ H @ step)) < _CONVERGED:
            break
    return _judge(problem, x_R, td_bias, H, weights, r, J, scale, correlation)


def _judge(
    problem: _Problem, R: Array, td_bias: Array, H: Array, weights: Array, r: Array, J: Array, scale: float, corr: Array
) -> HandEye:
    regular = np.linalg.cond(H / np.sqrt(np.outer(np.diag(H), np.diag(H)))) < 1e12
    white = np.linalg.inv(H) if regular else np.full((7, 7), np.inf)
    key_s = problem.seen.key_s
    block = np.minimum((key_s - key_s[0]) / max(np.ptp(key_s), 1e-9) * _BLOCKS, _BLOCKS - 1)
    groups = [these for b in range(_BLOCKS) if (these := block.astype(int) == b).any()]
    grouping = 1.0
    if regular and len(groups) > 4:
        informations = [np.einsum("n,nia,nib->ab", weights[g], J[g], J[g]) for g in groups]
        gradients = [np.einsum("n,nia,ni->a", weights[g], J[g], r[g]) for g in groups]
        spread = jackknife_variances(moves_without(H, np.array(informations), np.array(gradients)))
        grouping = max(1.0, float(np.mean((spread / np.diag(white))[:4])))
    if regular:  # from the camera's axes, in which the rotation is perturbed, to the body's
        to_body = np.eye(7)
        to_body[:3, :3] = R
        white = to_body @ white @ to_body.T
    turns = problem.gyro_turns(td_bias[0], td_bias[1:]).as_rotvec()
    return HandEye(
        R_body_cam=R,
        time_offset_s=float(td_bias[0]),
        gyro_bias_rad_s=td_bias[1:],
        covariance=np.asarray(white * grouping, dtype=np.float64),
        pairs=len(r),
        residual_rad=np.linalg.norm(np.einsum("nij,nj->ni", np.linalg.inv(problem.whiten), r), axis=1),
        times_s=key_s,
        correlation=corr,
        misfit=scale**2,
        grouping=grouping,
        turned_rad=np.asarray(np.linalg.svd(turns, compute_uv=False), dtype=np.float64),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Samples and pairs in seconds from the first sample."""

    t_s: Array  # [N]
    gyro: Array  # [N, 3]
    seen: SeenTurns  # [M]
    whiten: Array  # [M, 3, 3]

    @staticmethod
    def of(pairs: list[RotationPair], t_ns: NDArray[np.int64], gyro: Array) -> _Problem:
        first = int(t_ns[0])
        low, high = first + round(_REACH_S * 1e9), int(t_ns[-1]) - round(_REACH_S * 1e9)
        kept = [pair for pair in pairs if pair.key_ns > low and pair.t_ns < high]
        covariance = np.array([pair.covariance for pair in kept]).reshape(-1, 3, 3) + _FLOOR_RAD**2 * np.eye(3)
        return _Problem(
            np.asarray((t_ns - first) * 1e-9, dtype=np.float64),
            np.ascontiguousarray(gyro),
            SeenTurns(
                np.array([(pair.key_ns - first) * 1e-9 for pair in kept]),
                np.array([(pair.t_ns - first) * 1e-9 for pair in kept]),
                np.array([pair.R_key_cam for pair in kept]).reshape(-1, 3, 3),
            ),
            np.linalg.inv(np.linalg.cholesky(covariance)),
        )

    def gyro_turns(self, offset_s: float, bias: Array) -> Rotation:
        """Return the body's rotation [M] over every pair."""
        turns = integrated(self.t_s, self.gyro, bias)
        return Rotation.from_matrix(turns_between(turns, self.seen.key_s + offset_s, self.seen.frame_s + offset_s))

    def linearise(self, R_body_cam: Array, td_bias: Array) -> tuple[Array, Array]:
        """Return whitened rotations [M, 3] by which gyroscope and camera differ, and their derivatives [M, 3, 7]."""
        turns = integrated(self.t_s, self.gyro, td_bias[1:])
        errors, J = turn_errors(turns, self.seen, np.ascontiguousarray(R_body_cam.T), td_bias[0], 0.0)
        whiten = -self.whiten @ self.seen.R_key_frame.transpose(0, 2, 1)  # errors are in axes of the key
        return np.einsum("nij,nj->ni", whiten, errors), whiten @ np.dstack([J[:, :, 4:7], -J[:, :, :4]])

    def kabsch(self, offset_s: float) -> Array:
        """Return the rotation [3, 3] that aligns the camera's rotation vectors with the gyroscope's best."""
        body = self.gyro_turns(offset_s, np.zeros(3)).as_rotvec()
        camera = Rotation.from_matrix(self.seen.R_key_frame).as_rotvec()
        lasting = (self.seen.frame_s - self.seen.key_s)[:, None]
        for _ in range(3):  # a bias adds to rotation vectors in proportion to time
            R = Rotation.align_vectors(body, camera)[0]
            bias = np.sum((body - R.apply(camera)) * lasting, axis=0) / np.sum(lasting**2)
            body = self.gyro_turns(offset_s, bias).as_rotvec()
        return np.asarray(Rotation.align_vectors(body, camera)[0].as_matrix())


def _correlate(problem: _Problem) -> Array:
    """Return offsets and how well the angles of both correlate there [G, 2]."""
    lasting_s = problem.seen.frame_s - problem.seen.key_s
    seen = np.linalg.norm(Rotation.from_matrix(problem.seen.R_key_frame).as_rotvec(), axis=1) / lasting_s
    offsets = np.arange(-_REACH_S, _REACH_S + 1e-9, _GRID_S)
    out = np.zeros((len(offsets), 2))
    for k, offset in enumerate(offsets):
        turned = problem.gyro_turns(float(offset), np.zeros(3)).as_rotvec()
        speed = np.linalg.norm(turned, axis=1) / lasting_s
        spread = float(np.std(speed) * np.std(seen))
        out[k] = offset, np.mean((speed - speed.mean()) * (seen - seen.mean())) / spread if spread > 0.0 else 0.0
    return out
