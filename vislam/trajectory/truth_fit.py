"""How a true trajectory fits the IMU of its recording: what its body is turned and displaced, what its clock is off.

Motion capture gives the pose of markers. Where they are on the body was calibrated once, and is off by some tenths of
a degree; its clock is another one. The gyroscope shows the turn: a body frame that is turned against the IMU's shows as
an error that turns with the body, while a gyroscope's drift stays in the world and is slow. The accelerometer shows the
rest: twice integrated over half a second on either side of a time, it must bend the path as the positions bend.
Over seconds, not from pose to pose, since the truth of some recordings was smoothed with their own inertial data.

What is left of both within a tenth of a second is the truth's own noise; slow errors of it are not seen.

What is not seen clearly is left as it is. Sigmas come from the spread between pieces of the recording (the sandwich
estimator, Huber 1967), for the errors of motion capture last for seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicHermiteSpline, CubicSpline, PPoly
from scipy.spatial.transform import Rotation

from vislam.core.chi_square import chi_square_limit
from vislam.core.errors import DataError
from vislam.core.geometry import transform
from vislam.core.messages import Array
from vislam.core.trajectory import Trajectory
from vislam.imu.gyro_turns import integrate_gyro
from vislam.imu.path import SmoothAttitude, apart, drift_knots, gaps, integrate_twice, mean_rate_ahead
from vislam.trajectory.association import associate
from vislam.trajectory.evaluation import Alignment, align, ate

_SURE = 0.999  # of a turn, a lever or an offset taken for real: one recording in a thousand is changed by chance
_TURN_EVERY_S, _PLACE_EVERY_S = 0.1, 0.04  # true poses that are looked at
_ARM_S = 0.5  # of the bend of the path, to either side: in less, a smoothed truth is the IMU again
_NOISE_ARM_S = 0.05  # of what is left, and twice that: the IMU is better than any truth there
_SHORT_ARM_S = 0.25  # at which a lever must be the same, while errors of attitude and accelerometer are not
_MAX_IMU_GAP_S = 0.03  # over longer gaps the body may do anything
_MIN_POSES, _MIN_SPAN_S = 40, 5.0  # fewer show nothing
_MAX_SPAN_S = 600.0  # more takes memory, and a clock drifts
_BLOCK_S, _MIN_BLOCKS = 10.0, 12  # pieces whose errors are independent
_GRAVITY_M_S2 = 9.81
_MEDIAN_OF_CHI3, _NINTH_OF_CHI3 = 1.538, 2.500  # the latter where most of it is at rest
_GROSS, _JUMP = 5.0, 8.0  # sigmas beyond which noise counts no more, and is a jump: it comes in bursts
_HUBER = 2.5  # sigmas beyond which an error counts less
_ROUNDS = 5  # of reweighting, and of linearising: both settle in three
_TINY = 1e-9  # rad or m: truth without any noise
# what is known without any data: of markers on a body, a clock, a calibrated accelerometer, a levelled world
_TURN_SIGMA_RAD, _LEVER_SIGMA_M, _OFFSET_SIGMA_S = 0.05, 0.05, 0.02
_BIAS_SIGMA_M_S2, _TILT_SIGMA_M_S2, _MATRIX_SIGMA = 0.5, 0.2, 0.01
_LEVER = slice(14, 17)  # among the unknowns of a place
_SHOWN = np.array([1e3, 180.0 / np.pi])  # mm and degrees
_SHAPES = {"turn_rad": (3,), "turn_covariance": (3, 3), "lever_m": (3,), "lever_covariance": (3, 3)}
_SHAPES |= dict.fromkeys(("time_offset_s", "time_offset_sigma_s", "turn_offset_s", "noise_m", "unseen_m"), ())
_SHAPES |= dict.fromkeys(("noise_rad", "unseen_rad", "jump_m", "velocity_m_s"), ())


@dataclass(frozen=True, slots=True, eq=False)
class TruthFit:
    """The pose of the IMU in the body of a true trajectory, and its clock, each with its covariance.

    Attributes:
        turn_rad: rotation vector [3] of R_truth_imu.
        lever_m: position [3] of the IMU in the truth's body.
        time_offset_s: to be added to the stamp of a true position to get the IMU's time.
        turn_offset_s: the same of true attitudes, which come of another clock where they contradict.
        noise_m: white noise of positions per axis, that of attitudes is `noise_rad`. `unseen_m`, `unseen_rad`: what the
            IMU's own noise would be taken for.
        jump_m: the largest jump of the position, 0 where none is beyond its noise.
        velocity_m_s: by what its velocities over a tenth of a second and the IMU's differ per axis, 1 sigma, but for
            white noise. What the IMU errs by within so short a time is in it.
    """

    turn_rad: Array
    turn_covariance: Array  # [3, 3]
    lever_m: Array
    lever_covariance: Array  # [3, 3]
    time_offset_s: float
    time_offset_sigma_s: float
    turn_offset_s: float = 0.0
    noise_m: float = 0.0
    unseen_m: float = 0.0
    noise_rad: float = 0.0
    unseen_rad: float = 0.0
    jump_m: float = 0.0
    velocity_m_s: float = 0.0

    @classmethod
    def read(cls, entry: Any) -> TruthFit | None:
        """Return the fit in an `entry`, None where that is empty; raises DataError for what is none."""
        if not entry:
            return None
        try:
            found: dict[str, Any] = {name: np.reshape(entry[name], shape) * 1.0 for name, shape in _SHAPES.items()}
            fit = cls(**found)
            np.linalg.inv([fit.turn_covariance, fit.lever_covariance])  # so that it is known to be one
            return fit
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"how the truth fits the IMU is damaged ({error!r}); run it again") from error

    def entry(self, truth: Trajectory, alignment: Alignment) -> dict[str, Any]:
        """Return all of it as plain data, empty where nothing is known, with the RMS of the position errors of `truth`.

        It is moved as an estimate would be. Errors that are slow, and a lever that is not seen, are not known.
        """
        if not self.noise:
            return {}
        pairs = associate(self.of_imu(truth), truth, max_gap_s=np.inf)
        error_m = float(np.hypot(ate(pairs.aligned(align(pairs, alignment)))["rmse_m"], np.sqrt(3.0) * self.noise_m))
        own = f"position errors of {1e3 * error_m:.1f} mm are its own"
        all_of_it = "; ".join(filter(None, [self.summary, self.noise, own]))
        return {name: np.asarray(getattr(self, name)).tolist() for name in _SHAPES} | {
            "error_m": error_m,
            "summary": all_of_it,
        }

    @property
    def noise(self) -> str:
        """Its noise in words, empty where nothing is known of it."""
        noise, unseen = (self.noise_m, self.noise_rad), (self.unseen_m, self.unseen_rad)
        sizes = zip(noise * _SHOWN, unseen * _SHOWN, ("mm", "deg"), strict=True)
        parts = [f"{s:.2g} {unit}" if s > u else f"below {np.hypot(s, u):.2g} {unit}" for s, u, unit in sizes]
        jump = [f"jumps of {1e3 * self.jump_m:.1f} mm"] if self.jump_m else []
        parts += [f"{1e3 * self.velocity_m_s:.1f} mm/s in velocity", *jump]
        return f"truth has noise of {', '.join(parts)}" if self.unseen_m else ""

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
        t_ns, poses = truth.t_ns + (round(self.time_offset_s * 1e9) if self.is_late else 0), truth.T_world_body
        if self.is_late and self.turn_offset_s != self.time_offset_s and len(truth):
            of_turns_ns = t_ns - round(self.turn_offset_s * 1e9)
            known = (of_turns_ns >= truth.t_ns[0]) & (of_turns_ns <= truth.t_ns[-1])
            t_ns, poses = t_ns[known], truth.at(of_turns_ns[known])
            poses[:, :3, 3] = truth.positions_m[known]
        return Trajectory(t_ns, poses @ self.T_truth_imu)

    @property
    def summary(self) -> str:
        """What is beyond chance, in words; empty when nothing is."""
        found = []
        if self.is_turned:
            found.append(f"turned by {_with_sigma(self.turn_rad, self.turn_covariance, 180.0 / np.pi)} deg")
        if self.is_displaced:
            found.append(f"displaced by {_with_sigma(self.lever_m, self.lever_covariance, 1e3)} mm")
        if self.is_late:
            off = "off" if self.turn_offset_s == self.time_offset_s else "off in position"
            found.append(f"{off} by {1e3 * self.time_offset_s:+.1f} +- {1e3 * self.time_offset_sigma_s:.1f} ms in time")
        return f"truth is {', '.join(found)} against the IMU" if found else ""


def fit_truth(t_ns: NDArray[np.int64], gyro_rad_s: Array, accel_m_s2: Array, truth: Trajectory) -> TruthFit:
    """Fit true poses to inertial samples at times [N] (gyro and accel [N, 3], calibrated, in the IMU's frame).

    Ten minutes are looked at. Truth of 20 Hz or more, with gaps, will do. Where there is too little of it, or the body
    moves too little, sigmas are those of what is known without data: some degrees, centimetres and milliseconds.
    """
    inside = np.flatnonzero((truth.t_ns >= t_ns[:1].sum()) & (truth.t_ns <= t_ns[-1:].sum()))
    inside = inside[truth.t_ns[inside] - truth.t_ns[inside[:1]] <= _MAX_SPAN_S * 1e9]
    enough = min(len(inside), len(t_ns)) >= _MIN_POSES
    if not enough or truth.t_ns[inside[-1]] - truth.t_ns[inside[0]] < _MIN_SPAN_S * 1e9:
        turn_P, lever_P = np.eye(3) * _TURN_SIGMA_RAD**2, np.eye(3) * _LEVER_SIGMA_M**2
        return TruthFit(np.zeros(3), turn_P, np.zeros(3), lever_P, 0.0, _OFFSET_SIGMA_S)
    zero_ns = int(truth.t_ns[inside[0]])
    first, last = np.searchsorted(t_ns, truth.t_ns[inside[[0, -1]]])
    used = slice(max(int(first) - 1, 0), int(last) + 1)
    imu_s = (t_ns[used] - zero_ns).astype(np.float64) * 1e-9
    true_s, poses = (truth.t_ns[inside] - zero_ns).astype(np.float64) * 1e-9, truth.T_world_body[inside]
    turns = apart(truth.t_ns[inside], _TURN_EVERY_S)
    turn = _fit_turn(imu_s, gyro_rad_s[used], true_s[turns], poses[turns, :3, :3])
    places = apart(truth.t_ns[inside], _PLACE_EVERY_S)
    place = partial(_fit_place, imu_s, turn.attitude, accel_m_s2[used], true_s[places], poses[places, :3, 3])
    x, P = place(_ARM_S)
    noise = _noise(imu_s, turn, accel_m_s2[used], true_s, poses, x)
    change = place(_SHORT_ARM_S)[0][_LEVER] - x[_LEVER]
    covariance = P[_LEVER, _LEVER] + np.outer(change, change)
    offsets = _offsets((turn.offset_s, turn.offset_sigma_s), (float(x[-1]), float(np.sqrt(P[-1, -1]))))
    R = Rotation.from_rotvec(turn.turn_rad).as_matrix()
    return TruthFit(turn.turn_rad, turn.covariance, R @ x[_LEVER], R @ covariance @ R.T, *offsets, *noise)


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


def _fit_place(imu_s: Array, R: Array, accel: Array, true_s: Array, places: Array, arm_s: float) -> tuple[Array, Array]:
    """Return what bends the path otherwise than the truth bends [18], and its covariance [18, 18].

    A bias [3] of the accelerometer, a matrix [3, 3] of its scales and axes, a tilt [2] of the world: what it is off by
    would else be taken for a lever. Then the IMU's place [3] beside the truth's, in its own axes, and the time offset.
    """
    before, now, after, arm_s = _bends(imu_s, true_s, arm_s)
    sigmas = np.repeat(
        [_BIAS_SIGMA_M_S2, _MATRIX_SIGMA, _TILT_SIGMA_M_S2, _LEVER_SIGMA_M, _OFFSET_SIGMA_S], (3, 9, 2, 3, 1)
    )
    if len(now) < _MIN_BLOCKS:
        return np.zeros(len(sigmas)), np.diag(sigmas**2)

    def bend(path: PPoly | CubicSpline, offset_s: float) -> Array:
        values = path(_within(true_s + offset_s, imu_s))
        return np.asarray(values[after] - 2.0 * values[now] + values[before])

    felt = _path(imu_s, np.einsum("nij,nj->ni", R, accel) - [0.0, 0.0, _GRAVITY_M_S2])
    biased = [_path(imu_s, R[:, :, k]) for k in range(3)]
    scaled = [_path(imu_s, R[:, :, k] * accel[:, m, None]) for k in range(3) for m in range(3)]
    turning = CubicSpline(imu_s, R)
    seen = places[after] - 2.0 * places[now] + places[before]
    J, offset_s = np.zeros((len(now), 3, len(sigmas))), 0.0
    for _ in range(3):
        for k, path in enumerate(biased + scaled):
            J[:, :, k] = -bend(path, offset_s)
        J[:, 0, 12] = J[:, 1, 13] = -(arm_s**2)
        J[:, :, _LEVER] = -bend(turning, offset_s)
        J[:, :, 17] = bend(felt.derivative(), offset_s)
        known = np.append(np.zeros(17), offset_s)
        x, covariance = _solve(J, seen - bend(felt, offset_s), sigmas**-2, known, true_s[now])
        offset_s += float(x[17])
    return np.append(x[:17], offset_s), covariance


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


def _noise(imu_s: Array, turn: _Turn, accel: Array, true_s: Array, poses: Array, x: Array) -> tuple[float, ...]:
    """Return noise and jump of true poses, by what they are off the IMU's path as `x` of `_fit_place` corrects it."""
    inside, period_s = _within(true_s + x[-1], imu_s) == true_s + x[-1], float(np.median(np.diff(true_s)))
    true_s, poses = true_s[inside], poses[inside]
    arms = [_bends(imu_s, true_s, arms * max(_NOISE_ARM_S, period_s))[:3] for arms in (1, 2)]
    if min(len(now) for _, now, _ in arms) < _MIN_POSES:
        return ()
    bias, matrix, tilt, attitude = x[:3], x[3:12].reshape(3, 3), x[12:14], SmoothAttitude(imu_s, turn.attitude)
    force = np.einsum("nij,nj->ni", turn.attitude, accel - bias - accel @ matrix.T)
    at_s = true_s + x[-1]
    off = poses[:, :3, 3] + attitude.at(at_s) @ x[_LEVER] - _path(imu_s, force - [*tilt, _GRAVITY_M_S2])(at_s)
    R_imu = attitude.at(_within(true_s + turn.offset_s, imu_s))
    R_seen = poses[:, :3, :3] @ Rotation.from_rotvec(turn.turn_rad).as_matrix()
    turned = Rotation.from_matrix(R_imu.transpose(0, 2, 1) @ R_seen).as_rotvec()
    moved, rotated = ([e[after] - 2.0 * e[now] + e[before] for before, now, after in arms] for e in (off, turned))
    size = np.linalg.norm(moved[0], axis=1)
    is_jump = size.max() > _JUMP * np.quantile(size, 0.9) / _NINTH_OF_CHI3
    (noise_m, unseen_m, slow_m), (noise_rad, unseen_rad, _) = _white(moved, 3), _white(rotated, 1)
    arm_s = 2.0 * max(_NOISE_ARM_S, period_s)
    return noise_m, unseen_m, noise_rad, unseen_rad, float(size.max() * is_jump), slow_m / arm_s


def _white(bends: list[Array], power: int) -> tuple[float, float, float]:
    """Return the sigma per axis of white noise, that which the IMU's noise looks like, and that of other change.

    Second differences [N, 3] over arms and over twice as long ones have the same variance by white noise; that by an
    accelerometer's noise grows with the third `power` of the arm, by a gyroscope's with the first. Other change is that
    over the longer arm.
    """
    squares = [np.einsum("ni,ni->n", errors, errors) for errors in bends]
    limits = [(_GROSS / _MEDIAN_OF_CHI3) ** 2 * np.median(square) for square in squares]
    variance, longer = (np.minimum(*pair).mean() / 3.0 for pair in zip(squares, limits, strict=True))
    white = np.clip((2**power * variance - longer) / (2**power - 1), 0.0, 0.99 * variance)  # as surely as it is known
    other = max(0.9 * float(longer) - float(white), 0.0)  # a tenth may be chance
    return float(np.sqrt(white / 6.0)), float(np.sqrt((variance - white) / 6.0)), float(np.sqrt(other / 2.0))


def _path(t_s: Array, acceleration: Array) -> CubicHermiteSpline:
    velocity, position = integrate_twice(t_s, acceleration)
    return CubicHermiteSpline(t_s, position, velocity)


def _offsets(turns: tuple[float, float], places: tuple[float, float]) -> tuple[float, float, float]:
    """Return the time offset of positions, its sigma and that of turns: the same, unless the two contradict.

    Simulated vision takes its turns from the gyroscope, but its path from the true positions; so do some truths.
    """
    apart_s, sigma_s = turns[0] - places[0], float(np.hypot(turns[1], places[1]))
    if apart_s**2 > chi_square_limit(_SURE, 1) * sigma_s**2:
        return *places, turns[0]
    weights = np.array([turns[1], places[1]]) ** -2.0
    both_s = float(weights @ [turns[0], places[0]] / weights.sum())
    return both_s, float(weights.sum() ** -0.5), both_s


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
