"""Where a camera sits on the IMU, by the accelerometer: stretches that are reconstructed get a scale and a gravity.

With attitudes from the joint adjustment the rest is linear (Mur-Artal and Tardós, "Visual-Inertial Monocular SLAM with
Map Reuse", RA-L 2017, equation 12, with the lever arm unknown too): of three keyframes in a row velocities drop out,

    (P2 - P1) / t12 - (P1 - P0) / t01 = g (t01 + t12) / 2 + R1 dp12 / t12 - R0 dp01 / t01 + R0 dv01,

where the body is at P = s centre - R lever, and dp, dv are preintegrated. Each stretch has a scale s and a gravity g of
known length; the lever arm and the accelerometer's bias are shared.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vislam.calibration.self_calibration.adjust import Piece, Shared
from vislam.calibration.self_calibration.certainty import Certainty, left_out
from vislam.core.imu_noise import ImuNoise
from vislam.core.messages import Array, ImuSample
from vislam.imu.preintegration import preintegrate
from vislam.imu.series import ImuSeries

SHARED = 6  # lever arm in the body's axes, accelerometer's bias
_OWN = 4  # scale and gravity of a stretch
_GRAVITY_M_S2, _GRAVITY_SIGMA = 9.81, 0.05  # what it differs by on earth, and the scale that a calibration leaves
_ARM_M, _BIAS_M_S2 = 1.0, 0.5  # what is taken of mounts and accelerometers in general, one sigma
_ATTITUDE_RAD = 1e-3  # of keyframes
_START_M = 0.005  # noise of centres, before residuals show it
_LEAST_M = 1e-4
_ROUNDS = 6
_LEAST_STRETCHES = 3


@dataclass(frozen=True, slots=True, eq=False)
class LeverArm:
    """Where the camera is in the body's axes, and what came with it."""

    arm_m: Array  # [3] translation of T_body_cam
    accel_bias_m_s2: Array  # [3]
    scale_m: Array  # [B] metres per unit of each stretch
    centre_sigma_m: float  # noise of the camera's places
    known: Certainty  # of arm and bias


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """The equations of one stretch, in m/s: A @ (scale, gravity, lever arm, bias) = b."""

    A: Array  # [3 n, _OWN + SHARED]
    b: Array  # [3 n]
    by_place: Array  # [n, n + 2] of one axis by where the keyframes are
    inertial: Array  # [n] variance


def find_lever_arm(
    pieces: Sequence[Piece], shared: Shared, samples: Sequence[ImuSample], noise: ImuNoise, widened: float
) -> LeverArm | None:
    """Return the lever arm; None where fewer than three stretches lie in the samples or say a scale.

    Args:
        pieces: stretches with their structure, of any scale.
        shared: with rotation, time offset and gyroscope.
        samples: of the IMU, in time order.
        noise: of the accelerometer.
        widened: times the sigmas, as in `certainty`.
    """
    series = ImuSeries()
    for s in samples:
        series.append(ImuSample(s.t_ns, (1.0 + shared.gyro_scale) * s.gyro_rad_s, s.accel_m_s2))
    parts = [rows for piece in pieces if (rows := _rows(piece, shared, series, noise)) is not None]
    if len(parts) < _LEAST_STRETCHES:
        return None
    prior = np.diag(np.repeat([_ARM_M**-2.0, _BIAS_M_S2**-2.0], 3))
    x, sigma_m = np.zeros(SHARED), _START_M
    own = np.tile([1.0, 0.0, 0.0, 0.0], (len(parts), 1))
    for _ in range(_ROUNDS):
        H, g, back = _reduced(parts, own, sigma_m)
        x = np.linalg.solve(prior + H.sum(axis=0), g.sum(axis=0))
        own = np.array([b[:, 0] - b[:, 1:] @ x for b in back])
        chi2 = sum(_chi2(rows, np.concatenate([o, x]), sigma_m) for rows, o in zip(parts, own, strict=True))
        freedom = sum(len(rows.b) - _OWN + 1 for rows in parts) - SHARED
        sigma_m = max(sigma_m * float(np.sqrt(chi2 / max(freedom, 1))), _LEAST_M)
    if not (own[:, 0] > 0.0).all():
        return None
    H, g, _ = _reduced(parts, own, sigma_m)
    known = left_out(prior, H, g - H @ x, widened)
    return LeverArm(x[:3], x[3:], own[:, 0], sigma_m, known)


