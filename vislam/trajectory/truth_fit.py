"""How a true trajectory fits the IMU of its recording: what its body is turned and displaced, what its clock is off.

Motion capture gives the pose of markers. Where they are on the body was calibrated once, and is off by some tenths of
a degree; its clock is another one. The gyroscope shows the turn: a body frame that is turned against the IMU's shows as
an error that turns with the body, while a gyroscope's drift stays in the world and is slow. The accelerometer shows the
rest: twice integrated over half a second on either side of a time, it must bend the path as the positions bend.
Over seconds, not from pose to pose, since the truth of some recordings was smoothed with their own inertial data.

What is not seen clearly is left as it is. Sigmas come from the spread between pieces of the recording (the sandwich
estimator, Huber 1967), for the errors of motion capture last for seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicHermiteSpline, CubicSpline, PPoly
from scipy.spatial.transform import Rotation

from vislam.core.chi_square import chi_square_limit
from vislam.core.geometry import transform
from vislam.core.messages import Array
from vislam.imu.gyro_turns import integrate_gyro
from vislam.imu.path import SmoothAttitude, apart, drift_knots, gaps, integrate_twice, mean_rate_ahead
from vislam.trajectory import Trajectory

_SURE = (
    0.999  # of a turn, a lever or an offset that is taken for real: one recording in a thousand is changed by chance
)
_TURN_EVERY_S, _PLACE_EVERY_S = 0.1, 0.04  # true poses that are looked at
_ARM_S = 0.5  # of the bend of the path, to either side: in less, a smoothed truth is the IMU again
_SHORT_ARM_S = 0.25  # at which a lever must be the same, while errors of attitude and accelerometer are not
_MAX_IMU_GAP_S = 0.03  # over longer gaps the body may do anything
_MIN_POSES, _MIN_SPAN_S = 40, 5.0  # fewer show nothing
_BLOCK_S, _MIN_BLOCKS = 10.0, 12  # pieces whose errors are independent
_GRAVITY_M_S2 = 9.81
_MEDIAN_OF_CHI3 = 1.538
_HUBER = 2.5  # sigmas beyond which an error counts less
_ROUNDS = 5  # of reweighting, and of linearising: both settle in three
_TINY = 1e-9  # rad or m: truth without any noise
# what is known without any data: of markers on a body, a clock, a calibrated accelerometer, a levelled world
_TURN_SIGMA_RAD, _LEVER_SIGMA_M, _OFFSET_SIGMA_S = 0.05, 0.05, 0.02
_BIAS_SIGMA_M_S2, _TILT_SIGMA_M_S2, _MATRIX_SIGMA = 0.5, 0.2, 0.01


@dataclass(frozen=True, slots=True, eq=False)
class TruthFit:
    """The pose of the IMU in the body of a true trajectory, and its clock, each with its covariance.

    Attributes:
        turn_rad: rotation vector [3] of R_truth_imu.
        lever_m: position [3] of the IMU in the truth's body.
        time_offset_s: to be added to the stamp of a true pose to get the IMU's time.
    """

    turn_rad: Array
    turn_covariance: Array  # [3, 3]
    lever_m: Array
    lever_covariance: Array  # [3, 3]
    time_offset_s: float
    time_offset_sigma_s: float

    @property
    def is_turned(self) -> bool:
        """Whether the turn is beyond chance."""
        return _is_sure(self.turn_rad, self.turn_covariance)

    @property
    def is_displaced(self) -> bool:
        """Whether the lever is beyond chance."""
        return _is_sure(self.lever_m, self.lever_covariance)

    @property
    def is_late(self) -> bool:
        """Whether the time offset is beyond chance."""
        return _is_sure(np.array([self.time_offset_s]), np.array([[self.time_offset_sigma_s**2]]))

    @property
    def T_truth_imu(self) -> Array:
        """Pose [4, 4] of the IMU in the truth's body, as far as it is beyond chance."""
        R = Rotation.from_rotvec(self.turn_rad).as_matrix() if self.is_turned else np.eye(3)
        return transform(R, self.lever_m if self.is_displaced else np.zeros(3))

    def of_imu(self, truth: Trajectory) -> Trajectory:
        """Return the true trajectory of the IMU by the IMU's clock: what is beyond chance is undone."""
        shift_ns = round(self.time_offset_s * 1e9) if self.is_late else 0
        return Trajectory(truth.t_ns + shift_ns, truth.T_world_body @ self.T_truth_imu)

    @property
    def summary(self) -> str:
        """What is beyond chance, in words; empty when nothing is."""
        found = []
        if self.is_turned:
            found.append(f"turned by {_with_sigma(self.turn_rad, self.turn_covariance, 180.0 / np.pi)} deg")
        if self.is_displaced:
            found.append(f"displaced by {_with_sigma(self.lever_m, self.lever_covariance, 1e3)} mm")
        if self.is_late:
            found.append(f"off by {1e3 * self.time_offset_s:+.1f} +- {1e3 * self.time_offset_sigma_s:.1f} ms in time")
        return f"truth is {', '.join(found)} against the IMU" if found else ""


