"""Gauss-Newton with damping on demand over keyframes and landmarks, and the covariance of its answer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from vislam.geometry import so3_exp, so3_log
from vislam.messages import Array
from vislam.window import inertial as links_of
from vislam.window import linear, visual
from vislam.window.layout import CALIBRATION, Camera, Links, Prior, Views, positions, prior_positions, retract

_MAX_TRIES = 8  # of damping, each ten times the last
_FIRST_DAMPING = 1e-4  # relative to the diagonal
_MAX_RHO = 20.0  # 1/m: nothing is seen nearer than 5 cm

_links_cost, _links_linearise, _prior_shift = links_of.cost, links_of.linearise, links_of.prior_shift
_views_cost, _views_linearise = visual.cost, visual.linearise
_eliminate, _follow = visual.eliminate, visual.follow
_factorise, _solve = linear.factorise, linear.solve


class Solution(NamedTuple):
    """What an optimisation leaves."""

    X: Array  # [M, 21]
    points: Array  # [L, 3]
    calibration: Array  # [5]
    U: Array  # [D, D] upper factor of the information of all states at the solution, landmarks eliminated
    squares: Array  # [N, 2] squared whitened errors of the views: pixel, depth
    cost: float  # half the robust sum of squares
    iterations: int
    ok: bool  # False: the system stayed indefinite, or something is not finite


@njit(cache=True, nogil=True, error_model="numpy")
def _prior_cost(prior: Prior, dx: Array) -> float:
    return float(prior.b @ dx + 0.5 * (dx @ (prior.H @ dx)))


@njit(cache=True, nogil=True, error_model="numpy")
def add_prior(prior: Prior, dx: Array, where: np.ndarray, A: Array, g: Array) -> None:
    """Add the prior at shift `dx` to the upper triangle of the normal equations A, g."""
    gradient = prior.b + prior.H @ dx
    for i in range(len(where)):
        at = where[i]
        g[at] += gradient[i]
        row = prior.H[i]
        out = A[at]
        for j in range(len(where)):
            if where[j] >= at:
                out[where[j]] += row[j]


@njit(cache=True, nogil=True, error_model="numpy")
def move_calibration(calibration: Array, step: Array, active: np.ndarray) -> Array:
    """Return the calibration [5] after a step [5]; what is not estimated stays."""
    out = calibration.copy()
    if active[0]:
        out[0] += step[0]
    if active[1]:
        out[1:4] = so3_log(so3_exp(calibration[1:4].copy()) @ so3_exp(step[1:4].copy()))
    if active[4]:
        out[4] += step[4]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def optimise(  # noqa: PLR0912, PLR0915 (compiled as one, so that the loop never leaves machine code)
    X: Array,
    X_first: Array,
    held: np.ndarray,
    points: Array,
    calibration: Array,
    views: Views,
    camera: Camera,
    links: Links,
    prior: Prior,
    gravity_m_s2: float,
    full: bool,
    max_iterations: int,
    tolerance: float,
) -> Solution:
    """Minimise the robust cost of views, links and prior.

    Args:
        X: start [M, 21].
        X_first: where states are linearised that the prior holds, [M, 21]; the first n of them.
        held: which they are [M]. Give none held to have the prior without fixing derivatives (batch).
        points: start of the landmarks [L, 3].
        calibration: start [5].
        views: observations.
        camera: geometry and timing.
        links: between keyframes.
        prior: on calibration and the first keyframes.
        gravity_m_s2: along -z.
        full: with velocities and biases, else poses alone.
        max_iterations: of Gauss-Newton.
        tolerance: relative decrease of the cost below which it has converged.
    """
    count = len(X)
    size = 15 if full else 6
    D = size * count + CALIBRATION
    poses_at = 9 * count if full else 0
    where = positions(count, full)
    prior_held = (len(prior.b) - CALIBRATION) // size
    prior_where = prior_positions(count, prior_held, full)
    A, S, g, s = np.empty((D, D)), np.empty((D, D)), np.empty(D), np.empty(D)
    L = len(points)
    A_points, inverses, g_points = np.empty((L, 3, 3)), np.empty((L, 3, 3)), np.empty((L, 3))
    cross = np.empty((L, 3, D - poses_at))
    squares, new_squares = np.zeros((len(views.xy), 2)), np.zeros((len(views.xy), 2))
    X, points, calibration = X.copy(), points.copy(), calibration.copy()
    new_points = points.copy()
    dx = _prior_shift(X, X_first, calibration, prior.calibration, prior_held, size)
    views_cost = _views_cost(X, points, calibration, views, camera, squares)
    now = views_cost + _links_cost(X, links, gravity_m_s2) + _prior_cost(prior, dx)
    done, ok, iterations, damping = False, True, 0, 0.0
    while not done and iterations < max_iterations:
        iterations += 1
        A[:] = 0.0
        g[:] = 0.0
        add_prior(prior, dx, prior_where, A, g)
        _links_linearise(X, X_first, held, links, gravity_m_s2, where, count - 1, count, A, g)
        for i in range(CALIBRATION):
            if not camera.active[i]:
                at = D - CALIBRATION + i
                A[at, at] += 1.0
        _views_linearise(
            X, X_first, held, points, calibration, views, camera, poses_at, A, g, A_points, g_points, cross
        )
        accepted = False
        for _ in range(_MAX_TRIES):
            S[:] = A
            s[:] = g
            for i in range(D):
                S[i, i] *= 1.0 + damping
            solved = _eliminate(inverses, A_points, g_points, cross, damping, poses_at, S, s) and _factorise(S)
            if solved:
                step = _solve(S, -s)
                new_X = X.copy()
                for k in range(count):
                    d = np.empty(size)
                    for i in range(size):
                        d[i] = step[where[k, i]]
                    retract(new_X[k], d)
                new_calibration = move_calibration(calibration, step[D - CALIBRATION :], camera.active)
                _follow(points, inverses, g_points, cross, step[poses_at:], new_points)
                for p in range(L):
                    new_points[p, 2] = min(new_points[p, 2], _MAX_RHO)
                new_dx = _prior_shift(new_X, X_first, new_calibration, prior.calibration, prior_held, size)
                new_views = _views_cost(new_X, new_points, new_calibration, views, camera, new_squares)
                new = new_views + _links_cost(new_X, links, gravity_m_s2) + _prior_cost(prior, new_dx)
                if new <= now + 1e-9 * abs(now):
                    accepted = True
                    break
                if now + tolerance * (1.0 + views_cost) > new and damping == 0.0:
                    break  # no worse than noise: converged as far as first estimates allow
            damping = max(10.0 * damping, _FIRST_DAMPING)
        if not accepted:
            done = True
            ok = solved
        else:
            done = now - new < tolerance * (1.0 + new_views)
            X, points, calibration, dx, now, views_cost = (
                new_X, new_points.copy(), new_calibration, new_dx, new, new_views,
            )  # fmt: skip
            squares[:] = new_squares
            if damping > 0.0:
                damping = 0.0 if damping < 10.0 * _FIRST_DAMPING else 0.1 * damping
    if ok:  # the covariance is that of the undamped system
        S[:] = A
        s[:] = g
        ok = _eliminate(inverses, A_points, g_points, cross, 0.0, poses_at, S, s) and _factorise(S)
    ok = ok and bool(np.isfinite(X).all()) and bool(np.isfinite(now))
    return Solution(X, points, calibration, S, squares, now, iterations, ok)
