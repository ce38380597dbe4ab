"""Structure and motion with inertial data from nothing: a linear start, then least squares over everything.

One camera sees no scale; the accelerometer does, once the camera accelerates. The linear step solves first velocity,
gravity of known norm, accelerometer bias and points from all bearings at once (the closed form, with points
eliminated one by one); the second step refines poses, velocities, biases, the camera's time
offset and points, and its inverse Hessian says how well scale is known. After Dong-Si and Mourikis, "Estimator
initialization in vision-aided inertial navigation with unknown camera-IMU calibration", IROS 2012, and Martinelli,
"Closed-form solution of visual-inertial structure from motion", IJCV 2014.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vislam.frontend.inertial_alignment import (
    Alignment,
    NormalEquations,
    Window,
    add_inertial,
    add_priors,
    inverse,
    solve_gyro_bias,
    up_to_z,
)
from vislam.geometry import so3_exp
from vislam.imu import Preintegrated, preintegrate
from vislam.messages import Array

_DEPTH_ROUNDS = 5  # a bearing's weight needs the point's distance, which the round before has found
_CAUCHY = 3.0  # scale of the kernel in the linear rounds, in medians
_PLACED = 5.0  # information on a point's distance against what noise alone would show of it
_NEAR = 0.02  # of the median distance; nearer points are weighted as if there
_HUBER = 2.0  # standard deviations
_OUTLIER = 3.5  # standard deviations of one observation, after convergence
_ROUNDS = 25  # of Levenberg-Marquardt; 5 to 10 are usual
_ROUGH = 2.0  # change of cost, chi-square, that ends the rounds before outliers are dropped
_SETTLED = 0.02  # the same at the end: scale lies in a flat valley, along which steps change the cost little
_ENOUGH = 3  # steps
_FLOOR = 1e-10  # variance added to inertial pieces, which may claim to be exact
_RHO_MIN, _RHO_MAX = 1e-3, 20.0  # 1/m, of the points at the start

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Bearings of points in the nodes of a window, sorted by point and then by node."""

    point: Ints  # [M], 0 .. P-1, every one at least three times
    node: Ints  # [M]
    xy: Array  # [M, 2] on the plane z = 1
    sigma_xy: float
    R_body_cam: Array  # [3, 3]

    @property
    def points(self) -> int:
        """How many points there are."""
        return int(self.point[-1]) + 1 if len(self.point) else 0

    @property
    def begin(self) -> Ints:
        """Index [P + 1] of the first observation of each point, and the end."""
        return np.searchsorted(self.point, np.arange(self.points + 1)).astype(np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class InertialPath:
    """The nodes as inertial data alone tells them, in body axes of the first node, but for what is unknown.

    Position of node i: `known[i] + unknown[i] @ (first velocity, gravity, accelerometer bias)`.
    """

    rotations: Array  # [N, 3, 3]
    known_m: Array  # [N, 3]
    unknown: Array  # [N, 3, 9]
    known_m_s: Array  # [N, 3], the same for velocity
    unknown_m_s: Array  # [N, 3, 9]
    gyro_bias_rad_s: Array  # [3]
    excitation_m_s2: float  # rms change of specific force in fixed axes: what scale is seen by


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """The linear solution, in body axes of the first node."""

    gravity_m_s2: Array  # [3], of the known norm
    free_norm_m_s2: float  # the norm that the bearings ask for when it is left free
    free_norm_sigma_m_s2: float
    velocity_m_s: Array  # [3] of the first node
    accel_bias_m_s2: Array  # [3]
    points_m: Array  # [P, 3]
    behind: float  # share of the points that came out behind a camera


def inertial_path(window: Window) -> InertialPath:
    """Integrate the window's spans with the gyro bias that visual rotations ask for."""
    bias = solve_gyro_bias(window)
    nodes = len(window.spans) + 1
    R, c, d = np.tile(np.eye(3), (nodes, 1, 1)), np.zeros((nodes, 3)), np.zeros((nodes, 3))
    P, Q = np.zeros((nodes, 3, 9)), np.zeros((nodes, 3, 9))
    Q[0, :, :3] = np.eye(3)
    force, weight = np.zeros((nodes - 1, 3)), np.zeros(nodes - 1)
    for i, span in enumerate(window.spans):
        piece = preintegrate(span, bias)
        dt = piece.dt_s
        c[i + 1] = c[i] + d[i] * dt + R[i] @ piece.dp_m
        d[i + 1] = d[i] + R[i] @ piece.dv_m_s
        P[i + 1] = P[i] + Q[i] * dt
        P[i + 1, :, 3:6] += 0.5 * dt * dt * np.eye(3)
        P[i + 1, :, 6:] += R[i] @ piece.dp_daccel
        Q[i + 1] = Q[i]
        Q[i + 1, :, 3:6] += dt * np.eye(3)
        Q[i + 1, :, 6:] += R[i] @ piece.dv_daccel
        R[i + 1] = R[i] @ piece.dR
        force[i], weight[i] = R[i] @ piece.dv_m_s / dt, dt
    mean = weight @ force / weight.sum()
    excitation = np.sqrt(weight @ np.sum((force - mean) ** 2, axis=1) / weight.sum())
    return InertialPath(R, c, P, d, Q, bias, float(excitation))


def median_parallax(tracks: Tracks, rotations: Array) -> float:
    """Return the median over points of the largest displacement on z = 1 that rotation does not explain."""
    return float(_parallax(tracks.begin, tracks.node, tracks.xy, rotations @ tracks.R_body_cam))


@njit(cache=True, nogil=True)
def _parallax(begin: Ints, node: Ints, xy: Array, R_cams: Array) -> float:
    largest = np.zeros(len(begin) - 1)
    ray = np.ones(3)
    for p in range(len(largest)):
        first = begin[p]
        for m in range(first + 1, begin[p + 1]):
            ray[:2] = xy[m]
            turned = R_cams[node[first]].T @ (R_cams[node[m]] @ ray)
            if turned[2] > 0.1:
                dx, dy = turned[0] / turned[2] - xy[first, 0], turned[1] / turned[2] - xy[first, 1]
                largest[p] = max(largest[p], np.sqrt(dx * dx + dy * dy))
    return np.median(largest) if len(largest) else 0.0


def solve_start(window: Window, path: InertialPath, tracks: Tracks) -> Start:
    """Return gravity, first velocity, accelerometer bias and points by linear least squares.

    Raises:
        numpy.linalg.LinAlgError: the motion does not determine them.
    """
    R_cams = path.rotations @ tracks.R_body_cam
    centres = path.known_m + path.rotations @ window.lever_m
    rays = np.column_stack([tracks.xy, np.ones(len(tracks.xy))])
    bearings = np.einsum("mij,mj->mi", R_cams[tracks.node], rays / np.linalg.norm(rays, axis=1, keepdims=True))
    distance, robust = np.ones(len(rays)), np.ones(len(rays))
    prior = np.zeros((9, 9))
    prior[6:, 6:] = np.eye(3) / window.accel_bias_sigma_m_s2**2
    x, A, b = np.zeros(9), np.eye(3), np.zeros(3)
    points = np.zeros((len(tracks.begin) - 1, 3))
    along = distance
    for _ in range(_DEPTH_ROUNDS):
        weight = robust / (tracks.sigma_xy * distance) ** 2
        H, g, blocks, heads, links = _eliminated(
            tracks.begin, tracks.node, bearings, weight, centres, path.unknown, tracks.sigma_xy
        )
        x, A, b = _with_known_norm(H + prior, g, window.gravity_m_s2)
        points = np.linalg.solve(blocks, (heads + links @ x)[..., None])[..., 0]
        seen = points[tracks.point] - centres[tracks.node] - path.unknown[tracks.node] @ x
        along = np.einsum("mi,mi->m", seen, bearings)
        distance = np.maximum(np.abs(along), _NEAR * float(np.median(np.abs(along))) + 1e-6)
        across = np.sqrt(np.maximum(np.einsum("mi,mi->m", seen, seen) - along**2, 0.0)) / distance
        robust = 1.0 / (1.0 + (across / (_CAUCHY * max(float(np.median(across)), 1e-9))) ** 2)
    free = np.linalg.solve(A, b)
    norm = float(np.linalg.norm(free))
    down = free / max(norm, 1e-9)
    behind = np.zeros(len(points), dtype=np.bool_)
    behind[tracks.point[along <= 0.0]] = True
    return Start(
        gravity_m_s2=x[3:6].copy(),
        free_norm_m_s2=norm,
        free_norm_sigma_m_s2=float(np.sqrt(down @ np.linalg.solve(A, down))),
        velocity_m_s=x[:3].copy(),
        accel_bias_m_s2=x[6:].copy(),
        points_m=points,
        behind=float(behind.mean()),
    )


@njit(cache=True, nogil=True)
def _eliminated(
    begin: Ints, node: Ints, bearings: Array, weight: Array, centres: Array, unknown: Array, sigma: float
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the normal equations over the nine unknowns, and what gives the points: blocks @ p = heads + links @ x.

    A noisy bearing b makes `I - b b^T` see a little of the distance itself, 2 sigma^2 of its square, and least squares
    would shrink the world to make that small; it is taken off. Points too far to be placed are left out.
    """
    count = len(begin) - 1
    H, g = np.zeros((9, 9)), np.zeros(9)
    blocks, heads, links = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros((count, 3, 9))
    for p in range(count):
        own, own_g = np.zeros((9, 9)), np.zeros(9)
        for m in range(begin[p], begin[p + 1]):
            b, U = bearings[m], unknown[node[m]]
            across = weight[m] * (np.eye(3) - (1.0 + 2.0 * sigma * sigma) * np.outer(b, b))
            acrossU = across @ U
            head = across @ centres[node[m]]
            blocks[p] += across
            heads[p] += head
            links[p] += acrossU
            own += U.T @ acrossU
            own_g -= U.T @ head
        lowest = np.linalg.eigvalsh(blocks[p])[0]
        total = np.sum(weight[begin[p] : begin[p + 1]])
        if lowest < _PLACED * 2.0 * sigma * sigma * total:
            blocks[p] += (total * 1e-6 - min(lowest, 0.0)) * np.eye(3)
            continue
        inverse = np.linalg.inv(blocks[p])
        H += own - links[p].T @ inverse @ links[p]
        g += own_g + links[p].T @ inverse @ heads[p]
    return H, g, blocks, heads, links


def _with_known_norm(H: Array, g: Array, norm: float) -> tuple[Array, Array, Array]:
    """Minimise `x H x / 2 - g x` with |x[3:6]| = norm; also return the system [3, 3], [3] of x[3:6] alone."""
    others = [0, 1, 2, 6, 7, 8]
    H_oo, H_og = H[np.ix_(others, others)], H[np.ix_(others, [3, 4, 5])]
    scale = np.sqrt(np.diag(H_oo))
    if not np.all(scale > 0.0):
        raise np.linalg.LinAlgError("no observation of the velocity")
    factor = np.linalg.cholesky(H_oo / np.outer(scale, scale) + 1e-12 * np.eye(6))

    def solved(value: Array) -> Array:
        shaped = value.reshape(6, -1) / scale[:, None]
        return np.asarray(np.linalg.solve(factor.T, np.linalg.solve(factor, shaped)) / scale[:, None])

    A = H[3:6, 3:6] - H_og.T @ solved(H_og)
    A = 0.5 * (A + A.T)
    b = g[3:6] - H_og.T @ solved(g[others])[:, 0]
    values, axes = np.linalg.eigh(A)
    if not values[0] > 0.0:
        raise np.linalg.LinAlgError("gravity is not determined")
    head = axes.T @ b
    # the norm falls with the multiplier; the minimum on the sphere is the root above the lowest pole
    low, high = -values[0], max(values[2], float(np.linalg.norm(b)) / norm)
    for _ in range(200):
        middle = 0.5 * (low + high)
        if np.sum((head / (values + middle)) ** 2) > norm * norm:
            low = middle
        else:
            high = middle
    gravity = axes @ (head / (values + high))
    gravity *= norm / max(float(np.linalg.norm(gravity)), 1e-12)
    x = np.zeros(9)
    x[3:6] = gravity
    x[others] = solved(g[others] - H_og @ gravity)[:, 0]
    return x, A, b


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
        if (
            good >= _ENOUGH and abs(change) < _ROUGH
        ):  # the time offset's part of the gradient is approximate, which can end the descent early
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
        return _visual_system(
            tracks.begin, tracks.node, tracks.xy, used, 1.0 / tracks.sigma_xy, state.T, state.v,
            self._rates - state.gyro_bias, state.offset_s, state.points, tracks.R_body_cam, self.window.lever_m,
            damping,
        )  # fmt: skip


def _back_substitute(back: tuple[Array, Array, Array], step: Array) -> Array:
    inverse, head, link = back
    moved = np.einsum("pij,pj->pi", inverse, head - link @ step)
    return np.asarray(moved)


@njit(cache=True, nogil=True)
def _turned(R: Array, v: Array) -> Array:
    """Return R @ v: in a loop, which numba compiles in a fraction of the time of `@`."""
    out = np.empty(3)
    for i in range(3):
        out[i] = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]
    return out


@njit(cache=True, nogil=True)
def _turned_back(R: Array, v: Array) -> Array:
    """Return R.T @ v."""
    out = np.empty(3)
    for i in range(3):
        out[i] = R[0, i] * v[0] + R[1, i] * v[1] + R[2, i] * v[2]
    return out


@njit(cache=True, nogil=True)
def _crossed(a: Array, b: Array) -> Array:
    """Return a @ skew(b), the cross product of a and b."""
    out = np.empty(3)
    out[0], out[1], out[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return out


@njit(cache=True, nogil=True)
def _derivative(
    x: float, y: float, scale: float, rho: float, R_body_cam: Array, R_i: Array, R_a: Array, same: bool, apart: Array,
    lever: Array, body: Array, ray_body: Array, speed: Array, rate_i: Array, rate_a: Array, D: Array,
    J_i: Array, J_a: Array, J_t: Array, J_point: Array,
) -> None:  # fmt: skip
    """Write the derivative of a pixel by its node, the anchor, the time offset and the point; D [3] is scratch.

    `apart` and `speed` are the anchor's position and velocity less the node's; `same`: the node is the anchor.
    """
    J_i[:] = 0.0
    J_a[:] = 0.0
    J_t[:] = 0.0
    for row in range(2):
        D[0], D[1] = (scale, 0.0) if row == 0 else (0.0, scale)
        D[2] = -scale * (x if row == 0 else y)
        D_body = _turned(R_body_cam, D)
        D_world = _turned(R_i, D_body)
        D_anchor = _turned_back(R_a, D_world)
        by_ray = _turned_back(R_body_cam, D_anchor)
        J_point[row, 0], J_point[row, 1], J_point[row, 2] = by_ray[0], by_ray[1], 0.0
        for c in range(3):
            J_point[row, 2] += D_anchor[c] * lever[c] + D_world[c] * apart[c] - D_body[c] * lever[c]
        if same:
            continue
        by_turn, by_anchor = _crossed(D_body, body), _crossed(D_anchor, ray_body)
        for c in range(3):
            J_i[row, c], J_i[row, 3 + c] = by_turn[c], -rho * D_world[c]
            J_a[row, c], J_a[row, 3 + c] = -by_anchor[c], rho * D_world[c]
            J_t[row] += by_turn[c] * rate_i[c] - by_anchor[c] * rate_a[c]
            J_t[row] += rho * D_world[c] * speed[c]


@njit(cache=True, nogil=True)
def _visual_system(
    begin: Ints,
    node: Ints,
    xy: Array,
    used: NDArray[np.bool_],
    weight: float,
    T: Array,
    v: Array,
    rates: Array,
    offset_s: float,
    points: Array,
    R_body_cam: Array,
    lever: Array,
    damping: float,
) -> tuple[Array, Array, float, Array, Array, Array, Array]:
    """Return the visual part with points eliminated: H, g over nodes [9 each] and time offset; cost; what gives points.

    A camera's pose is that of its node carried on by `offset_s` with the node's velocity and rate. Residuals are
    measured minus predicted, whitened, with Huber's weight.
    """
    nodes, count = len(T), len(points)
    size = 9 * nodes + 1
    H, g, cost = np.zeros((size, size)), np.zeros(size), 0.0
    inverses, heads, links = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros((count, 3, size))
    residuals = np.full((len(node), 2), 1e6)
    R, p = _carried_on(T, v, rates, offset_s)
    toward, apart, speed, D, J_point = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty((2, 3))
    J_i, J_a, J_t = np.empty((2, 6)), np.empty((2, 6)), np.empty(2)
    for k in range(count):
        a = node[begin[k]]
        rho = points[k, 2]
        # the point times its inverse depth, so that far points stay finite
        ray_body = _turned(R_body_cam, np.array([points[k, 0], points[k, 1], 1.0]))
        for c in range(3):
            ray_body[c] += rho * lever[c]
        ray_world = _turned(R[a], ray_body)
        block, head = np.zeros((3, 3)), np.zeros(3)
        for m in range(begin[k], begin[k + 1]):
            i = node[m]
            for c in range(3):
                apart[c], speed[c] = p[a, c] - p[i, c], v[a, c] - v[i, c]
                toward[c] = ray_world[c] + rho * apart[c]
            body = _turned_back(R[i], toward)
            for c in range(3):
                toward[c] = body[c] - rho * lever[c]
            cam = _turned_back(R_body_cam, toward)
            if cam[2] <= 1e-3:
                cost += 1e3 * used[m]
                continue
            x, y = cam[0] / cam[2], cam[1] / cam[2]
            r0, r1 = weight * (xy[m, 0] - x), weight * (xy[m, 1] - y)
            residuals[m, 0], residuals[m, 1] = r0, r1
            if not used[m]:
                continue
            norm = np.sqrt(r0 * r0 + r1 * r1)
            robust = 1.0 if norm <= _HUBER else _HUBER / norm
            cost += norm * norm if norm <= _HUBER else 2.0 * _HUBER * norm - _HUBER * _HUBER
            _derivative(
                x, y, weight / cam[2], rho, R_body_cam, R[i], R[a], i == a, apart, lever, body, ray_body,
                speed, rates[i], rates[a], D, J_i, J_a, J_t, J_point,
            )  # fmt: skip
            _add_rows(H, g, links[k], block, head, 9 * i, 9 * a, size - 1, J_i, J_a, J_t, J_point, r0, r1, robust)
        for c in range(3):
            block[c, c] += 1e-9 + damping * block[c, c]
        inverses[k] = np.linalg.inv(block)
        heads[k] = head
        _eliminate(H, g, links[k], inverses[k], head, node[begin[k] : begin[k + 1]], a)
    for c in range(size):
        for e in range(c):
            H[e, c] = H[c, e]
    return H, g, cost, inverses, heads, links, residuals


@njit(cache=True, nogil=True)
def _carried_on(T: Array, v: Array, rates: Array, offset_s: float) -> tuple[Array, Array]:
    """Return attitudes [N, 3, 3] and positions [N, 3] a moment after those of the nodes."""
    R, p = np.zeros((len(T), 3, 3)), np.zeros((len(T), 3))
    w = np.empty(3)
    for i in range(len(T)):
        for c in range(3):
            w[c] = rates[i, c] * offset_s
            p[i, c] = T[i, c, 3] + v[i, c] * offset_s
        turn = so3_exp(w)
        for c in range(3):
            for d in range(3):
                R[i, c, d] = T[i, c, 0] * turn[0, d] + T[i, c, 1] * turn[1, d] + T[i, c, 2] * turn[2, d]
    return R, p


@njit(cache=True, nogil=True)
def _add_rows(
    H: Array, g: Array, link: Array, block: Array, head: Array, ci: int, ca: int, ct: int,
    J_i: Array, J_a: Array, J_t: Array, J_point: Array, r0: float, r1: float, robust: float,
) -> None:  # fmt: skip
    """Add two whitened rows: columns ci.. of their node, ca.. of the anchor, ct of the time offset, and the point."""
    J, columns = np.empty((2, 13)), np.empty(13, dtype=np.int64)
    for c in range(6):
        columns[c], columns[6 + c] = ci + c, ca + c
        for row in range(2):
            J[row, c], J[row, 6 + c], J[row, 12] = J_i[row, c], J_a[row, c], J_t[row]
    columns[12] = ct
    start = 12 if ci == ca else 0
    for row in range(2):
        r = r0 if row == 0 else r1
        for c in range(start, 13):
            value = robust * J[row, c]
            if value == 0.0:
                continue
            g[columns[c]] += value * r
            for e in range(start, 13):
                H[columns[c], columns[e]] += value * J[row, e]
            for e in range(3):
                link[e, columns[c]] += value * J_point[row, e]
        for c in range(3):
            head[c] += robust * J_point[row, c] * r
            for e in range(3):
                block[c, e] += robust * J_point[row, c] * J_point[row, e]


@njit(cache=True, nogil=True)
def _eliminate(H: Array, g: Array, link: Array, inverse: Array, head: Array, seen_by: Ints, anchor: int) -> None:
    """Take the point out of the system's lower triangle: columns of nodes that see it, and the time offset."""
    count = len(seen_by)
    columns = np.empty(6 * count + 1, dtype=np.int64)
    for n in range(count):
        for c in range(6):
            columns[6 * n + c] = 9 * seen_by[n] + c
    columns[6 * count] = len(g) - 1
    through = np.empty((3, len(columns)))
    for c in range(len(columns)):
        for e in range(3):
            through[e, c] = (
                inverse[e, 0] * link[0, columns[c]]
                + inverse[e, 1] * link[1, columns[c]]
                + inverse[e, 2] * link[2, columns[c]]
            )
    for c in range(len(columns)):
        row = columns[c]
        l0, l1, l2 = link[0, row], link[1, row], link[2, row]
        g[row] -= through[0, c] * head[0] + through[1, c] * head[1] + through[2, c] * head[2]
        for e in range(c + 1):  # columns ascend: the lower triangle
            H[row, columns[e]] -= l0 * through[0, e] + l1 * through[1, e] + l2 * through[2, e]


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