def fit_truth(t_ns: NDArray[np.int64], gyro_rad_s: Array, accel_m_s2: Array, truth: Trajectory) -> TruthFit:
    """Fit true poses to inertial samples at times [N] (gyro and accel [N, 3], calibrated, in the IMU's frame).

    Truth of 20 Hz or more, with gaps, will do. Where there is too little of it, or the body moves too little, sigmas
    are those of what is known without data: some degrees, centimetres and milliseconds.
    """
    inside = np.flatnonzero((truth.t_ns >= t_ns[:1].sum()) & (truth.t_ns <= t_ns[-1:].sum()))
    enough = len(inside) >= _MIN_POSES and truth.t_ns[inside[-1]] - truth.t_ns[inside[0]] >= _MIN_SPAN_S * 1e9
    if not enough:
        return TruthFit(
            np.zeros(3),
            np.eye(3) * _TURN_SIGMA_RAD**2,
            np.zeros(3),
            np.eye(3) * _LEVER_SIGMA_M**2,
            0.0,
            _OFFSET_SIGMA_S,
        )
    zero_ns = int(truth.t_ns[inside[0]])
    used = slice(
        max(int(np.searchsorted(t_ns, zero_ns)) - 1, 0), int(np.searchsorted(t_ns, truth.t_ns[inside[-1]])) + 1
    )
    imu_s = (t_ns[used] - zero_ns).astype(np.float64) * 1e-9
    true_s, poses = (truth.t_ns[inside] - zero_ns).astype(np.float64) * 1e-9, truth.T_world_body[inside]
    turns = apart(truth.t_ns[inside], _TURN_EVERY_S)
    turn = _fit_turn(imu_s, gyro_rad_s[used], true_s[turns], poses[turns, :3, :3])
    places = apart(truth.t_ns[inside], _PLACE_EVERY_S)
    place = partial(_fit_place, imu_s, turn.attitude, accel_m_s2[used], true_s[places], poses[places, :3, 3])
    lever_imu, covariance, offset_s, sigma_s = place(_ARM_S)
    change = place(_SHORT_ARM_S)[0] - lever_imu
    covariance = covariance + np.outer(change, change)
    offset_s, sigma_s = _one_offset((turn.offset_s, turn.offset_sigma_s), (offset_s, sigma_s))
    R = Rotation.from_rotvec(turn.turn_rad).as_matrix()
    return TruthFit(turn.turn_rad, turn.covariance, R @ lever_imu, R @ covariance @ R.T, offset_s, sigma_s)


# -- the turn, by the gyroscope --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Turn:
    turn_rad: Array  # [3] of R_truth_imu
    covariance: Array  # [3, 3]
    offset_s: float
    offset_sigma_s: float
    attitude: Array  # R_world_imu [N, 3, 3] at the samples: the gyroscope's, its drift taken off


