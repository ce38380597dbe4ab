"""All stretches adjusted together over one lens: Levenberg-Marquardt, points and poses of each stretch eliminated.

What a stretch contributes to the shared unknowns, once its own are gone, is one small matrix: so memory does not grow
with the recording, and leaving a stretch out costs one more solution of a small system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from vislam.calibration.cameras import parameters_of
from vislam.calibration.self_calibration.segments import Segment
from vislam.calibration.self_calibration.structure import (
    BIAS,
    GYRO,
    LENS,
    OFFSET,
    READOUT,
    SCALE,
    SHARED,
    Gyro,
    Linear,
    Structure,
    TurnRows,
    linearise,
    residuals,
    turn_rows,
)
from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.core.geometry import so3_exp
from vislam.core.messages import Array, Bools
from vislam.imu.gyro_turns import GyroTurns, integrated

_CAUCHY = 2.0  # standard deviations
_MEDIAN_2 = 1.386  # of chi-square with two degrees of freedom
_GATE = 6.0  # standard deviations beyond which an observation is no measurement ...
_GATE_SHARE = 0.001  # ... unless it is nearer than this of the image's width: gates that close on themselves bias
_LEAST_SEEN = 3
_LEAST_FLOWS = 12  # tracks of a keyframe that may show how the camera moved
_LEAST_DAMPING, _MOST_DAMPING = 1e-8, 1e6
_CONVERGED = 1e-5  # relative change of the cost
_RIDGE = 1e-9  # relative: keeps free scales and points without a constraint regular
_MAX_RHO = 50.0  # in units of the usual distance


@dataclass(frozen=True, eq=False)
class Shared:
    """What all stretches have in common."""

    camera: Camera
    readout_s: float
    gyro: Gyro | None = None  # what follows is known with one only
    R_cam_body: Array = field(default_factory=lambda: np.eye(3))
    time_offset_s: float = 0.0  # to be added to the camera's stamps
    gyro_bias_rad_s: Array = field(default_factory=lambda: np.zeros(3))
    gyro_scale: float = 0.0  # rates are larger by this share

    def moved(self, step: Array) -> Shared:
        """Return it after a step [SHARED]; raises DataError where that is no camera."""
        c, to = self.camera, step[GYRO:]
        fx, fy, cx, cy, *k = (self.values[:LENS] + step[:LENS]).tolist()
        return Shared(
            replace(c, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=tuple(k[: len(c.coefficients)])),
            self.readout_s + float(step[READOUT]),
            self.gyro,
            so3_exp(to[:3].copy()) @ self.R_cam_body,
            self.time_offset_s + float(to[OFFSET]),
            self.gyro_bias_rad_s + to[BIAS],
            self.gyro_scale + float(to[SCALE]),
        )

    @property
    def values(self) -> Array:
        """The unknowns [SHARED]; the rotation, which is no vector, counts as zero."""
        c = self.camera
        lens = np.zeros(LENS)
        lens[: 4 + len(c.coefficients)] = parameters_of(c)
        gyro = [*np.zeros(3), self.time_offset_s, *self.gyro_bias_rad_s, self.gyro_scale]
        return np.array([*lens, self.readout_s, *gyro])

    @property
    def free(self) -> Bools:
        """Which unknowns [SHARED] there are."""
        return np.arange(SHARED) < (GYRO if self.gyro is None else SHARED)

    @cached_property
    def turns(self) -> GyroTurns | None:
        """What the gyroscope turned by, its bias and scale taken off."""
        gyro = self.gyro
        if gyro is None:
            return None
        return integrated(gyro.t_s, (1.0 + self.gyro_scale) * gyro.rate_rad_s, self.gyro_bias_rad_s)

    def rows(self, piece: Piece) -> TurnRows | None:
        """Return by what the turns of a piece differ from the gyroscope's; None without one."""
        if self.gyro is None or self.turns is None:
            return None
        return turn_rows(piece.at.R, piece.segment.t_ns, self.gyro, self.turns, self.R_cam_body, self.time_offset_s)


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """A stretch with its present structure and the observations [n, m] that count."""

    segment: Segment
    at: Structure
    kept: Bools


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is taken of cameras in general: mean and information of the shared unknowns, and of ln(fx / fy)."""

    mean: Array  # [SHARED]
    information: Array  # [SHARED]
    aspect_information: float

    def equations(self, shared: Shared) -> tuple[Array, Array, float]:
        """Return information [SHARED, SHARED], gradient and cost at some values."""
        x = shared.values
        off = self.mean - x
        row = np.zeros(SHARED)
        row[0], row[1] = 1.0 / x[0], -1.0 / x[1]
        aspect = float(np.log(x[0] / x[1]))
        H = np.diag(self.information) + self.aspect_information * np.outer(row, row)
        g = self.information * off - self.aspect_information * row * aspect
        return H, g, float(self.information @ off**2 + self.aspect_information * aspect**2)


@dataclass(frozen=True, slots=True, eq=False)
class Reduced:
    """What one stretch contributes to the shared unknowns, and how its own follow them."""

    H: Array  # [SHARED, SHARED]
    g: Array  # [SHARED]
    own: Array  # [q, 1 + SHARED] step of the poses for none, and per unit, of the shared unknowns
    back: Array  # [m, 3, 1 + q + SHARED] the same of the points, by poses and shared


def adjust(
    pieces: Sequence[Piece],
    shared: Shared,
    prior: Prior,
    free: Bools,
    sigma_px: float,
    iterations: int,
    damping: float = 1e-3,
) -> tuple[list[Piece], Shared, float]:
    """Return pieces, shared unknowns and cost after `iterations` steps at most; only `free` [SHARED] ones move."""
    pieces = list(pieces)
    cost = _cost(pieces, shared, prior, sigma_px)
    for _ in range(iterations):
        reduced = [_reduced(piece, shared, sigma_px, damping) for piece in pieces]
        H, g, _ = prior.equations(shared)
        H = H + np.sum([part.H for part in reduced], axis=0)
        g = g + np.sum([part.g for part in reduced], axis=0)
        while damping < _MOST_DAMPING:
            step = np.zeros(SHARED)
            A = H[np.ix_(free, free)]
            step[free] = np.linalg.solve(A + damping * np.diag(np.diag(A)), g[free])
            try:
                there = shared.moved(step)
                moved = [_moved(piece, part, step) for piece, part in zip(pieces, reduced, strict=True)]
                new = _cost(moved, there, prior, sigma_px)
            except DataError:
                new = np.inf
            if new < cost:
                break
            damping *= 8.0
            reduced = [_reduced(piece, shared, sigma_px, damping) for piece in pieces]
        else:
            break
        gained = (cost - new) / cost
        pieces, shared, cost = moved, there, new
        damping = max(damping / 6.0, _LEAST_DAMPING)
        if gained < _CONVERGED:
            break
    return pieces, shared, cost


def reduce_all(pieces: Sequence[Piece], shared: Shared, sigma_px: float) -> list[Reduced]:
    """Return what each stretch contributes, undamped."""
    return [_reduced(piece, shared, sigma_px, 0.0) for piece in pieces]


def scatter_px(pieces: Sequence[Piece], shared: Shared) -> float:
    """Return the noise of a pixel's coordinate as the median of residuals shows it, unknowns counted."""
    squares, numbers, unknowns = [], 0, 0
    for piece in pieces:
        r = residuals(piece.segment, piece.at, shared.camera, shared.readout_s)[piece.kept]
        squares.append(np.sum(r[np.isfinite(r).all(axis=1)] ** 2, axis=1))
        numbers += 2 * len(r)
        unknowns += 3 * int(piece.kept.any(axis=0).sum()) + 6 * len(piece.at.R)
    if not numbers:
        return float("inf")
    share = max(1.0 - unknowns / numbers, 0.2)
    return float(np.sqrt(np.median(np.concatenate(squares)) / _MEDIAN_2 / share))


