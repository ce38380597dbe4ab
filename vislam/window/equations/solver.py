"""Gauss-Newton with damping on demand over keyframes and landmarks, and the covariance of its answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs, dtrtrs

from vislam.core.geometry import so3_exp, so3_log
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.window.equations import inertial, schur, visual
from vislam.window.equations.layout import (
    CALIBRATION,
    RIGHT,
    Camera,
    Ints,
    Links,
    Normal,
    Prior,
    States,
    Views,
    positions,
    prior_positions,
    retract,
)

_MAX_TRIES = 8  # of damping, each ten times the last
_FIRST_DAMPING = 1e-4  # relative to the diagonal
_KNOWN = 1e18  # information on what is not estimated
_MAX_RHO = 20.0  # 1/m: nothing is seen nearer than 5 cm
_PIVOTS = (1e-12, 1e30)  # outside, information is rounding or nonsense


class Solution(NamedTuple):
    """What an optimisation leaves."""

    X: Array  # [M, 21]
    points: Array  # [L, 3]
    calibration: Array  # [16]
    U: Array  # [D, D] upper factor of the information of all states where it was last linearised, without landmarks
    squares: Array  # [N, 2] squared whitened errors of the views: pixel, depth
    cost: float  # half the robust sum of squares
    iterations: int
    ok: bool  # False: the system stayed indefinite, or something is not finite


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Everything that is minimised over, and where it starts.

    States that are `held` are linearised at `X_first`, as the prior that touches them was. The prior speaks of the
    first keyframes, around `X_first`. `full` is with velocities and biases, else poses alone.
    """

    X: Array  # [M, 21]
    X_first: Array  # [M, 21]
    held: NDArray[np.bool_]  # [M]
    points: Array  # [L, 3]
    calibration: Array  # [16]
    views: Views
    camera: Camera
    links: Links
    prior: Prior
    gravity_m_s2: float
    full: bool


@dataclass(slots=True, eq=False)
class _Estimate:
    X: Array
    points: Array
    calibration: Array
    dx: Array  # from where the prior was linearised
    squares: Array
    cost: float