def _fit_turn(imu_s: Array, gyro: Array, true_s: Array, R_world_truth: Array) -> _Turn:
    """Fit R_world_truth R_truth_imu = drift R_gyro, where the drift is a slow spline in the world."""
    knots = drift_knots(true_s)
    slow = BSpline.design_matrix(true_s, knots, 3).toarray()
    columns = 3 * slow.shape[1]
    J = np.zeros((len(true_s), 3, columns + 4))
    for axis in range(3):
        J[:, axis, axis * slow.shape[1] : (axis + 1) * slow.shape[1]] = slow
    information = np.concatenate([np.zeros(columns), np.full(3, _TURN_SIGMA_RAD**-2), [_OFFSET_SIGMA_S**-2]])
    bias, turn, offset_s = np.zeros(3), np.eye(3), 0.0
    for round_ in range(_ROUNDS):
        gyro_path = SmoothAttitude(imu_s, integrate_gyro(imu_s, gyro - bias))
        R_gyro = gyro_path.at(_within(true_s + offset_s, imu_s))
        R = R_world_truth @ turn
        if round_ < 2:  # without the bias first, so that little is left to the spline
            bias = bias + mean_rate_ahead(true_s, R_gyro, R)
            continue
        drift = Rotation.from_matrix(R @ R_gyro.transpose(0, 2, 1))
        middle = drift.mean()
        rate = np.column_stack([np.interp(true_s + offset_s, imu_s, gyro[:, k] - bias[k]) for k in range(3)])
        J[:, :, columns : columns + 3], J[:, :, -1] = -R, np.einsum("nij,nj->ni", R, rate)
        known = np.concatenate([np.zeros(columns), Rotation.from_matrix(turn).as_rotvec(), [offset_s]])
        x, covariance = _solve(J, (drift * middle.inv()).as_rotvec(), information, known, true_s)
        turn, offset_s = turn @ Rotation.from_rotvec(x[columns:-1]).as_matrix(), offset_s + float(x[-1])
    spline = BSpline(knots, x[:columns].reshape(3, -1).T, 3)
    drifted = (Rotation.from_rotvec(spline(_within(imu_s, true_s))) * middle).as_matrix()
    sigma_s = float(np.sqrt(covariance[-1, -1]))
    rotvec = Rotation.from_matrix(turn).as_rotvec()
    return _Turn(rotvec, covariance[columns:-1, columns:-1], offset_s, sigma_s, drifted @ gyro_path.at(imu_s))


# -- lever and clock, by the accelerometer ---------------------------------------------------------------------------


def _fit_place(
    imu_s: Array, R: Array, accel: Array, true_s: Array, places: Array, arm_s: float
) -> tuple[Array, Array, float, float]:
    """Return the IMU's place [3] beside the truth's, in the IMU's axes, its covariance, the time offset and its sigma.

    With them go a bias, a tilt of the world, and a matrix [3, 3] of scales and axes: what an accelerometer is off by
    would else be taken for a lever.
    """
    before, now, after, arm_s = _bends(imu_s, true_s, arm_s)
    if len(now) < _MIN_BLOCKS:
        return np.zeros(3), np.eye(3) * _LEVER_SIGMA_M**2, 0.0, _OFFSET_SIGMA_S

    def bend(path: PPoly | CubicSpline, offset_s: float) -> Array:
        values = path(_within(true_s + offset_s, imu_s))
        return np.asarray(values[after] - 2.0 * values[now] + values[before])

    felt = _path(imu_s, np.einsum("nij,nj->ni", R, accel) - [0.0, 0.0, _GRAVITY_M_S2])
    biased = [_path(imu_s, R[:, :, k]) for k in range(3)]
    scaled = [_path(imu_s, R[:, :, k] * accel[:, m, None]) for k in range(3) for m in range(3)]
    turning = CubicSpline(imu_s, R)
    seen = places[after] - 2.0 * places[now] + places[before]
    sigmas = np.repeat(
        [_BIAS_SIGMA_M_S2, _MATRIX_SIGMA, _TILT_SIGMA_M_S2, _LEVER_SIGMA_M, _OFFSET_SIGMA_S], (3, 9, 2, 3, 1)
    )
    J, offset_s = np.zeros((len(now), 3, len(sigmas))), 0.0
    for _ in range(3):
        for k, path in enumerate(biased + scaled):
            J[:, :, k] = -bend(path, offset_s)
        J[:, 0, 12] = J[:, 1, 13] = -(arm_s**2)
        J[:, :, 14:17] = -bend(turning, offset_s)
        J[:, :, 17] = bend(felt.derivative(), offset_s)
        known = np.append(np.zeros(17), offset_s)
        x, covariance = _solve(J, seen - bend(felt, offset_s), sigmas**-2, known, true_s[now])
        offset_s += float(x[17])
    return x[14:17], covariance[14:17, 14:17], offset_s, float(np.sqrt(covariance[17, 17]))


