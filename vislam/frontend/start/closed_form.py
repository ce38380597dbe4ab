"""Structure and motion with inertial data from nothing, in closed form: where the least squares of the bundle begins.

One camera sees no scale; the accelerometer does, once the camera accelerates. Velocity, gravity of known norm,
accelerometer bias and points are solved from all bearings at once, with points eliminated one by one. After Dong-Si and
Mourikis, "Estimator initialization in vision-aided inertial navigation with unknown camera-IMU calibration", IROS 2012,
and Martinelli, "Closed-form solution of visual-inertial structure from motion", IJCV 2014.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.frontend.start.inertial_alignment import Window, solve_gyro_bias
from vislam.imu import preintegrate

_DEPTH_ROUNDS = 5  # a bearing's weight needs the point's distance, which the round before has found
_CAUCHY = 3.0  # scale of the kernel in the linear rounds, in medians

_MIN_COMMON = 8  # points in two nodes; fewer are fitted too well
_ASTRAY = 4.0  # standard deviations
_PLACED = 5.0  # information on a point's distance against what noise alone would show of it
_NEAR = 0.02  # of the median distance; nearer points are weighted as if there

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Bearings of points in the nodes of a window, sorted by point and then by node."""

    point: Ints  # [M], 0 .. P-1, every one at least three times
    node: Ints  # [M]
    xy: Array  # [M, 2] on the plane z = 1
    sigma_xy: float
    R_body_cam: Array  # [3, 3]
    track_ids: Ints  # [P]

    def only(self, good: NDArray[np.bool_]) -> Tracks:
        """Return those of some points [P]."""
        rows = good[self.point]
        number = np.cumsum(good) - 1
        return replace(
            self, point=number[self.point[rows]], node=self.node[rows], xy=self.xy[rows], track_ids=self.track_ids[good]
        )

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
    """The nodes by inertial data alone, in body axes of the first node, as functions of what is unknown.

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


def epipolar_noise(tracks: Tracks, rotations: Array) -> tuple[float, NDArray[np.bool_]]:
    """Return the noise of the bearings [rad] and which points [P] keep to the epipolar lines within four times that.

    `rotations` [N, 3, 3] are those of the body. The direction of motion between two nodes, a quarter of the window
    apart, is the one that the bearings contradict least for their noise, robustly; what is left over is noise. It is
    infinite where too few are seen.
    """
    nodes = len(rotations)
    apart = max(nodes // 4, 1)
    rays = np.column_stack([tracks.xy, np.ones(len(tracks.xy))])
    R_cams = rotations @ tracks.R_body_cam
    bearings = np.einsum("mij,mj->mi", R_cams[tracks.node], rays / np.linalg.norm(rays, axis=1, keepdims=True))
    at = np.full((nodes, tracks.points), -1)
    at[tracks.node, tracks.point] = np.arange(len(rays))
    errors: list[Array] = [np.empty(0)]
    points: list[Ints] = [np.empty(0, dtype=np.int64)]
    for i in range(nodes - apart):
        both = np.flatnonzero((at[i] >= 0) & (at[i + apart] >= 0))
        if len(both) >= _MIN_COMMON:
            errors.append(_epipolar_errors(bearings[at[i, both]], bearings[at[i + apart, both]]))
            points.append(both)
    every = np.concatenate(errors)
    sigma = 1.4826 * float(np.median(every)) if len(every) else float("inf")
    good = np.ones(tracks.points, dtype=np.bool_)
    good[np.concatenate(points)[every > _ASTRAY * sigma]] = False
    return sigma, good


def solve_shape(window: Window, path: InertialPath, tracks: Tracks) -> Array:
    """Return first velocity, gravity, accelerometer bias and the factor of what is known [10], up to a common scale.

    From epipolar constraints alone: those that the bearings contradict least for their noise, a generalised eigenvector
    (total least squares), which noise does not shrink and which needs no point. Its scale is that of gravity.

    Raises:
        numpy.linalg.LinAlgError: the motion does not determine them.
    """
    R_cams = path.rotations @ tracks.R_body_cam
    rays = np.column_stack([tracks.xy, np.ones(len(tracks.xy))])
    bearings = np.einsum("mij,mj->mi", R_cams[tracks.node], rays / np.linalg.norm(rays, axis=1, keepdims=True))
    apart = max(len(path.rotations) // 4, 1)
    rows, columns = np.triu_indices(len(rays), 1)
    near = (tracks.point[rows] == tracks.point[columns]) & (tracks.node[columns] - tracks.node[rows] >= apart)
    a, b = rows[near], columns[near]
    centres = np.concatenate([path.unknown, (path.known_m + path.rotations @ window.lever_m)[:, :, None]], axis=2)
    moved = centres[tracks.node[b]] - centres[tracks.node[a]]  # [K, 3, 10]
    J = np.einsum("ki,kij->kj", np.cross(bearings[a], bearings[b]), moved)
    across = [moved - v[:, :, None] * np.einsum("ki,kij->kj", v, moved)[:, None, :] for v in (bearings[a], bearings[b])]
    noise = np.concatenate(across, axis=1)  # [K, 6, 10]: its square is the variance of J in units of the bearings'
    weight = np.ones(len(a))
    y = np.zeros(10)
    for _ in range(_DEPTH_ROUNDS):
        A = (J * weight[:, None]).T @ J
        B = np.einsum("k,kij,kil->jl", weight, noise, noise)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(B), 1e-300))
        half = np.linalg.cholesky(B * np.outer(scale, scale) + 1e-9 * np.eye(10))
        inverse = np.linalg.inv(half)
        y = scale * (inverse.T @ np.linalg.eigh(inverse @ (A * np.outer(scale, scale)) @ inverse.T)[1][:, 0])
        spread = np.maximum(np.sum((noise @ y) ** 2, axis=1), 1e-300)
        errors = np.abs(J @ y) / np.sqrt(spread)
        weight = 1.0 / (1.0 + (errors / (_CAUCHY * max(float(np.median(errors)), 1e-12))) ** 2)
        weight *= float(np.median(spread)) / np.maximum(spread, 0.01 * float(np.median(spread)))
    y *= window.gravity_m_s2 / max(float(np.linalg.norm(y[3:6])), 1e-12)
    if not np.isfinite(y).all():
        raise np.linalg.LinAlgError("no shape")
    return np.asarray(y if y[9] > 0.0 else -y)


def _epipolar_errors(a: Array, b: Array) -> Array:
    """Return how far bearings a and b [N, 3] in common axes are from one plane with the motion, over its noise."""
    normals = np.cross(a, b)
    noise = 2.0 * np.eye(3) - a[:, :, None] * a[:, None, :] - b[:, :, None] * b[:, None, :]
    robust, errors = np.ones(len(a)), np.zeros(len(a))
    for _ in range(_DEPTH_ROUNDS):
        A, B = (normals * robust[:, None]).T @ normals, np.einsum("n,nij->ij", robust, noise)
        half = np.linalg.cholesky(B + 1e-9 * np.trace(B) * np.eye(3))
        inverse = np.linalg.inv(half)
        direction = inverse.T @ np.linalg.eigh(inverse @ A @ inverse.T)[1][:, 0]
        errors = np.abs(normals @ direction) / np.sqrt(np.einsum("i,nij,j->n", direction, noise, direction))
        robust = 1.0 / (1.0 + (errors / (_CAUCHY * max(float(np.median(errors)), 1e-9))) ** 2)
    return np.asarray(errors)


def solve_start(window: Window, path: InertialPath, tracks: Tracks) -> Start:
    """Return the state of the first node and the points, from bearings and inertial data alone.

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
    along, sigma = distance, tracks.sigma_xy
    bias = 2.0 * sigma * sigma
    for _ in range(_DEPTH_ROUNDS):
        weight = robust / (sigma * distance) ** 2
        while True:
            try:
                H, g, blocks, heads, links = _eliminated(
                    tracks.begin,
                    tracks.node,
                    bearings,
                    weight,
                    centres,
                    path.unknown,
                    bias,
                    _PLACED * 2.0 * sigma * sigma,
                )
                x, A, b = _with_known_norm(H + prior, g, window.gravity_m_s2)
                break
            except np.linalg.LinAlgError:
                if bias == 0.0:
                    raise
                bias = 0.0  # more noise taken off than there is
        points = np.linalg.solve(blocks, (heads + links @ x)[..., None])[..., 0]
        seen = points[tracks.point] - centres[tracks.node] - path.unknown[tracks.node] @ x
        along = np.einsum("mi,mi->m", seen, bearings)
        distance = np.maximum(np.abs(along), _NEAR * float(np.median(np.abs(along))) + 1e-6)
        across = np.sqrt(np.maximum(np.einsum("mi,mi->m", seen, seen) - along**2, 0.0)) / distance
        typical = max(float(np.median(across)), 1e-9)
        robust = 1.0 / (1.0 + (across / (_CAUCHY * typical)) ** 2)
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
        behind=float(behind.mean()),
    )


