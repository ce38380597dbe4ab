"""Vision against inertial data, sensor against sensor: what each measures of the same turns and accelerations.

An estimator that fuses both hides where they disagree in its biases and residuals. Here the two are compared over the
steps between keyframes by least squares, with the few unknowns that a wrong calibration would show in.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vislam.core.angles import angle_deg
from vislam.core.geometry import so3_log
from vislam.core.messages import Array
from vislam.imu import Preintegrated

_MIN_STEPS = 12
_INLIERS = 0.9
_ROUNDS = 6
_CAUCHY = 3.0  # standard deviations
_LEAST_TURN_RAD = 1e-4  # residuals smaller than this are the rounding of stamps, not what sensors can say
_LEAST_SPEED_M_S = 1e-3
_BIAS_RAD_S, _TURN_RAD, _SCALE = 0.5, 0.5, 0.5  # priors, wider than any calibration is wrong
_GRAVITY_SIGMA_M_S2 = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class TurnStep:
    """What happened from one keyframe to the next."""

    inertial: Preintegrated  # without biases taken off
    R_seen: Array  # [3, 3] of the body, by vision


@dataclass(frozen=True, slots=True)
class TurnAgreement:
    """Turns by vision against those of the gyroscope."""

    steps: int
    scale_error: float  # by which vision sees turns too large: a wrong focal length, or scale of the gyroscope
    scale_sigma: float
    residual_rad: float  # of a step, what is left
    worst_rad: float = 0.0  # that nine of ten steps stay below: more than outliers of vision are beyond it


@dataclass(frozen=True, slots=True)
class ForceAgreement:
    """The trajectory against the accelerometer."""

    steps: int
    scale: float  # of the metres of vision, by the accelerometer
    scale_sigma: float
    gravity_m_s2: float  # norm, as the trajectory and the accelerometer have it
    gravity_sigma_m_s2: float
    tilt_deg: float  # of it against the map's vertical


def turn_agreement(steps: Sequence[TurnStep]) -> TurnAgreement | None:
    """Compare turns; None where there are too few.

    A turn phi that vision sees differs from the gyroscope's by its bias, by a camera that stands otherwise on the body
    than given, and by a factor: `e = J b + (R^T - 1) m + phi s`. All three are solved for; the factor is returned.
    """
    if len(steps) < _MIN_STEPS:
        return None
    rows, errors, seen = np.zeros((len(steps), 3, 7)), np.zeros((len(steps), 3)), np.zeros((len(steps), 3))
    for i, step in enumerate(steps):
        R = np.ascontiguousarray(step.inertial.dR)
        errors[i] = so3_log(np.ascontiguousarray(R.T @ step.R_seen))
        rows[i, :, :3] = step.inertial.dR_dgyro
        rows[i, :, 3:6] = R.T - np.eye(3)
        rows[i, :, 6], seen[i] = so3_log(R), so3_log(step.R_seen)
    sigmas = np.array([*[_BIAS_RAD_S] * 3, *[_TURN_RAD] * 3, _SCALE])
    x, covariance, residual = _robust(rows, errors, sigmas, np.zeros(7), _LEAST_TURN_RAD)
    sigma = np.hypot(np.sqrt(covariance[6, 6]), _dilution(rows[:, :, 6] + rows[:, :, :6] @ x[:6], seen))
    worst = np.quantile(np.linalg.norm(errors - rows @ x, axis=1), _INLIERS)
    return TurnAgreement(len(steps), float(x[6]), float(sigma), residual, float(worst))


def force_agreement(
    T_map_body: Array, inertial: Sequence[Preintegrated | None], gravity_m_s2: float, bias_sigma_m_s2: float
) -> ForceAgreement | None:
    """Compare positions with twice integrated force; None where there are too few steps.

    Over two steps the velocity drops out: `s (v_i - v_(i-1)) = g dt + R_i dp_i / dt_i + ...`, with v the mean velocity
    of a step by the trajectory. Unknown are the scale s, gravity g and a constant bias of the accelerometer.

    Args:
        T_map_body: [M, 4, 4] of the keyframes.
        inertial: M - 1 steps between them, gyro bias taken off; None where there are no samples.
        gravity_m_s2: what its norm should be.
        bias_sigma_m_s2: prior of the bias.
    """
    rows, errors = [], []
    for i in range(1, len(T_map_body) - 1):
        before, after = inertial[i - 1], inertial[i]
        if before is None or after is None:
            continue
        R_a, R_b = T_map_body[i - 1, :3, :3], T_map_body[i, :3, :3]
        p = T_map_body[i - 1 : i + 2, :3, 3]
        seen = (p[2] - p[1]) / after.dt_s - (p[1] - p[0]) / before.dt_s
        row = np.zeros((3, 7))
        row[:, 0] = seen
        row[:, 1:4] = -0.5 * (before.dt_s + after.dt_s) * np.eye(3)
        row[:, 4:] = R_a @ (before.dp_daccel / before.dt_s - before.dv_daccel) - R_b @ after.dp_daccel / after.dt_s
        rows.append(row)
        errors.append(R_b @ after.dp_m / after.dt_s - R_a @ (before.dp_m / before.dt_s - before.dv_m_s))
    if len(rows) < _MIN_STEPS:
        return None
    sigmas = np.array([_SCALE, *[_GRAVITY_SIGMA_M_S2] * 3, *[bias_sigma_m_s2] * 3])
    mean = np.array([1.0, 0.0, 0.0, -gravity_m_s2, 0.0, 0.0, 0.0])
    A, b = np.array(rows), np.array(errors)
    x, covariance, _ = _robust(A, b, sigmas, mean, _LEAST_SPEED_M_S)
    scale_sigma = np.hypot(np.sqrt(covariance[0, 0]), _dilution(A[:, :, 0], b - A[:, :, 1:] @ x[1:]))
    norm = float(np.linalg.norm(x[1:4]))
    along = x[1:4] / max(norm, 1e-9)
    tilt = angle_deg(along, np.array([0.0, 0.0, -1.0]))
    sigma = float(np.sqrt(along @ covariance[1:4, 1:4] @ along))
    return ForceAgreement(len(rows), float(x[0]), float(scale_sigma), norm, sigma, tilt)


def _dilution(one: Array, other: Array) -> float:
    """Return how far the factor between two noisy measurements [N, 3] of the same may be off for their noise.

    Noise in what is multiplied draws a factor towards zero; multiplying the other one instead draws it the other way.
    The truth is between the two (Frisch 1934), which are 1 / r^2 apart, r the correlation: where nothing turns, or
    nothing speeds up, only noise is left, and a factor is meaningless.
    """
    a, b = one - one.mean(axis=0), other - other.mean(axis=0)
    together = float(np.sum(a * b)) ** 2
    apart = float(np.sum(a * a)) * float(np.sum(b * b))
    return 0.5 * (apart / together - 1.0) if together > 0.0 else float("inf")


def _robust(rows: Array, errors: Array, sigmas: Array, mean: Array, least: float) -> tuple[Array, Array, float]:
    """Return solution [K], covariance [K, K] and the standard deviation of a row of [N, 3, K], from the residuals."""
    weights = np.ones(len(rows))
    x, P, spread = mean.copy(), np.diag(sigmas**2), least
    for _ in range(_ROUNDS):
        A = np.einsum("nik,n,nil->kl", rows, weights, rows) / spread**2 + np.diag(1.0 / sigmas**2)
        b = np.einsum("nik,n,ni->k", rows, weights, errors) / spread**2 + mean / sigmas**2
        P = np.linalg.inv(A)
        x = P @ b
        squares = np.mean((errors - rows @ x) ** 2, axis=1)
        spread = max(float(np.sqrt(np.median(squares) / 0.79)), least)  # 0.79: median of chi2 of 3, over 3
        weights = 1.0 / (1.0 + squares / (_CAUCHY * spread) ** 2)
    return x, P, spread
