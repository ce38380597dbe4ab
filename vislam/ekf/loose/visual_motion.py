"""Motion that vision saw since a keyframe, as the filter takes it: checked, linearised, gated and applied, compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vislam.core.jit import njit
from vislam.core.messages import Array, VoMeasurement
from vislam.ekf.loose.kernels import pose, update
from vislam.ekf.loose.measurements import LinearMeasurement, spread
from vislam.vision.relative_motion import direction_noise, direction_residual, metric_residual

_FLOOR = 1e-10  # variance, rad^2 and m^2: keeps an identity motion with zero covariance from making S singular
_OPPOSITE_SIGMAS = 3.0
_NOT_RIGID = "the motion is not a finite rigid transform"
_NOT_FINITE = "the covariance is not 6x6 finite numbers"


class Seen(NamedTuple):
    """A motion as compiled code takes it; see `relative_motion`."""

    T: Array  # [4, 4]
    covariance: Array  # [6, 6]
    has_scale: bool
    lever_m: Array  # [3]


class Shared(NamedTuple):
    """What all motions from one keyframe have in common; see `shared_error`."""

    fraction: float  # of the noise variance
    already: Array  # [6, 6] what earlier ones have added to the clone


def why_unusable(vo: VoMeasurement) -> str:
    """Return what is wrong with the numbers of a motion that is not lost, "" if nothing is."""
    if vo.T_keyframe_body is None:
        return "no motion given"
    T, covariance = numbers(vo.T_keyframe_body), numbers(vo.covariance)
    if T.shape != (4, 4):
        return _NOT_RIGID
    if covariance.shape != (6, 6):
        return _NOT_FINITE
    is_rigid, is_finite, is_semidefinite = _check(T, covariance)
    if not is_rigid:
        return _NOT_RIGID
    if not is_finite:
        return _NOT_FINITE
    return "" if is_semidefinite else "the covariance is not positive semidefinite"


def numbers(values: Array) -> Array:
    """Return a copy as compiled code takes it; for another layout a compiler would run while the pose waits."""
    return np.array(values, dtype=np.float64, order="C")


@njit(cache=True, nogil=True)
def _check(T: Array, covariance: Array) -> tuple[bool, bool, bool]:
    """Return whether T [4, 4] is a motion, the covariance finite, and a covariance."""
    volume = (  # a rotation has 1
        T[0, 0] * (T[1, 1] * T[2, 2] - T[1, 2] * T[2, 1])
        - T[0, 1] * (T[1, 0] * T[2, 2] - T[1, 2] * T[2, 0])
        + T[0, 2] * (T[1, 0] * T[2, 1] - T[1, 1] * T[2, 0])
    )
    is_rigid = bool(np.isfinite(T).all()) and abs(volume - 1.0) <= 1e-3
    return is_rigid, bool(np.isfinite(covariance).all()), _is_semidefinite(covariance)


@njit(cache=True, nogil=True)
def _is_semidefinite(C: Array) -> bool:
    """Whether the symmetric part of C [n, n] has no eigenvalue below -1e-9 (1 + trace): by Cholesky's factors."""
    n = len(C)
    S = 0.5 * (C + C.T)
    slack = 1e-9 * (1.0 + np.trace(C))
    for i in range(n):
        for j in range(i + 1):
            for k in range(j):
                S[i, j] -= S[i, k] * S[j, k]
            if i == j:
                S[i, i] += slack
                if not S[i, i] > 0.0:
                    return False
                S[i, i] = math.sqrt(S[i, i])
            else:
                S[i, j] /= S[j, j]
    return True