@njit(cache=True, nogil=True)
def _eliminated(
    begin: Ints, node: Ints, bearings: Array, weight: Array, centres: Array, unknown: Array, bias: float, least: float
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the normal equations over the nine unknowns, and what gives the points: blocks @ p = heads + links @ x.

    A noisy bearing b makes `I - b b^T` see a little of the distance itself, `bias` of its square, which is twice the
    variance of b, and least squares would shrink the world to make that small; it is taken off. Points of which the
    bearings constrain the distance with less than `least` of their weight are left out.
    """
    count = len(begin) - 1
    H, g = np.zeros((9, 9)), np.zeros(9)
    blocks, heads, links = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros((count, 3, 9))
    for p in range(count):
        own, own_g = np.zeros((9, 9)), np.zeros(9)
        for m in range(begin[p], begin[p + 1]):
            b, U = bearings[m], unknown[node[m]]
            across = weight[m] * (np.eye(3) - (1.0 + bias) * np.outer(b, b))
            acrossU = across @ U
            head = across @ centres[node[m]]
            blocks[p] += across
            heads[p] += head
            links[p] += acrossU
            own += U.T @ acrossU
            own_g -= U.T @ head
        lowest = np.linalg.eigvalsh(blocks[p])[0]
        total = np.sum(weight[begin[p] : begin[p + 1]])
        if lowest < least * total:
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
    scale = np.sqrt(np.maximum(np.diag(H_oo), 0.0))
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