def _bends(
    imu_s: Array, true_s: Array, arm_s: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], float]:
    """Return indices of true poses before, at and after times, about an arm apart, and that arm; not across a gap."""
    period_s = float(np.median(np.diff(true_s)))
    step = max(round(arm_s / period_s), 1)
    now = np.arange(step, len(true_s) - step, max(step // 2, 1))
    before, after, arm_s = now - step, now + step, step * period_s
    even = np.abs(true_s[now] - true_s[before] - arm_s) + np.abs(true_s[after] - true_s[now] - arm_s) < 0.2 * period_s
    for begin_s, end_s in gaps(imu_s, _MAX_IMU_GAP_S):
        even &= (true_s[after] < begin_s) | (true_s[before] > end_s)
    return before[even], now[even], after[even], arm_s


def _path(t_s: Array, acceleration: Array) -> CubicHermiteSpline:
    velocity, position = integrate_twice(t_s, acceleration)
    return CubicHermiteSpline(t_s, position, velocity)


def _one_offset(turns: tuple[float, float], places: tuple[float, float]) -> tuple[float, float]:
    """Return the time offset and its sigma of what turns and positions say; where they contradict, of positions alone.

    Simulated vision takes its turns from the gyroscope, but its path from the true positions.
    """
    apart_s, sigma_s = turns[0] - places[0], float(np.hypot(turns[1], places[1]))
    if apart_s**2 > chi_square_limit(_SURE, 1) * sigma_s**2:
        return places
    weights = np.array([turns[1], places[1]]) ** -2.0
    return float(weights @ [turns[0], places[0]] / weights.sum()), float(weights.sum() ** -0.5)


# -- least squares ---------------------------------------------------------------------------------------------------


def _solve(J: Array, y: Array, information: Array, known: Array, t_s: Array) -> tuple[Array, Array]:
    """Return x [P] of y = J x (J [N, 3, P], y [N, 3]) by robust least squares, and its covariance.

    `information` [P] is that of priors about zero, `known` [P] what was solved for before and is not in y any more.
    """
    weights = np.ones(len(y))
    x = np.zeros(J.shape[2])
    for _ in range(_ROUNDS):
        H = np.einsum("nki,nkj,n->ij", J, J, weights)
        scale = max(float(np.trace(H)), _TINY) * 1e-15
        left = np.linalg.norm(y - J @ x, axis=1)
        sigma = max(float(np.median(left)) / _MEDIAN_OF_CHI3, _TINY)
        weights = 1.0 / np.maximum(1.0, left / (_HUBER * sigma)) / sigma**2
        H = np.einsum("nki,nkj,n->ij", J, J, weights) + np.diag(information + scale)
        x = np.linalg.solve(H, np.einsum("nki,nk,n->i", J, y, weights) - information * known)
    pulls = np.einsum("nki,nk,n->ni", J, y - J @ x, weights)
    block_s = min(_BLOCK_S, float(t_s[-1] - t_s[0]) / _MIN_BLOCKS)
    _, blocks = np.unique(np.floor((t_s - t_s[0]) / block_s), return_inverse=True)
    count = int(blocks.max()) + 1
    sums = np.zeros((count, len(x)))
    np.add.at(sums, blocks, pulls)
    inverse = np.linalg.inv(H)
    spread = sums.T @ sums * (count / max(count - 4, 1))  # few pieces, of which three numbers are judged at once
    return x, np.asarray(inverse @ (spread + np.diag(information)) @ inverse)


def _within(t_s: Array, span_s: Array) -> Array:
    return np.clip(t_s, span_s[0], span_s[-1])


def _is_sure(value: Array, covariance: Array) -> bool:
    return bool(value @ np.linalg.solve(covariance, value) > chi_square_limit(_SURE, len(value)))


def _with_sigma(value: Array, covariance: Array, unit: float) -> str:
    size = float(np.linalg.norm(value))
    sigma = float(np.sqrt(value @ covariance @ value)) / max(size, _TINY)
    return f"{unit * size:.2f} +- {unit * sigma:.2f}"
