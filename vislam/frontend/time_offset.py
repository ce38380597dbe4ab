"""How far the camera's clock is off from the IMU's, from rotations alone.

A camera whose stamps are late or early sees the rotations that the gyroscope measures shifted in time. Rotation between
a keyframe and a frame, by vision and by gyroscope, is compared over a sliding window; the difference is linear in time
offset, gyro bias and a small misalignment of the axes, for which one least-squares problem is solved, integrated again
around every solution. A camera with a clock of its own (`init.clock_drift`) adds the rate by which that is off: its
offset is then that of the newest frame, and never final. Neither gravity nor scale is needed. The idea is that of Li
and Mourikis, "Online temporal calibration for camera-IMU systems", IJRR 2014.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.config import InitConfig
from vislam.core.geometry import so3_exp
from vislam.core.jit import njit
from vislam.core.messages import Array, ImuSpan, Tracking, VoMeasurement
from vislam.imu.gyro_turns import UNKNOWNS, SeenTurns, integrated, turn_errors

_TIME_OFFSET_SETTLED_S = 0.0005  # sigma at which the estimate is final
_CLOCK_DRIFT_SIGMA = 0.03  # of that rate: no clock that deserves the name is farther off
_NS = 1_000_000_000
_WINDOW_S = 10.0  # of frames that are looked at: longer than a hand takes to turn this way and that
_SLACK_S = 0.1  # more inertial data than the frames span, so that they can be shifted
_MIN_FRAMES = 15  # fewer are no statistics
_SIGMA_RAD = 1e-3  # nominal, of a visual rotation; the real one is estimated from residuals
_MIN_RATIO = 0.05  # of real to nominal variance: no visual rotation is better than 0.2 mrad
_GYRO_BIAS_SIGMA = 0.5  # rad/s, prior: wide enough for any
_GIVEN_SIGMA_S = 1e-3  # an offset found elsewhere is trusted no further: other models share errors with this one
TURN_SIGMA = np.deg2rad(1.0)  # prior of the misalignment: a calibration is hardly worse
_CAUCHY = 3.0  # standard deviations
_ROUNDS = 5
_NO_DRIFT = 1e-7  # sigma of the drift of a clock that is the host's
_KNOWN_S, _KNOWN_DRIFT = 0.003, 0.002  # sigmas below which an estimate is carried on as the next one's prior

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class TimeOffsetEstimate:
    """What is to be added to the camera's own stamps to get the IMU's time, and what came with it."""

    offset_s: float
    sigma_s: float
    gyro_bias_rad_s: Array  # [3]
    R_correction: Array  # [3] rotation vector, body axes: vision's body axes are those of the IMU turned by it
    R_correction_sigma: Array  # [3] rad
    frames: int
    t_ns: int = 0  # the camera's time of which the offset is
    drift: float = 0.0  # seconds by which the offset grows in a second of the camera
    drift_sigma: float = 0.0

    def at(self, camera_t_ns: int) -> float:
        """Return the offset in seconds at a time of the camera."""
        return self.offset_s + self.drift * (camera_t_ns - self.t_ns) / _NS


class TimeOffset:
    """Owns the visual rotations of the last seconds and estimates the offset from them.

    Attributes:
        estimate: the newest one; its sigma is the configured one until there is something to see.
        settled: the offset is known so well that nothing more is taken in.
    """

    def __init__(self, config: InitConfig) -> None:
        """Start from the configured offset."""
        self._config = config
        none, drift_sigma = np.zeros(3), _CLOCK_DRIFT_SIGMA if config.clock_drift else _NO_DRIFT
        self.estimate = TimeOffsetEstimate(
            config.time_offset_s, config.time_offset_sigma_s, none, none, np.full(3, TURN_SIGMA), 0,
            drift_sigma=drift_sigma,
        )  # fmt: skip
        self._prior = self.estimate  # what else is known of offset and drift
        self.settled = not config.time_offset
        self._t_ns: list[int] = []  # of the frames, by the camera
        self._keyframe_ns: list[int] = []
        self._rotations: list[Array] = []  # [3, 3] of the body since the keyframe, by vision
        self._last_t_ns: int | None = None
        self._keyframe_id: int | None = None
        self._keyframe_t_ns = 0

    @property
    def sigma_s(self) -> float:
        """How well the offset is known now; zero when it is not estimated but given."""
        return self._sigma_now_s if self._config.time_offset else 0.0

    @property
    def _sigma_now_s(self) -> float:
        """The sigma of the estimate's offset, carried on to the newest frame."""
        known, now_ns = self.estimate, self._last_t_ns
        if not self._config.clock_drift or now_ns is None:
            return known.sigma_s
        return float(np.hypot(known.sigma_s, known.drift_sigma * (now_ns - known.t_ns) / _NS))

    def add(self, camera_t_ns: int, vo: VoMeasurement) -> None:
        """Take the rotation of one frame since its keyframe.

        Args:
            camera_t_ns: the frame's time by the camera's own clock.
            vo: its motion, in which rotation must come from the image: not held by a gyroscope prior.
        """
        if self.settled:
            return
        if vo.keyframe_id != self._keyframe_id:  # the frame before became the keyframe
            self._keyframe_id = vo.keyframe_id
            self._keyframe_t_ns = camera_t_ns if self._last_t_ns is None else self._last_t_ns
        if self._last_t_ns is None:
            self.estimate = replace(self.estimate, t_ns=camera_t_ns)
            self._prior = replace(self._prior, t_ns=camera_t_ns)
        self._last_t_ns = camera_t_ns
        if vo.tracking is Tracking.LOST or vo.T_keyframe_body is None or camera_t_ns <= self._keyframe_t_ns:
            return
        self._t_ns.append(camera_t_ns)
        self._keyframe_ns.append(self._keyframe_t_ns)
        self._rotations.append(np.ascontiguousarray(vo.T_keyframe_body[:3, :3]))
        old = bisect_left(self._keyframe_ns, camera_t_ns - round(_WINDOW_S * _NS))  # all, after a long hole
        del self._t_ns[:old], self._keyframe_ns[:old], self._rotations[:old]

    def wanted_ns(self) -> tuple[int, int] | None:
        """Return the interval of inertial data that `solve` can use; None while there is nothing to solve."""
        if self.settled or len(self._t_ns) < _MIN_FRAMES:
            return None
        begin_s, end_s = self.estimate.at(self._keyframe_ns[0]), self.estimate.at(self._t_ns[-1])
        before, behind = min(begin_s, 0.0) - self._slack_s, max(end_s, 0.0) + self._slack_s
        return self._keyframe_ns[0] + round(before * _NS), self._t_ns[-1] + round(behind * _NS)

    @property
    def _slack_s(self) -> float:
        return _SLACK_S if not self._config.clock_drift else _SLACK_S + self._sigma_now_s

    def solve(self, span: ImuSpan) -> TimeOffsetEstimate:
        """Estimate from the frames that `span` covers, no bias taken off; keep the old estimate if that fails."""
        begin, known, now_ns = int(span.t_ns[0]), self.estimate, self._t_ns[-1]
        t_s, key_s, frame_s = (
            (np.asarray(t, dtype=np.int64) - begin) / _NS for t in (span.t_ns, self._keyframe_ns, self._t_ns)
        )
        gyro, seen = np.ascontiguousarray(span.gyro_rad_s), SeenTurns(key_s, frame_s, np.array(self._rotations))
        guess_s = known.at(now_ns)
        x = np.concatenate([[guess_s], known.gyro_bias_rad_s, known.R_correction, [known.drift]])
        prior, mean = self._prior_at(now_ns)
        scale, H, used = 1.0, np.eye(UNKNOWNS), 0
        for _ in range(_ROUNDS):
            H, g, squares, used = _normal_equations(t_s, gyro, seen, x, scale)
            if used < _MIN_FRAMES:
                return self.estimate
            H += prior
            step = np.linalg.solve(H, g + prior @ (mean - x))
            x = x + step
            middle_s = guess_s if self._config.clock_drift else self._config.time_offset_s
            x[0] = float(np.clip(x[0], *(middle_s + self._slack_s * np.array([-0.9, 0.9]))))
            scale = float(np.sqrt(max(np.median(squares[:used]) / 0.79, _MIN_RATIO)))  # 0.79: chi2 of 3, over 3
        deviations = np.sqrt(np.diag(np.linalg.inv(H)))
        if not np.isfinite(x).all():
            return self.estimate
        config, sigma_s = self._config, float(deviations[0])
        sigma_s = sigma_s if config.clock_drift else min(sigma_s, config.time_offset_sigma_s)
        self.estimate = TimeOffsetEstimate(
            float(x[0]), sigma_s, x[1:4].copy(), x[4:7].copy(), deviations[4:7], used, now_ns, float(x[7]),
            float(deviations[7]),
        )  # fmt: skip
        self.settled = sigma_s < _TIME_OFFSET_SETTLED_S and not config.clock_drift
        if config.clock_drift and sigma_s < _KNOWN_S and deviations[7] < _KNOWN_DRIFT:
            # loosely, since the frames of this estimate are among those of the next
            self._prior = replace(self.estimate, sigma_s=config.time_offset_sigma_s, drift_sigma=_KNOWN_DRIFT)
        return self.estimate

    def _prior_at(self, now_ns: int) -> tuple[Array, Array]:
        """Return information [8, 8] and mean [8] of what is known before the frames, with the offset of a time."""
        prior = self._prior
        sigmas = np.repeat([_GYRO_BIAS_SIGMA, TURN_SIGMA], 3)
        information = np.diag([0.0, *(1.0 / sigmas**2), 1.0 / prior.drift_sigma**2])
        then = np.zeros(UNKNOWNS)  # the offset at the prior's time, by the unknowns
        then[0], then[7] = 1.0, -(now_ns - prior.t_ns) / _NS
        information += np.outer(then, then) / prior.sigma_s**2
        mean = np.zeros(UNKNOWNS)
        mean[0], mean[7] = prior.at(now_ns), prior.drift
        return information, mean

    def tell(self, offset_s: float, sigma_s: float) -> None:
        """Take an offset that was found by other means, with its sigma."""
        if not self.settled and sigma_s < self._sigma_now_s:
            t_ns = self.estimate.t_ns if self._last_t_ns is None else self._last_t_ns
            given_s = max(sigma_s, _GIVEN_SIGMA_S)
            self._prior = replace(self._prior, offset_s=offset_s, sigma_s=given_s, t_ns=t_ns)
            self.estimate = replace(self.estimate, offset_s=offset_s, sigma_s=sigma_s, t_ns=t_ns)


