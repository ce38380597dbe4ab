"""The first window refined: poses, velocities, biases, the camera's time offset and points by least squares.

It begins at the closed form of `initialisation_linear`; its inverse Hessian says how well scale is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.frontend.inertial_alignment import (
    Alignment,
    NormalEquations,
    Window,
    add_inertial,
    add_priors,
    inverse,
    up_to_z,
)
from vislam.frontend.initialisation_kernels import visual_system
from vislam.frontend.initialisation_linear import InertialPath, Start, Tracks
from vislam.geometry import so3_exp
from vislam.imu import Preintegrated, preintegrate
from vislam.messages import Array

_OUTLIER = 3.5  # standard deviations of one observation, after convergence
_ROUNDS = 25  # of Levenberg-Marquardt; 5 to 10 are usual
_ROUGH = 2.0  # change of cost, chi-square, that ends the rounds before outliers are dropped
_SETTLED = 0.02  # the same at the end: scale lies in a flat valley, along which steps change the cost little
_ENOUGH = 3  # steps
_FLOOR = 1e-10  # variance added to inertial pieces, which may claim to be exact
_RHO_MIN, _RHO_MAX = 1e-3, 20.0  # 1/m, of the points at the start


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """The refined window, and how the observations fit."""

    aligned: Alignment
    offset_s: float  # of the camera's clock: what should be added to its stamps
    offset_sigma_s: float
    sigma_xy: float  # that the observations turned out to have
    outliers: float  # share of the observations


def refine_tracks(window: Window, tracks: Tracks, path: InertialPath, start: Start, offset_sigma_s: float) -> Bundle:
    """Return the maximum a posteriori over poses, velocities, biases, time offset and points.

    Observations that do not fit are dropped after a first convergence, and the noise of the others is measured.

    Raises:
        numpy.linalg.LinAlgError: the motion does not determine it, or the iteration does not settle.
    """
    state = _first_state(window, tracks, path, start)
    pieces = [preintegrate(s, state.gyro_bias, state.accel_bias, window.noise) for s in window.spans]
    sigma_given = tracks.sigma_xy
    used = np.ones(len(tracks.xy), dtype=np.bool_)
    problem = _Problem(window, tracks, pieces, used, offset_sigma_s)
    for _ in range(2):
        state, _ = problem.minimise(state, _ROUGH)
        residuals = problem.residuals(state)
        spread = 1.4826 * float(np.median(np.abs(residuals[used]))) * problem.tracks.sigma_xy
        # corners jump by more than they scatter; the floor keeps a lucky window from looking exact
        sigma = float(np.clip(spread, 0.2 * sigma_given, 3.0 * sigma_given))
        gate = _OUTLIER * sigma / problem.tracks.sigma_xy
        used = np.asarray(np.max(np.abs(residuals), axis=1) < gate)
        problem = _Problem(window, replace(tracks, sigma_xy=sigma), pieces, used, offset_sigma_s)
    state, system = problem.minimise(state, _SETTLED)
    return _solution(problem, state, system, used)


@dataclass(slots=True)
class _State:
    T: Array  # [N, 4, 4]
    v: Array  # [N, 3]
    gyro_bias: Array
    accel_bias: Array
    offset_s: float
    points: Array  # [P, 3]: x / z, y / z, 1 / z in the camera of the first node that sees it

    def moved(self, step: Array, points: Array) -> _State:
        nodes = len(self.T)
        d = step[: 9 * nodes].reshape(nodes, 9)
        T = self.T.copy()
        for i in range(nodes):
            T[i, :3, :3] = T[i, :3, :3] @ so3_exp(d[i, :3].copy())
        T[:, :3, 3] += d[:, 3:6]
        return _State(
            T, self.v + d[:, 6:], self.gyro_bias + step[-6:-3], self.accel_bias + step[-3:],
            self.offset_s + float(step[9 * nodes]), self.points + points,
        )  # fmt: skip


def _first_state(window: Window, tracks: Tracks, path: InertialPath, start: Start) -> _State:
    x = np.concatenate([start.velocity_m_s, start.gravity_m_s2, start.accel_bias_m_s2])
    R_world = up_to_z(start.gravity_m_s2, np.eye(3))
    nodes = len(path.rotations)
    T = np.tile(np.eye(4), (nodes, 1, 1))
    T[:, :3, :3] = R_world @ path.rotations
    T[:, :3, 3] = (path.known_m + path.unknown @ x) @ R_world.T
    v = (path.known_m_s + path.unknown_m_s @ x) @ R_world.T
    first = tracks.begin[:-1]
    R_cam = T[:, :3, :3] @ tracks.R_body_cam
    centre = T[:, :3, 3] + T[:, :3, :3] @ window.lever_m
    anchor = tracks.node[first]
    local = np.einsum("pji,pj->pi", R_cam[anchor], start.points_m @ R_world.T - centre[anchor])
    usable = local[:, 2] > 0.0
    typical = float(np.median(local[usable, 2])) if usable.any() else 1.0
    z = np.where(usable, local[:, 2], 10.0 * typical)
    points = np.column_stack([tracks.xy[first], np.clip(1.0 / z, _RHO_MIN, _RHO_MAX)])
    return _State(T, v, path.gyro_bias_rad_s.copy(), start.accel_bias_m_s2.copy(), 0.0, points)


class _Problem:
    """Least squares over one window with the observations that are used."""

    def __init__(
        self, window: Window, tracks: Tracks, pieces: Sequence[Preintegrated], used: NDArray[np.bool_], offset_s: float
    ) -> None:
        self.window, self.tracks, self.pieces, self.used = window, tracks, pieces, used
        self._offset_sigma_s = max(offset_s, 1e-6)
        self._weights = [inverse(piece.covariance + _FLOOR * np.eye(9)) for piece in pieces]
        rates = [span.gyro_rad_s[0] for span in window.spans]
        self._rates = np.array([*rates, window.spans[-1].gyro_rad_s[-1]])

    def minimise(self, state: _State, settled: float) -> tuple[_State, NormalEquations]:
        """Levenberg-Marquardt; the system returned is that of the solution, points eliminated, without damping."""
        damping, good, change = 1e-4, 0, np.inf
        system, back = self._build(state, damping)
        for _ in range(_ROUNDS):
            diagonal = np.arange(len(system.g))
            H = system.H.copy()
            H[diagonal, diagonal] *= 1.0 + damping
            step = np.asarray(np.linalg.solve(H, system.g), dtype=np.float64)
            candidate = state.moved(step, _back_substitute(back, step[: 9 * len(state.T) + 1]))
            better, better_back = self._build(candidate, damping)
            change = system.cost - better.cost
            if not change >= -1e-9 * (1.0 + system.cost):  # NaN too
                damping *= 20.0
                if damping > 1e4:
                    break
                continue
            state, system, back = candidate, better, better_back
            damping = max(0.1 * damping, 1e-9)
            good += 1
            if change <= settled:
                return state, system
        # the time offset's part of the gradient is approximate, which can end the descent early
        if good >= _ENOUGH and abs(change) < _ROUGH:
            return state, system
        raise np.linalg.LinAlgError("Levenberg-Marquardt does not settle")

    def residuals(self, state: _State) -> Array:
        """Return all whitened residuals [M, 2], used or not."""
        return self._visual(state, np.zeros(len(self.used), dtype=np.bool_), 0.0)[-1]

    def _build(self, state: _State, damping: float) -> tuple[NormalEquations, tuple[Array, Array, Array]]:
        nodes = len(state.T)
        system = NormalEquations(9 * nodes + 7)
        add_priors(system, self.window, state.T[0], state.gyro_bias, state.accel_bias)
        one = np.eye(1)
        system.add([9 * nodes], np.array([-state.offset_s]), one, one / self._offset_sigma_s**2)
        whole = (state.T, state.v, state.gyro_bias, state.accel_bias)
        for i, (piece, weight) in enumerate(zip(self.pieces, self._weights, strict=True)):
            add_inertial(system, i, piece, weight, whole, self.window.gravity_m_s2)
        H, g, cost, *back, _ = self._visual(state, self.used, damping)
        size = 9 * nodes + 1
        system.H[:size, :size] += H
        system.g[:size] += g
        system.cost += cost
        system.rows += 2 * int(self.used.sum()) - 3 * len(state.points)
        return system, (back[0], back[1], back[2])

    def _visual(
        self, state: _State, used: NDArray[np.bool_], damping: float
    ) -> tuple[Array, Array, float, Array, Array, Array, Array]:
        tracks = self.tracks
        return visual_system(
            tracks.begin, tracks.node, tracks.xy, used, 1.0 / tracks.sigma_xy, state.T, state.v,
            self._rates - state.gyro_bias, state.offset_s, state.points, tracks.R_body_cam, self.window.lever_m,
            damping,
        )  # fmt: skip


def _back_substitute(back: tuple[Array, Array, Array], step: Array) -> Array:
    inverse, head, link = back
    moved = np.einsum("pij,pj->pi", inverse, head - link @ step)
    return np.asarray(moved)


def _solution(problem: _Problem, state: _State, system: NormalEquations, used: NDArray[np.bool_]) -> Bundle:
    nodes = len(state.T)
    factor = np.linalg.cholesky(system.H)  # raises where the motion leaves something undetermined
    half = np.linalg.solve(factor, np.eye(len(factor)))
    covariance = half.T @ half
    ratio = system.cost / max(system.rows - len(system.g), 1)
    keep = np.delete(np.arange(len(system.g)), 9 * nodes)
    aligned = Alignment(
        state.T, state.v, state.gyro_bias, state.accel_bias, covariance[np.ix_(keep, keep)], float(ratio)
    )
    return Bundle(
        aligned, state.offset_s, float(np.sqrt(covariance[9 * nodes, 9 * nodes])), problem.tracks.sigma_xy,
        1.0 - float(used.mean()),
    )  # fmt: skip