def steadied(piece: Piece, shared: Shared) -> Piece:
    """Return the piece with the velocities that one motion of the camera gives in each keyframe, fitted to the flow.

    Noise of single velocities would hide a rolling shutter: most of what it does looks like motion and turning, and
    what is left to see is less than that noise (errors in variables).
    """
    segment = piece.segment
    seen = linearise(segment, piece.at, shared.camera, shared.readout_s, piece.kept)
    velocity = segment.velocity_px_s.copy()
    bounds = np.searchsorted(seen.keyframe, np.arange(len(piece.at.R) + 1))
    for k, (a, b) in enumerate(zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)):
        if b - a < _LEAST_FLOWS:
            continue
        J, points = seen.by_pose[a:b], seen.point[a:b]
        flow = segment.flow_px_s[k, points]
        weight = np.ones(b - a)
        for _ in range(4):
            W = J * weight[:, None, None]
            A = np.einsum("nij,nik->jk", W, J)
            A += np.diag(1e-9 * np.diag(A) + 1e-12)  # of a pure turn the shift is free
            left = flow - J @ np.linalg.solve(A, np.einsum("nij,ni->j", W, flow))
            off = np.sum(left**2, axis=1)
            weight = 1.0 / (1.0 + off / max(float(np.median(off)), 1e-6))
        velocity[k, points] = flow - left
    return replace(piece, segment=replace(segment, velocity_px_s=velocity))