@njit(cache=True, nogil=True)
def _take_out_common(H: Array, g: Array, weight: float, link: Array, head: Array) -> None:
    """Eliminate the turn that all frames of a keyframe share, with its weight, and forget it in `link` and `head`."""
    for a in range(UNKNOWNS):
        for i in range(3):
            g[a] -= link[a, i] * head[i] / weight
            for b in range(UNKNOWNS):
                H[a, b] -= link[a, i] * link[b, i] / weight
    link[:] = 0.0
    head[:] = 0.0


@njit(cache=True, nogil=True)
def _normal_equations(
    t_s: Array, gyro: Array, seen: SeenTurns, x: Array, scale: float
) -> tuple[Array, Array, Array, int]:
    """Sum up the frames that the samples cover; what all frames of a keyframe have in common is eliminated.

    Returns:
        H [8, 8], g [8], the squared residuals per axis in nominal sigmas, and how many frames were used.
    """
    errors, Js = turn_errors(integrated(t_s, gyro, x[1:4]), seen, so3_exp(x[4:7]), x[0], x[7])
    H, g = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
    squares, used = np.zeros(len(errors)), 0
    weight0 = 1.0 / (_SIGMA_RAD * scale) ** 2
    shared_weight, link, head = weight0, np.zeros((UNKNOWNS, 3)), np.zeros(3)
    for k in range(len(errors)):
        if k > 0 and seen.key_s[k] != seen.key_s[k - 1]:
            _take_out_common(H, g, shared_weight, link, head)
            shared_weight = weight0
        error, J = errors[k], Js[k]
        if np.isnan(error[0]):
            continue
        square = (error[0] ** 2 + error[1] ** 2 + error[2] ** 2) / (3.0 * _SIGMA_RAD**2)
        squares[used] = square
        used += 1
        weight = weight0 / (1.0 + square / (_CAUCHY * scale) ** 2)
        shared_weight += weight
        for i in range(3):
            head[i] += weight * error[i]
            for a in range(UNKNOWNS):
                link[a, i] += weight * J[i, a]
                g[a] += weight * J[i, a] * error[i]
                for b in range(UNKNOWNS):
                    H[a, b] += weight * J[i, a] * J[i, b]
    _take_out_common(H, g, shared_weight, link, head)
    return H, g, squares, used
