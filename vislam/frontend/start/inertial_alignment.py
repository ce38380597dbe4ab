"""Aligning a short visual motion with inertial data: gravity, velocities, biases, and scale where vision has none.

Three steps. Gyro bias from rotations; gravity, velocities and positions from one linear system, gravity left free so
that its norm can be checked; then all of it together by Gauss-Newton with gravity on its sphere, which also gives the
covariance. After Martinelli, "Closed-form solution of visual-inertial structure from motion", IJCV 2014, and Qin and
Shen, "Robust initialization of monocular visual-inertial estimation", IROS 2017; here positions stay unknowns instead
of scales, so that metric motion, directions and pure rotations enter the same system.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vislam.core.geometry import (
    level_rotation,
    skew,
    so3_exp,
    so3_left_jacobian_inverse,
    so3_log,
    so3_right_jacobian_inverse,
    tangent_basis,
)
from vislam.core.messages import Array, ImuSpan
from vislam.imu import ImuNoise, Preintegrated, preintegrate
from vislam.vision.relative_motion import camera_displacement, direction_noise, direction_residual, metric_residual

_FLOOR = 1e-10  # variance, rad^2 and m^2, of a motion that claims to be exact
_GAUGE = 1e-5  # sigma, rad and m: first position and heading are chosen, not measured
_FIRST_M = 0.1  # taken for the length of every direction in the first round
_SHORT_M = 0.02  # a direction over less than this is weighted as if over this
_LINEAR_ROUNDS = 4  # a direction's weight needs the distance, which the round before has found
_ROUNDS = 12  # of Gauss-Newton; 4 to 6 are usual
_CONVERGED = 1e-6  # largest step, in sigmas it would be far less


@dataclass(frozen=True, slots=True, eq=False)
class VisualMotion:
    """A visual motion between two nodes of the window, as in `VoMeasurement`; covariance already inflated."""

    a: int
    b: int
    T_a_b: Array  # [4, 4]; without scale the translation is the unit direction of the camera, zero: no parallax
    covariance: Array  # [6, 6]
    has_scale: bool

    @property
    def has_direction(self) -> bool:
        """Whether the translation is a unit direction."""
        return not self.has_scale and float(np.linalg.norm(self.T_a_b[:3, 3])) > 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """What is aligned: nodes in time, inertial spans between neighbours, visual motions among them."""

    spans: Sequence[ImuSpan]  # [N-1], span i leads from node i to i+1
    motions: Sequence[VisualMotion]  # at least one reaches every node from an earlier one
    rotations: Array  # [N, 3, 3] of the nodes by vision, in one frame
    noise: ImuNoise  # white noise already inflated
    gravity_m_s2: float
    lever_m: Array  # [3], camera in the body frame
    gyro_bias_sigma_rad_s: float
    accel_bias_sigma_m_s2: float


@dataclass(frozen=True, slots=True, eq=False)
class LinearSolution:
    """The window by linear least squares, in the visual frame (that of `Window.rotations`), first node at zero."""

    gyro_bias_rad_s: Array  # [3]
    accel_bias_m_s2: Array  # [3]
    gravity_m_s2: Array  # [3], pointing down, norm not constrained
    gravity_norm_sigma_m_s2: float
    positions_m: Array  # [N, 3]
    velocities_m_s: Array  # [N, 3]


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The window by maximum a posteriori, in a world with z up whose origin and heading are those of the first node."""

    T_world_body: Array  # [N, 4, 4]
    velocities_m_s: Array  # [N, 3]
    gyro_bias_rad_s: Array  # [3]
    accel_bias_m_s2: Array  # [3]
    covariance: Array  # [9 N + 6, 9 N + 6]: per node rotation (body), position, velocity (world); gyro bias; accel bias
    residual_ratio: float  # chi-square per degree of freedom

    def state_covariance(self, node: int) -> Array:
        """Return the covariance [15, 15] of one node in the order of `NavState`."""
        nodes = len(self.T_world_body)
        rows = np.concatenate([np.arange(9 * node, 9 * node + 9), np.arange(9 * nodes, 9 * nodes + 6)])
        return self.covariance[np.ix_(rows, rows)]

    def scale_sigma(self) -> float:
        """Return the relative uncertainty of the longest displacement from the first node."""
        from_first = self.T_world_body[:, :3, 3] - self.T_world_body[0, :3, 3]
        distances = np.linalg.norm(from_first, axis=1)
        far = int(np.argmax(distances))
        if distances[far] < 1e-6:
            return float("inf")
        direction = from_first[far] / distances[far]
        P = self.covariance[9 * far + 3 : 9 * far + 6, 9 * far + 3 : 9 * far + 6]
        return float(np.sqrt(direction @ P @ direction) / distances[far])