def judged(piece: Piece, shared: Shared, sigma_px: float) -> Piece:
    """Return the piece with every observation that fits, of points that three keyframes or more see."""
    r = residuals(piece.segment, piece.at, shared.camera, shared.readout_s)
    with np.errstate(invalid="ignore"):
        kept = np.linalg.norm(r, axis=2) < max(_GATE * sigma_px, _GATE_SHARE * shared.camera.width)
        kept &= (piece.at.rho > -0.05) & (piece.at.rho < _MAX_RHO)
    kept &= kept.sum(axis=0) >= _LEAST_SEEN
    return replace(piece, kept=kept)


def _cost(pieces: Sequence[Piece], shared: Shared, prior: Prior, sigma_px: float) -> float:
    """Return the robust cost; an observation that no ray of the lens gives counts as far off."""
    total = prior.equations(shared)[2]
    for piece in pieces:
        r = residuals(piece.segment, piece.at, shared.camera, shared.readout_s)[piece.kept]
        chi2 = np.nan_to_num(np.sum(r**2, axis=1) / sigma_px**2, nan=1e6)
        rows = shared.rows(piece)
        if rows is not None:
            chi2 = np.concatenate([chi2, rows.information * np.sum(rows.errors**2, axis=1)])
        total += float(_CAUCHY**2 * np.sum(np.log1p(chi2 / _CAUCHY**2)))
    return total


def _reduced(piece: Piece, shared: Shared, sigma_px: float, damping: float) -> Reduced:
    """Eliminate points, then poses but the origin's."""
    seen = linearise(piece.segment, piece.at, shared.camera, shared.readout_s, piece.kept)
    weight = 1.0 / sigma_px**2 / (1.0 + np.sum(seen.r**2, axis=1) / (_CAUCHY * sigma_px) ** 2)
    n, m = piece.kept.shape
    U, g, E, V, e = _equations(seen, weight, n, m)
    rows = shared.rows(piece)
    if rows is not None:
        _add_turns(U, g, rows, n)
    free = np.ones(len(g), dtype=np.bool_)
    free[6 * piece.at.origin : 6 * piece.at.origin + 6] = False
    U, g, E = U[np.ix_(free, free)], g[free], E[free]
    q = len(g) - SHARED
    V = _damped(V, damping + _RIDGE)
    back = np.linalg.solve(V, np.concatenate([e[:, :, None], -E.transpose(1, 2, 0)], axis=2))  # [m, 3, 1 + q + S]
    flat = E.reshape(len(g), -1)
    S = U + flat @ back[:, :, 1:].reshape(3 * m, -1)
    g = g - flat @ back[:, :, 0].ravel()
    A = S[:q, :q] + np.diag((damping + _RIDGE) * np.diag(U)[:q] + 1e-12)
    own = np.linalg.solve(A, np.column_stack([g[:q], -S[:q, q:]]))
    H = S[q:, q:] + S[q:, :q] @ own[:, 1:]
    return Reduced(0.5 * (H + H.T), g[q:] - S[q:, :q] @ own[:, 0], own, back)