class Room:
    """Memory for the normal equations, kept between problems of about one size: fresh pages cost time."""

    def __init__(self) -> None:
        """Start with none."""
        self._A = np.empty((0, 0))
        self._landmarks = schur.room_for(0, 0)

    def of(self, unknowns: int, landmarks: int, width: int) -> tuple[Array, schur.Landmarks]:
        """Return a matrix [unknowns, unknowns] and the room of landmarks, with whatever was in them."""
        if len(self._A) != unknowns:
            self._A = np.empty((unknowns, unknowns))
        if len(self._landmarks.blocks) < landmarks or self._landmarks.cross.shape[2] != width:
            self._landmarks = schur.room_for(landmarks + landmarks // 4, width)
        return self._A, schur.Landmarks(*(a[:landmarks] for a in self._landmarks))


def optimise(problem: Problem, max_iterations: int, tolerance: float, room: Room) -> Solution:
    """Minimise the robust cost; the answer's factor lies in the room, till the room is used again.

    It has converged when the cost decreased, or can be expected to decrease in another round, by less than
    `tolerance`, relative.
    """
    equations = _Equations(problem, room)
    now = equations.start()
    ok, done, iterations, damping = True, False, 0, 0.0
    while not done and iterations < max_iterations:
        iterations += 1
        new, solved = None, False
        for _ in range(_MAX_TRIES):
            solved = equations.solve(now, damping)
            new = equations.moved(now) if solved else None
            if new is not None and new.cost <= now.cost + (tolerance if damping == 0.0 else 0.0) * abs(now.cost):
                break
            damping, new = max(10.0 * damping, _FIRST_DAMPING), None
        if new is None or new.cost > now.cost:  # first estimates: the last step may lead up by a hair
            ok = solved
            break
        gained = now.cost - new.cost
        left = min(gained, equations.expected(gained)) if damping == 0.0 else gained
        done = left < tolerance * (1.0 + abs(new.cost))
        now, damping = new, 0.0 if damping < 10.0 * _FIRST_DAMPING else 0.1 * damping
    ok = (
        ok
        and (equations.undamped or equations.solve(now, 0.0))
        and bool(np.isfinite(now.X).all())
        and bool(np.isfinite(now.cost))
    )
    return Solution(now.X, now.points, now.calibration, equations.U, now.squares, now.cost, iterations, ok)


class _Equations:
    """The normal equations of a problem and room to solve them."""

    def __init__(self, problem: Problem, room: Room) -> None:
        self._problem = problem
        count = len(problem.X)
        self._size = 15 if problem.full else 6
        self._poses_at = 9 * count if problem.full else 0
        D = self._size * count + CALIBRATION
        self._where = positions(count, problem.full)
        self._held_by_prior = (len(problem.prior.b) - CALIBRATION) // self._size
        self._prior_where = prior_positions(count, self._held_by_prior, problem.full)
        self.U, self._landmarks = room.of(  # the system, and once it is solved its factor
            D, len(problem.points), D - self._poses_at
        )
        self._g, self._step = np.empty(D), np.empty(D)
        self.undamped = False  # whether U is the factor of the system itself
        self.promised = 0.0  # decrease of the cost by the last step, were everything linear

    def start(self) -> _Estimate:
        p = self._problem
        return self._estimate(p.X, p.points, p.calibration)

    def solve(self, now: _Estimate, damping: float) -> bool:
        """Linearise and solve, damped; False if the equations are indefinite."""
        p, A, g = self._problem, self.U, self._g
        A[:], g[:] = 0.0, 0.0
        add_prior(p.prior, now.dx, self._prior_where, A, g)
        count = len(now.X)
        states, normal = States(now.X, p.X_first, p.held), Normal(A, g)
        inertial.linearise(states, now.calibration, p.links, p.gravity_m_s2, self._where, count - 1, count, normal)
        visual.linearise(
            states, now.points, now.calibration, p.views, p.camera, self._poses_at, normal, self._landmarks
        )
        if damping > 0.0:
            np.fill_diagonal(A, np.diag(A) * (1.0 + damping))
        left = g.copy()
        self.undamped = False
        if not schur.eliminate(self._landmarks, damping, self._poses_at, A, left):
            return False
        fixed = len(g) - CALIBRATION + np.flatnonzero(~p.camera.active)
        A[:, fixed], A[fixed], A[fixed, fixed], left[fixed] = 0.0, 0.0, _KNOWN, 0.0
        if not factorise(A):
            return False
        self._step, self.undamped = solve(A, -left), damping == 0.0
        return True

    def moved(self, now: _Estimate) -> _Estimate | None:
        """Return the estimate after the step; None if it is not finite."""
        step = self._step
        if not np.isfinite(step).all():
            return None
        X = moved_states(now.X, step, self._where)
        follow = schur.follow(self._landmarks, step[self._poses_at :])
        self.promised = -0.5 * float(self._g @ step + np.sum(self._landmarks.gradients * follow))
        points = now.points + follow
        np.minimum(points[:, 2], _MAX_RHO, out=points[:, 2])
        calibration = move_calibration(now.calibration, step[-CALIBRATION:], self._problem.camera.active)
        return self._estimate(X, points, calibration)

    def expected(self, gained: float) -> float:
        """Return what another round may gain after an undamped step that gained so much.

        Were the problem linear, the step would have gained what was promised and left no gradient. By the part by
        which that is wrong, here doubled to be safe, the gradient is still there, and what it promises goes with its
        square.
        """
        return (2.0 * (gained - self.promised)) ** 2 / self.promised if self.promised > 0.0 else np.inf

    def _estimate(self, X: Array, points: Array, calibration: Array) -> _Estimate:
        p = self._problem
        dx = inertial.prior_shift(X, p.X_first, calibration, p.prior.calibration, self._held_by_prior, self._size)
        squares = np.zeros((len(p.views.values), 2))
        cost = visual.cost(X, points, calibration, p.views, p.camera, squares)
        cost += inertial.cost(X, calibration, p.links, p.gravity_m_s2)
        cost += float(p.prior.b @ dx + 0.5 * (dx @ (p.prior.H @ dx)))
        return _Estimate(X, points, calibration, dx, squares, cost)


@njit(cache=True, nogil=True, error_model="numpy")
def add_prior(prior: Prior, dx: Array, where: Ints, A: Array, g: Array) -> None:
    """Add the prior at shift `dx` to the upper triangle of the normal equations A, g."""
    touched = np.flatnonzero(np.diag(prior.H))  # the others it does not constrain: their rows and columns are zero
    for i in touched:
        at = where[i]
        row = prior.H[i]
        out = A[at]
        total = prior.b[i]
        for j in touched:
            total += row[j] * dx[j]
            if where[j] >= at:
                out[where[j]] += row[j]
        g[at] += total


def move_calibration(calibration: Array, step: Array, active: NDArray[np.bool_]) -> Array:
    """Return the calibration [16] after a step [16]; what is not estimated stays."""
    out = np.where(active, calibration + step, calibration)
    if active[1]:
        out[1:4] = so3_log(so3_exp(calibration[1:4]) @ so3_exp(step[1:4]))
    if active[RIGHT]:
        right = slice(RIGHT, RIGHT + 3)
        out[right] = so3_log(so3_exp(calibration[right]) @ so3_exp(step[right]))
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def moved_states(X: Array, step: Array, where: Ints) -> Array:
    """Return the states [M, 21] after a step [D]; `where` [M, S] has the indices of each state's unknowns."""
    out = X.copy()
    d = np.empty(where.shape[1])
    for k in range(len(X)):
        for i in range(len(d)):
            d[i] = step[where[k, i]]
        retract(out[k], d)
    return out


# Matrices are upper triangles in rows: `A = U.T @ U`. Their transposes are lower triangles in columns, which is
# LAPACK's own order, so nothing is copied.
def factorise(A: Array) -> bool:
    """Replace the upper triangle of A [D, D], contiguous, by its Cholesky factor; False where it has none."""
    _, info = dpotrf(A.T, lower=1, clean=0, overwrite_a=1)
    pivots = np.diag(A) ** 2
    return info == 0 and bool(((pivots > _PIVOTS[0]) & (pivots < _PIVOTS[1])).all())  # NaN is in no range


def solve(U: Array, rhs: Array) -> Array:
    """Return x with `U.T @ U @ x == rhs` for an upper factor [D, D] and a vector [D]."""
    x, _ = dpotrs(U.T, rhs, lower=1)
    return np.asarray(x, dtype=np.float64)


def trailing_covariance(U: Array, start: int) -> Array:
    """Return the covariance [D - start, D - start] of the unknowns that were eliminated last."""
    half, _ = dpotri(U[start:, start:].T.copy(order="F"), lower=1, overwrite_c=1)
    half = np.tril(half)
    return np.asarray(half + np.tril(half, -1).T)


def joint_covariance(U: Array, index: NDArray[np.int64]) -> Array:
    """Return the covariance [N, N] of some of the unknowns, from the factor [D, D] of the information of all."""
    columns = np.zeros((len(U), len(index)), order="F")
    columns[index, np.arange(len(index))] = 1.0
    half, _ = dtrtrs(U.T, columns, lower=1, overwrite_b=1)
    return np.asarray(half.T @ half)