def solve_gyro_bias(window: Window) -> Array:
    """Return the gyro bias [3] in rad/s that makes inertial rotations between neighbours agree with visual ones."""
    bias = np.zeros(3)
    for _ in range(2):  # integrated again once: the first guess, zero, can be far off
        pieces = [preintegrate(span, bias) for span in window.spans]
        for _ in range(2):
            A, b = np.eye(3) * 1e-9, np.zeros(3)
            for i, piece in enumerate(pieces):
                dR, _, _ = piece.corrected(bias, piece.accel_bias_m_s2)
                error = so3_log(dR.T @ window.rotations[i].T @ window.rotations[i + 1])
                J = so3_left_jacobian_inverse(error) @ piece.dR_dgyro
                A += J.T @ J
                b += J.T @ error
            bias = bias + np.linalg.solve(A, b)
    return bias


def solve_linear(window: Window) -> LinearSolution:
    """Return gravity, velocities, positions and accelerometer bias given visual rotations.

    Raises:
        numpy.linalg.LinAlgError: the motion does not determine them.
    """
    gyro_bias = solve_gyro_bias(window)
    pieces = [preintegrate(span, gyro_bias, noise=window.noise) for span in window.spans]
    nodes = len(window.rotations)
    displacements = np.array([motion.T_a_b[:3, 3] * _FIRST_M for motion in window.motions])
    solution = np.zeros(6 + 6 * nodes)
    covariance = np.zeros((6, 6))
    for _ in range(_LINEAR_ROUNDS if any(motion.has_direction for motion in window.motions) else 1):
        H, g = _linear_system(window, pieces, displacements)
        factor = np.linalg.cholesky(H)
        solution = np.linalg.solve(factor.T, np.linalg.solve(factor, g))
        half = np.linalg.solve(factor, np.eye(len(H))[:, :6])
        covariance = half.T @ half
        displacements = _displacements(window, solution[6:].reshape(nodes, 6)[:, :3])
    gravity = solution[:3]
    down = gravity / max(float(np.linalg.norm(gravity)), 1e-9)
    states = solution[6:].reshape(nodes, 6)
    return LinearSolution(
        gyro_bias_rad_s=gyro_bias,
        accel_bias_m_s2=solution[3:6].copy(),
        gravity_m_s2=gravity.copy(),
        gravity_norm_sigma_m_s2=float(np.sqrt(down @ covariance[:3, :3] @ down)),
        positions_m=states[:, :3].copy(),
        velocities_m_s=states[:, 3:].copy(),
    )


def excitation(window: Window) -> float:
    """Return the rms change of specific force over the window in m/s^2, in fixed axes: what scale is seen by."""
    pieces = [preintegrate(span) for span in window.spans]
    force = np.array([R @ piece.dv_m_s / piece.dt_s for R, piece in zip(window.rotations[:-1], pieces, strict=True)])
    return float(np.sqrt(np.mean(np.sum((force - force.mean(axis=0)) ** 2, axis=1))))


def _displacements(window: Window, positions: Array) -> Array:
    """Return the camera's displacement [M, 3] of every motion in body axes of its first node."""
    R = window.rotations
    return np.array(
        [
            R[m.a].T @ (positions[m.b] - positions[m.a] + R[m.b] @ window.lever_m) - window.lever_m
            for m in window.motions
        ]
    )