@njit(cache=True, nogil=True)
def relative_motion(
    x: Array, P: Array, T: Array, covariance: Array, has_scale: bool, lever_m: Array
) -> tuple[LinearMeasurement, float]:
    """Return motion against the clone: 6 rows, 5 without scale, 3 (rotation) without parallax.

    Args:
        x: nominal state [23 + K].
        P: covariance [21 + K, 21 + K]; how far the camera moved is only as well known as by this.
        T: [4, 4] from the keyframe that is cloned to the body; without scale its translation is a unit direction, or 0.
        covariance: [6, 6] of T, on its body side, inflated.
        has_scale: whether the translation is in metres.
        lever_m: camera in the body frame [3]; only matters without scale.

    Returns:
        The measurement, and by how many metres it is impossible whatever the gate decides: moved against the direction.
    """
    T_clone, T_body = pose(x, 16, 19), pose(x, 0, 6)
    direction = T[:3, 3].copy()
    opposed_m = 0.0
    if has_scale or np.sum(direction * direction) < 0.25:  # a unit direction or zero, nothing between
        residual, J_clone, J_body = metric_residual(T_clone, T_body, T)
        rows = 6 if has_scale else 3
        residual, J_clone, J_body = residual[:rows].copy(), J_clone[:rows].copy(), J_body[:rows].copy()
        noise = covariance[:rows, :rows].copy()
    else:
        residual, J_clone, J_body, axes, along = direction_residual(T_clone, T_body, T, lever_m)
        variance = _displacement_variance(P, T_clone, direction)
        if along < -_OPPOSITE_SIGMAS * math.sqrt(variance):
            opposed_m = -along
        noise = direction_noise(T, covariance, axes, math.sqrt(along * along + variance))
    for i in range(len(noise)):
        noise[i, i] += _FLOOR
    return LinearMeasurement(residual, spread(J_clone, J_body), noise), opposed_m


@njit(cache=True, nogil=True)
def _displacement_variance(P: Array, T_clone: Array, direction: Array) -> float:
    """Return how well the motion since the clone is known along a direction [3] of the clone's axes, in m^2."""
    row = np.zeros(len(P))
    row[3:6] = np.ascontiguousarray(T_clone[:3, :3]) @ direction
    row[18:21] = -row[3:6]
    return max(np.sum(row * (P @ row)), 0.0)


@njit(cache=True, nogil=True)
def shared_error(J_clone: Array, noise: Array, already: Array) -> Array:
    """Return what to add to the clone's covariance [6, 6] for the noise that all motions from one keyframe share.

    Motions relative to one keyframe are built on the same landmarks: their errors have a common part, which repeated
    measuring does not average out. It acts like an error of the keyframe's pose, so it is added to the clone once, and
    only the rest is white noise.

    Args:
        J_clone: Jacobian [m, 6] by the clone, of full rank.
        noise: [m, m] the shared part.
        already: [6, 6] what earlier motions from this keyframe have added to the clone.
    """
    J_T = np.ascontiguousarray(J_clone.T)
    inverse_T = np.linalg.solve(J_clone @ J_T, J_clone)  # that of Moore and Penrose, for rows that are independent
    wanted = np.ascontiguousarray(inverse_T.T) @ (noise @ inverse_T) - already
    values, vectors = np.linalg.eigh(0.5 * (wanted + wanted.T))
    return (vectors * np.maximum(values, 0.0)) @ np.ascontiguousarray(vectors.T)


@njit(cache=True, nogil=True)
def correct(
    x: Array, P: Array, motion: Seen, shared: Shared, limits: Array, moves: Array
) -> tuple[float, int, float, Array]:
    """Correct x and P in place by a motion since the clone, unless it fails its gate.

    Args:
        x: nominal state [23 + K].
        P: covariance [21 + K, 21 + K].
        motion: since the clone.
        shared: with earlier motions from this keyframe.
        limits: [13] of the gate, by degrees of freedom.
        moves: [21 + K, 21 + K] what becomes of the optimal gain.

    Returns:
        The normalised innovation squared, its degrees of freedom, by how many metres the motion is impossible, and what
        was added to the clone [6, 6] if it was accepted.
    """
    fraction, already = shared
    seen, opposed_m = relative_motion(x, P, motion.T, motion.covariance, motion.has_scale, motion.lever_m)
    degrees = len(seen.residual)
    more = np.zeros((6, 6))
    widened = P.copy()
    if fraction > 0.0:
        more = shared_error(seen.H[:, 15:21].copy(), fraction * seen.noise, already)
        widened[15:21, 15:21] += more
    limit = limits[degrees] if opposed_m == 0.0 else -1.0
    nis = update(x, widened, seen.H, (1.0 - fraction) * seen.noise, seen.residual, limit, moves)
    if nis <= limit:
        P[:] = widened
    return nis, degrees, opposed_m, more
