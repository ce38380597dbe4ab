"""What the window keeps of a keyframe that leaves: a quadratic prior on the states it was tied to."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, NavState
from vislam.window.equations import inertial, schur, visual
from vislam.window.equations.layout import (
    CALIBRATION,
    Camera,
    Links,
    Normal,
    Prior,
    States,
    Views,
    difference,
    positions,
    prior_positions,
)
from vislam.window.equations.solver import Room, add_prior

_NOTHING = 1e-12  # relative to the largest: information below it is rounding


@dataclass(frozen=True, slots=True, eq=False)
class Leaving:
    """Measurements that leave with keyframe 0."""

    views: Views
    points: Array  # [L, 3]


def marginalise(
    X: Array,
    X_first: Array,
    X_linear: Array,
    calibration: Array,
    leaving: Leaving,
    camera: Camera,
    links: Links,
    prior: Prior,
    gravity_m_s2: float,
    full: bool,
    room: Room,
) -> Prior:
    """Return the prior [16 + (M - 1) * S] on calibration and the keyframes after the first.

    The old prior speaks of states around `X_first` [M, 21]. All are linearised at `X_linear` [M, 21]: those that a
    marginal prior holds where they were, the others at X or near it. The new prior speaks of states around there. The
    views in `leaving`, the link of keyframe 0 and its rest must not be used again. What lies in the room is lost.
    """
    count, size = len(X), 15 if full else 6
    D = size * count + CALIBRATION
    poses_at = 9 * count if full else 0
    where = positions(count, full)
    (A, landmarks), g = room.of(D, len(leaving.points), D - poses_at), np.zeros(D)
    A[:] = 0.0
    held_count = (len(prior.b) - CALIBRATION) // size
    dx = inertial.prior_shift(X, X_first, calibration, prior.calibration, held_count, size)
    add_prior(prior, dx, prior_positions(count, held_count, full), A, g)
    everywhere = np.ones(count, dtype=np.bool_)
    states, normal = States(X, X_linear, everywhere), Normal(A, g)
    inertial.linearise(states, calibration, links, gravity_m_s2, where, min(1, count - 1), 1, normal)
    visual.linearise(states, leaving.points, calibration, leaving.views, camera, poses_at, normal, landmarks)
    schur.eliminate(landmarks, 0.0, poses_at, A, g)
    gone, kept = where[0], np.concatenate([np.arange(D - CALIBRATION, D), where[1:].ravel()])
    A[:, D - CALIBRATION + np.flatnonzero(~camera.active)] = 0.0
    held = np.flatnonzero(np.diag(A)[kept])  # the others are not constrained: their rows and columns are zero
    rows = np.concatenate([gone, kept[held]])
    A = A[np.ix_(rows, rows)]
    A += A.T - np.diag(np.diag(A))  # below the diagonal was nothing
    n = len(gone)
    gain = A[n:, :n] @ _inverse(A[:n, :n])
    left = A[n:, n:] - gain @ A[:n, n:]
    H, gradient = np.zeros((len(kept),) * 2), np.zeros(len(kept))
    H[np.ix_(held, held)] = 0.5 * (left + left.T)
    gradient[held] = g[kept[held]] - gain @ g[gone]
    moved = [difference(x, first)[:size] for x, first in zip(X[1:], X_linear[1:], strict=True)]
    shift = np.concatenate([dx[:CALIBRATION], *moved])
    return Prior(H, gradient - H @ shift, prior.calibration)


def touched(prior: Prior, count: int, full: bool) -> NDArray[np.bool_]:
    """Return which of `count` keyframes the prior constrains."""
    size = 15 if full else 6
    diagonal = np.diag(prior.H)[CALIBRATION:].reshape(-1, size)
    out = np.zeros(count, dtype=bool)
    out[: len(diagonal)] = diagonal.max(axis=1) > 0.0
    return out


def first_prior(state: NavState, gauge_m: float, gauge_rad: float, calibration: Array, sigmas: Array) -> Prior:
    """Return the prior on calibration and keyframe 0.

    Position and yaw are a free choice and fixed to the gauge's sigmas; the rest of the covariance [15, 15] is taken as
    it is, without its correlation to those.
    """
    P = state.covariance.copy()
    up = state.T_world_body[2, :3]
    level = np.eye(15)
    level[:3, :3] -= np.outer(up, up)
    level[3:6, 3:6] = 0.0
    P = level @ P @ level.T
    P[:3, :3] += gauge_rad**2 * np.outer(up, up)
    P[3:6, 3:6] += gauge_m**2 * np.eye(3)
    P += np.diag(np.repeat([1e-5, 0.0, 1e-4, 1e-6, 1e-5], 3) ** 2)  # nothing is known better: keeps it invertible
    information: Array = np.linalg.inv(0.5 * (P + P.T)).astype(np.float64)
    return _prior(information, calibration, sigmas)


def first_pose_prior(gauge_m: float, gauge_rad: float, calibration: Array, sigmas: Array) -> Prior:
    """Return the prior that fixes the pose of keyframe 0 where there is no IMU."""
    return _prior(np.diag(np.repeat([gauge_rad**-2, gauge_m**-2], 3)), calibration, sigmas)


def _prior(information: Array, calibration: Array, sigmas: Array) -> Prior:
    H = np.zeros((CALIBRATION + len(information), CALIBRATION + len(information)))
    H[:CALIBRATION, :CALIBRATION] = np.diag(np.where(sigmas > 0.0, 1.0 / np.maximum(sigmas, 1e-12) ** 2, 0.0))
    H[CALIBRATION:, CALIBRATION:] = information
    return Prior(H, np.zeros(len(H)), calibration.copy())


def _inverse(A: Array) -> Array:
    """Return the inverse of a positive semidefinite matrix, without the directions that nothing was known about."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    values, vectors = np.linalg.eigh(A * np.outer(scale, scale))
    good = values > _NOTHING * values[-1]
    return (vectors[:, good] / values[good]) @ vectors[:, good].T * np.outer(scale, scale)