def _linear_system(window: Window, pieces: Sequence[Preintegrated], displacements: Array) -> tuple[Array, Array]:
    """Return the normal equations over gravity, accel bias, then position and velocity of each node.

    Directions are linearised at `displacements` [M, 3] of the round before, as in `direction_residual`.
    """
    nodes = len(window.rotations)
    H, g = np.zeros((6 + 6 * nodes, 6 + 6 * nodes)), np.zeros(6 + 6 * nodes)

    def add(columns: Sequence[int], J: Array, value: Array, covariance: Array) -> None:
        weighted = np.linalg.solve(covariance, J)
        H[np.ix_(columns, columns)] += J.T @ weighted
        g[list(columns)] += weighted.T @ value

    identity = np.eye(3)
    for i, piece in enumerate(pieces):
        R, dt = window.rotations[i], piece.dt_s
        J = np.zeros((6, 18))  # gravity, accel bias, p and v of i, p and v of i + 1; rows velocity, position
        J[:3, :3], J[3:, :3] = -dt * identity, -0.5 * dt * dt * identity
        J[:3, 3:6], J[3:, 3:6] = -R @ piece.dv_daccel, -R @ piece.dp_daccel
        J[:3, 9:12], J[:3, 15:18] = -identity, identity
        J[3:, 6:9], J[3:, 9:12], J[3:, 12:15] = -identity, -dt * identity, identity
        value = np.concatenate([R @ piece.dv_m_s, R @ piece.dp_m])
        turn = np.kron(np.eye(2), R)
        covariance = turn @ piece.covariance[3:, 3:] @ turn.T + _FLOOR * np.eye(6)
        add([*range(6), *range(6 + 6 * i, 18 + 6 * i)], J, value, covariance)
    for motion, displacement in zip(window.motions, displacements, strict=True):
        columns = [*range(6 + 6 * motion.a, 9 + 6 * motion.a), *range(6 + 6 * motion.b, 9 + 6 * motion.b)]
        R_a, R_b = window.rotations[motion.a], window.rotations[motion.b]
        R_a_b, t = motion.T_a_b[:3, :3], motion.T_a_b[:3, 3]
        if motion.has_scale:
            covariance = R_a_b @ motion.covariance[3:, 3:] @ R_a_b.T + _FLOOR * identity
            add(columns, np.hstack([-R_a.T, R_a.T]), t, covariance)
        elif motion.has_direction:
            distance = max(float(np.linalg.norm(displacement)), _SHORT_M)
            opposite = float(displacement @ t) <= 0.0  # a bad round; start again from what was seen
            axes = tangent_basis(t.copy() if opposite else displacement / np.linalg.norm(displacement))
            lever = R_a.T @ R_b @ window.lever_m - window.lever_m
            covariance = direction_noise(motion.T_a_b, motion.covariance, axes, distance)[3:, 3:] + _FLOOR * np.eye(2)
            value = axes.T @ (np.linalg.norm(displacement) * t - lever)
            add(columns, np.hstack([-axes.T @ R_a.T, axes.T @ R_a.T]), value, covariance)
    add(range(3, 6), identity, np.zeros(3), identity * window.accel_bias_sigma_m_s2**2)
    add(range(6, 9), identity, np.zeros(3), identity * _GAUGE**2)
    return H, g


def refine(window: Window, start: LinearSolution) -> Alignment:
    """Return the maximum a posteriori of the window with gravity of known norm, and its covariance.

    Raises:
        numpy.linalg.LinAlgError: the motion does not determine it, or the iteration does not settle.
    """
    nodes = len(window.rotations)
    R_world_visual = up_to_z(start.gravity_m_s2, window.rotations[0])
    T = np.tile(np.eye(4), (nodes, 1, 1))
    T[:, :3, :3] = R_world_visual @ window.rotations
    T[:, :3, 3] = (start.positions_m - start.positions_m[0]) @ R_world_visual.T
    v = start.velocities_m_s @ R_world_visual.T
    gyro_bias, accel_bias = start.gyro_bias_rad_s.copy(), start.accel_bias_m_s2.copy()
    pieces = [preintegrate(span, gyro_bias, accel_bias, window.noise) for span in window.spans]
    weights = [inverse(piece.covariance + _FLOOR * np.eye(9)) for piece in pieces]
    cost = np.inf
    for _ in range(_ROUNDS):
        system = NormalEquations(9 * nodes + 6)
        add_priors(system, window, T[0], gyro_bias, accel_bias)
        for i, (piece, weight) in enumerate(zip(pieces, weights, strict=True)):
            add_inertial(system, i, piece, weight, (T, v, gyro_bias, accel_bias), window.gravity_m_s2)
        _add_visual(system, window, T)
        step = np.linalg.solve(system.H, system.g)
        d = step[: 9 * nodes].reshape(nodes, 9)
        for i in range(nodes):
            T[i, :3, :3] = T[i, :3, :3] @ so3_exp(d[i, :3])
        T[:, :3, 3] += d[:, 3:6]
        v = v + d[:, 6:]
        gyro_bias = gyro_bias + step[-6:-3]
        accel_bias = accel_bias + step[-3:]
        settled = abs(cost - system.cost) <= 1e-4 * (1.0 + system.cost) or float(np.abs(step).max()) < _CONVERGED
        cost = system.cost
        if settled:
            break
    else:
        raise np.linalg.LinAlgError("Gauss-Newton does not settle")
    factor = np.linalg.cholesky(system.H)  # raises where the motion leaves something undetermined
    half = np.linalg.solve(factor, np.eye(len(factor)))
    ratio = cost / max(system.rows - len(system.g), 1)
    return Alignment(T, v, gyro_bias, accel_bias, half.T @ half, float(ratio))


def inverse(covariance: Array) -> Array:
    """Return the inverse of a matrix, typed."""
    return np.asarray(np.linalg.inv(covariance), dtype=np.float64)


def up_to_z(gravity: Array, R_visual_body: Array) -> Array:
    """Return R_world_visual that puts gravity down and gives the first body zero heading."""
    up_body = -(R_visual_body.T @ gravity)
    return level_rotation(up_body) @ R_visual_body.T