def _rows(piece: Piece, shared: Shared, series: ImuSeries, noise: ImuNoise) -> _Rows | None:
    """Return the equations of one stretch; None where samples do not cover it."""
    t_ns = piece.segment.t_ns + round(shared.time_offset_s * 1e9)
    spans = [series.cut(a, b) for a, b in itertools.pairwise(t_ns.tolist())]
    R, centre = piece.at.R @ shared.R_cam_body, piece.at.centre
    moves = [preintegrate(span, shared.gyro_bias_rad_s) for span in spans if span is not None]
    n = len(moves) - 1
    if n < 1 or len(moves) < len(spans):
        return None
    A, b, by_place = np.zeros((n, 3, _OWN + SHARED)), np.zeros((n, 3)), np.zeros((n, n + 2))
    inertial = np.zeros(n)
    for i in range(n):
        first, second = moves[i], moves[i + 1]
        t01, t12 = first.dt_s, second.dt_s
        by_place[i, i : i + 3] = 1.0 / t01, -1.0 / t01 - 1.0 / t12, 1.0 / t12
        A[i, :, 0] = by_place[i] @ centre
        A[i, :, 1:_OWN] = -0.5 * (t01 + t12) * np.eye(3)
        A[i, :, _OWN : _OWN + 3] = -np.einsum("k,kab->ab", by_place[i], R)
        to_bias = R[i + 1] @ second.dp_daccel / t12 + R[i] @ (first.dv_daccel - first.dp_daccel / t01)
        A[i, :, _OWN + 3 :] = -to_bias
        b[i] = R[i + 1] @ second.dp_m / t12 + R[i] @ (first.dv_m_s - first.dp_m / t01)
        span_s = 0.5 * (t01 + t12)
        inertial[i] = noise.accelerometer_noise_density**2 * span_s + (_ATTITUDE_RAD * _GRAVITY_M_S2 * span_s) ** 2
    return _Rows(A.reshape(3 * n, -1), b.ravel(), by_place, inertial)


def _information(rows: _Rows, sigma_m: float) -> Array:
    """Return the information [3 n, 3 n]: a place is in three equations, so that their errors are not independent."""
    covariance = sigma_m**2 * rows.by_place @ rows.by_place.T + np.diag(rows.inertial)
    return np.kron(np.linalg.inv(covariance), np.eye(3))


def _reduced(parts: Sequence[_Rows], own: Array, sigma_m: float) -> tuple[Array, Array, list[Array]]:
    """Return what stretches say of the shared unknowns, H [B, 6, 6] and g [B, 6], and how their own follow them."""
    H, g, back = list[Array](), list[Array](), list[Array]()
    for rows, at in zip(parts, own, strict=True):
        WA = _information(rows, sigma_m) @ rows.A
        N, right = rows.A.T @ WA, WA.T @ rows.b
        length = float(np.linalg.norm(at[1:]))
        if length > 0.0:  # gravity's direction is known from the round before, and so its length can be found
            along = at[1:] / length / _GRAVITY_SIGMA
            N[1:_OWN, 1:_OWN] += np.outer(along, along)
            right[1:_OWN] += along * _GRAVITY_M_S2 / _GRAVITY_SIGMA
        N[:_OWN, :_OWN] += np.diag(1e-9 * np.diag(N)[:_OWN] + 1e-12)
        b = np.asarray(np.linalg.solve(N[:_OWN, :_OWN], np.column_stack([right[:_OWN], N[:_OWN, _OWN:]])), np.float64)
        H.append(N[_OWN:, _OWN:] - N[_OWN:, :_OWN] @ b[:, 1:])
        g.append(right[_OWN:] - N[_OWN:, :_OWN] @ b[:, 0])
        back.append(b)
    return np.array(H), np.array(g), back


def _chi2(rows: _Rows, x: Array, sigma_m: float) -> float:
    r = rows.b - rows.A @ x
    return float(r @ _information(rows, sigma_m) @ r)