def _equations(seen: Linear, weight: Array, n: int, m: int) -> tuple[Array, Array, Array, Array, Array]:
    """Return normal equations: U, g of poses and shared [6 n + SHARED], E [., m, 3] with points, V, e of points."""
    k, p = seen.keyframe, seen.point
    q = 6 * n
    J = np.concatenate([seen.by_pose, seen.by_shared], axis=2)
    W = J.transpose(0, 2, 1) * weight[:, None, None]
    JJ, Jr, JP = W @ J, np.einsum("nij,nj->ni", W, seen.r), W @ seen.by_point
    U, g, E = np.zeros((q + SHARED, q + SHARED)), np.zeros(q + SHARED), np.zeros((q + SHARED, m, 3))
    bounds = np.searchsorted(k, np.arange(n + 1))
    shared = slice(q, None)
    for i in range(n):
        a, b, own = bounds[i], bounds[i + 1], slice(6 * i, 6 * i + 6)
        block = JJ[a:b].sum(axis=0)
        U[own, own], U[own, shared], U[shared, own] = block[:6, :6], block[:6, 6:], block[6:, :6]
        U[shared, shared] += block[6:, 6:]
        g[own] = Jr[a:b, :6].sum(axis=0)
        E[own, p[a:b]] = JP[a:b, :6].transpose(1, 0, 2)
        E[shared, p[a:b]] += JP[a:b, 6:].transpose(1, 0, 2)
    g[shared] = Jr[:, 6:].sum(axis=0)
    P = seen.by_point.transpose(0, 2, 1) * weight[:, None, None]
    V, e = np.zeros((m, 3, 3)), np.zeros((m, 3))
    np.add.at(V, p, P @ seen.by_point)
    np.add.at(e, p, np.einsum("nij,nj->ni", P, seen.r))
    return U, g, E, V, e


def _add_turns(U: Array, g: Array, rows: TurnRows, n: int) -> None:
    """Add what the gyroscope measures between successive keyframes."""
    chi2 = rows.information * np.sum(rows.errors**2, axis=1)
    weight = rows.information / (1.0 + chi2 / _CAUCHY**2)
    shared = np.arange(6 * n + GYRO, 6 * n + SHARED)
    for i in range(n - 1):
        A = np.column_stack([np.eye(3), rows.by_second[i], rows.by_gyro[i]])
        at = np.concatenate([6 * i + np.arange(3), 6 * i + 6 + np.arange(3), shared])
        U[np.ix_(at, at)] += weight[i] * A.T @ A
        g[at] += weight[i] * A.T @ rows.errors[i]


def _damped(V: Array, damping: float) -> Array:
    """Return point blocks [m, 3, 3] with a share of their diagonal added, and ones where nothing is known."""
    diagonal = np.einsum("mii->mi", V)
    floor = 1e-6 * np.maximum(diagonal.max(axis=1, keepdims=True), 1e-6)
    return V + np.eye(3) * (damping * diagonal + np.where(diagonal > floor, 0.0, 1.0) * floor)[:, None]


def _moved(piece: Piece, part: Reduced, step: Array) -> Piece:
    n = len(piece.at.R)
    own = part.own[:, 0] + part.own[:, 1:] @ step
    by_point = part.back[:, :, 0] + part.back[:, :, 1:] @ np.concatenate([own, step])
    by_pose = np.zeros((n, 6))
    by_pose[np.arange(n) != piece.at.origin] = own.reshape(-1, 6)
    return replace(piece, at=piece.at.moved(by_pose, by_point))