class NormalEquations:
    """Sums `J^T W J` and `J^T W r`: first the nodes' errors [9 each], last the biases [6]."""

    def __init__(self, size: int) -> None:
        """Start from zero over `size` unknowns."""
        self.H = np.zeros((size, size))
        self.g = np.zeros(size)
        self.cost = 0.0
        self.rows = 0

    def add(self, columns: Sequence[int], residual: Array, J: Array, weight: Array) -> None:
        """Add a residual with `residual(x + d) = residual - J @ d` and the inverse of its covariance."""
        weighted = weight @ J
        self.H[np.ix_(columns, columns)] += J.T @ weighted
        self.g[list(columns)] += weighted.T @ residual
        self.cost += float(residual @ weight @ residual)
        self.rows += len(residual)


def add_priors(system: NormalEquations, window: Window, T_first: Array, gyro_bias: Array, accel_bias: Array) -> None:
    """Fix what is chosen, first position and heading, and add what is known of the biases [3]."""
    size = len(system.g)
    heading = T_first[2:3, :3]  # body-side rotation about the world's z
    system.add(range(3), np.zeros(1), heading, np.eye(1) / _GAUGE**2)
    system.add(range(3, 6), -T_first[:3, 3], np.eye(3), np.eye(3) / _GAUGE**2)
    sigmas = np.repeat([window.gyro_bias_sigma_rad_s, window.accel_bias_sigma_m_s2], 3)
    system.add(range(size - 6, size), -np.concatenate([gyro_bias, accel_bias]), np.eye(6), np.diag(1.0 / sigmas**2))


def add_inertial(
    system: NormalEquations,
    i: int,
    piece: Preintegrated,
    weight: Array,
    state: tuple[Array, Array, Array, Array],
    gravity_m_s2: float,
) -> None:
    """Add the inertial piece from node i to i + 1, at poses, velocities, gyro bias and accel bias `state`."""
    T, v, gyro_bias, accel_bias = state
    size = len(system.g)
    gravity = np.array([0.0, 0.0, -gravity_m_s2])
    dR, dv, dp = piece.corrected(gyro_bias, accel_bias)
    R0, R1, dt = T[i, :3, :3], T[i + 1, :3, :3], piece.dt_s
    rotation = so3_log(R1.T @ R0 @ dR)
    velocity = R0.T @ (v[i + 1] - v[i] - gravity * dt)
    position = R0.T @ (T[i + 1, :3, 3] - T[i, :3, 3] - v[i] * dt - 0.5 * gravity * dt * dt)
    residual = np.concatenate([rotation, dv - velocity, dp - position])
    J = np.zeros((9, 24))  # of what the states predict: node i, node i + 1, gyro bias, accel bias
    right = so3_right_jacobian_inverse(rotation)
    J[:3, :3] = -right @ dR.T
    J[:3, 9:12] = so3_left_jacobian_inverse(rotation)
    J[:3, 18:21] = -right @ piece.dR_dgyro
    J[3:6, :3], J[6:, :3] = skew(velocity), skew(position)
    J[3:6, 6:9], J[3:6, 15:18] = -R0.T, R0.T
    J[6:, 3:6], J[6:, 6:9], J[6:, 12:15] = -R0.T, -dt * R0.T, R0.T
    J[3:6, 18:21], J[3:6, 21:] = -piece.dv_dgyro, -piece.dv_daccel
    J[6:, 18:21], J[6:, 21:] = -piece.dp_dgyro, -piece.dp_daccel
    columns = [*range(9 * i, 9 * i + 18), *range(size - 6, size)]
    system.add(columns, residual, J, weight)


def _add_visual(system: NormalEquations, window: Window, T: Array) -> None:
    for motion in window.motions:
        T_a, T_b = T[motion.a], T[motion.b]
        columns = [*range(9 * motion.a, 9 * motion.a + 6), *range(9 * motion.b, 9 * motion.b + 6)]
        if motion.has_direction:
            residual, J_a, J_b, axes, _ = direction_residual(T_a, T_b, motion.T_a_b, window.lever_m)
            distance = float(np.linalg.norm(camera_displacement(T_a, T_b, window.lever_m)))
            covariance = direction_noise(motion.T_a_b, motion.covariance, axes, max(distance, _SHORT_M))
            rows = 5
        else:
            residual, J_a, J_b = metric_residual(T_a, T_b, motion.T_a_b)
            covariance = motion.covariance
            rows = 6 if motion.has_scale else 3
        J = np.hstack([J_a, J_b])[:rows]
        weight = np.linalg.inv(covariance[:rows, :rows] + _FLOOR * np.eye(rows))
        system.add(columns, residual[:rows], J, weight)
