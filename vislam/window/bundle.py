"""Batch optimisation on the window's kernels: arrays in, arrays out, no marginalisation.

For the start of a run, where a few seconds of frames have to give scale, velocity, gravity's direction and biases at
once: the states lie in a gravity-aligned frame whose yaw and origin are free, so that roll and pitch of the first state
are gravity's direction.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.config import WindowConfig
from vislam.core.camera import Rig
from vislam.core.geometry import so3_exp
from vislam.core.messages import Array, Observations
from vislam.imu import ImuNoise, Preintegrated
from vislam.window.calibration import Calibration, optics_of
from vislam.window.doubt import spreads
from vislam.window.equations import (
    CALIBRATION,
    STATE,
    Camera,
    Links,
    Prior,
    Problem,
    Room,
    Solution,
    Views,
    inertial,
    joint_covariance,
    optimise,
    visual,
)
from vislam.window.posterior import GAUGE_SIGMA_M, GAUGE_SIGMA_RAD, pose, scale_sigma
from vislam.window.spans import information, jacobian_by_imu
from vislam.window.tracks import RHO_START, TrackTable

_ROUGH, _TOLERANCE = 1e-4, 1e-6  # relative decrease of the cost; the first until the pixels' noise is known
_OUTLIER = 3.5  # standard deviations of a coordinate, by the length of the error
_SCALE_ROUNDS = 2  # tilt is linearised
_FAR_OFF = 5.0  # factor of scale beyond which the shape is no good


@dataclass(frozen=True, slots=True, eq=False)
class BundleProblem:
    """Frames in time order with what ties them together; the covariances of the spans are used as they are."""

    T_world_body: Array  # [M, 4, 4] start, gravity along -z of the world
    velocity_world_m_s: Array  # [M, 3] start
    gyro_bias_rad_s: Array  # [3] start, and mean of its prior
    accel_bias_m_s2: Array  # [3] start, and mean of its prior
    observations: Sequence[Observations]  # [M]
    spans: Sequence[Preintegrated]  # [M - 1]
    gyro_bias_sigma_rad_s: float
    accel_bias_sigma_m_s2: float
    rate_rad_s: Array | None = None  # [M, 3] of the body; only a time offset needs it
    time_offset_sigma_s: float = 0.0  # prior of what the camera's stamps lack; 0: they are exact
    inflation: float = 1.0  # on the pixels' sigma that is measured: errors of a track are correlated in time


@dataclass(frozen=True, slots=True, eq=False)
class BundleSolution:
    """States with their joint covariance; `converged` is False when the equations had no solution."""

    T_world_body: Array  # [M, 4, 4]
    velocity_world_m_s: Array  # [M, 3]
    gyro_bias_rad_s: Array  # [M, 3]
    accel_bias_m_s2: Array  # [M, 3]
    first_covariance: Array  # [15, 15] of frame 0, in the order of NavState; its position and yaw are the gauge
    last_covariance: Array  # [15, 15] of frame M - 1
    scale_sigma: float  # relative, of all displacements together
    time_offset_s: float  # to be added to the camera's stamps
    time_offset_sigma_s: float
    reprojection_px: float  # median error of an observation in units of sigma_px
    sigma_px: float  # that the observations turned out to have
    outliers: float  # share of the observations that do not fit
    inertial_ratio: float  # chi-square of the spans and biases per row; below 1 where their noise is as modelled
    views: int
    iterations: int
    converged: bool


def solve(
    problem: BundleProblem,
    config: WindowConfig,
    rig: Rig,
    noise: ImuNoise,
    gravity_m_s2: float,
    max_iterations: int = 30,
) -> BundleSolution:
    """Optimise poses, velocities, biases, landmarks and the time offset of a few frames to convergence.

    The extrinsic rotation of the first camera is held; errors of focal length, baseline and the IMU's axes are states.
    Position and yaw of frame 0 are fixed to the gauge's sigmas of `config`. After a first convergence the noise of the
    pixels is measured, in place of `config.sigma_px`, and what does not fit is left out.

    Raises:
        ValueError: fewer than two frames, or lists whose lengths do not fit.
    """
    count = len(problem.T_world_body)
    if count < 2 or len(problem.observations) != count or len(problem.spans) != count - 1:
        raise ValueError(
            f"a bundle needs M >= 2 frames, M observations and M - 1 spans; got {count}, {len(problem.observations)} "
            f"and {len(problem.spans)}"
        )
    ids = np.arange(count, dtype=np.int64)
    tracks = TrackTable(config, rig)
    for k, seen in enumerate(problem.observations):
        tracks.add(k, seen)
    selection = tracks.select(ids)
    total = max(len(selection.rows), 1)
    calibration, sigmas = _calibration(problem, config, rig, noise)
    camera = _camera(problem, config, rig, sigmas > 0.0)
    X = _states(problem)
    held = np.zeros(count, dtype=np.bool_)
    links, gauge, room = _links(problem, noise), _gauge(problem, sigmas), Room()
    sigma, whitening, iterations = 1.0, 1.0, 0
    for tolerance in (_ROUGH, _ROUGH, _TOLERANCE):
        views = _whitened_by(selection.views, whitening)
        _rescale(X, links, rig.T_body_cams[0][:3, 3], problem.accel_bias_sigma_m_s2, gravity_m_s2)
        points = np.zeros((len(selection.slots), 3))
        visual.start(X, calibration, views, camera, np.ones(len(points), dtype=np.bool_), RHO_START, points)
        solution = optimise(
            Problem(X, X.copy(), held, points, calibration, views, camera, links, gauge, gravity_m_s2, True),
            max_iterations,
            tolerance,
            room,
        )
        iterations += solution.iterations
        if not solution.ok or tolerance == _TOLERANCE:
            break
        X, calibration = solution.X.copy(), solution.calibration
        errors = np.sqrt(solution.squares[:, 0]) * whitening
        scatter = spreads(solution, selection.views, len(rig.cameras)) * whitening
        sigma = float(scatter[0])
        whitening = sigma * problem.inflation
        tracks.remove_rows(selection.rows[errors > _OUTLIER * scatter[selection.views.camera]])
        selection = tracks.select(ids)
    return replace(
        _solution(problem, solution, links, gravity_m_s2),
        sigma_px=sigma * config.sigma_px,
        outliers=1.0 - len(selection.rows) / total,
        iterations=iterations,
        converged=solution.ok and solution.iterations < max_iterations,
    )


def _calibration(problem: BundleProblem, config: WindowConfig, rig: Rig, noise: ImuNoise) -> tuple[Array, Array]:
    """Return the calibration [16] to begin with and the sigmas [16] of what is estimated of it, 0 for what is held."""
    known = Calibration(config, rig, noise, 0.0)
    known.see(problem.observations[-1])
    known.start_sigmas[:5] = 0.0 if problem.rate_rad_s is None else problem.time_offset_sigma_s, 0.0, 0.0, 0.0, 0.0
    return known.values, known.start_sigmas


def _camera(problem: BundleProblem, config: WindowConfig, rig: Rig, active: NDArray[np.bool_]) -> Camera:
    count = len(problem.T_world_body)
    return Camera(
        rig.T_body_cams[0],
        *optics_of(rig),
        rate=np.zeros((count, 3)) if problem.rate_rad_s is None else problem.rate_rad_s,
        applied_offset_s=np.zeros(count),
        active=active,
        huber_k=np.full(len(rig.cameras) + 1, config.huber_k),
        rho_information=config.rho_sigma_1_m**-2,
    )


def _rescale(X: Array, links: Links, lever_m: Array, accel_bias_sigma_m_s2: float, gravity_m_s2: float) -> None:
    """Move the states X [M, 21] to the scale, tilt, velocities and accelerometer bias that the IMU gives their shape.

    What the camera sees does not change: its path is scaled and turned as a whole. Scale lies in a valley that bends,
    along which Gauss-Newton goes in small steps; this goes all the way, for given the shape the problem is linear.
    """
    count, at_bias = len(X), 3
    walked = [np.linalg.inv(np.linalg.inv(W)[3:, 3:]) for W in links.information]
    for _ in range(_SCALE_ROUNDS):
        R = X[:, :9].reshape(-1, 3, 3)
        levers = R @ lever_m
        centres = X[:, 9:12] + levers
        shape = centres - centres[0]
        H, b = np.zeros((6 + 3 * count,) * 2), np.zeros(6 + 3 * count)
        H[at_bias:6, at_bias:6] = np.eye(3) / accel_bias_sigma_m_s2**2
        H[1:3, 1:3] = 1e-6 * np.eye(2)
        by_tilt = gravity_m_s2 * np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, 0.0]])
        down = np.array([0.0, 0.0, -gravity_m_s2])
        for k in range(count - 1):
            dt, turn = links.dt[k], R[k].T
            J, at = np.zeros((6, 12)), np.r_[0:6, 6 + 3 * k : 12 + 3 * k]  # scale, tilt, bias, velocities
            J[3:, 0] = turn @ (shape[k + 1] - shape[k])
            J[:3, 1:3], J[3:, 1:3] = turn @ by_tilt * -dt, turn @ by_tilt * (-0.5 * dt * dt)
            J[:, 3:6] = -links.by_imu[k, 3:, 3:6]
            J[:3, 6:9], J[:3, 9:12], J[3:, 6:9] = -turn, turn, -turn * dt
            known = np.concatenate([
                links.dv[k] + turn @ down * dt,
                links.dp[k] + turn @ (down * (0.5 * dt * dt) + levers[k + 1] - levers[k]),
            ]) - links.by_imu[k, 3:, 3:6] @ links.bias[k, 3:]  # fmt: skip
            weighted = J.T @ walked[k]
            H[np.ix_(at, at)] += weighted @ J
            b[at] += weighted @ known
        x = np.linalg.solve(H, b)
        if not (np.isfinite(x).all() and 1.0 / _FAR_OFF < x[0] < _FAR_OFF):
            return
        tilt = so3_exp(np.array([x[1], x[2], 0.0]))
        X[:, :9] = (tilt @ R).reshape(-1, 9)
        X[:, 9:12] = centres[0] + (x[0] * shape) @ tilt.T - levers @ tilt.T
        X[:, 12:15] = x[6:].reshape(-1, 3) @ tilt.T
        X[:, 18:21] = x[3:6]


def _whitened_by(views: Views, sigma: float) -> Views:
    """Return the views with errors in units of `sigma` times what they were."""
    values = views.values.copy()
    values[:, 4] /= sigma
    return views._replace(values=values)


def _solution(problem: BundleProblem, solution: Solution, links: Links, gravity_m_s2: float) -> BundleSolution:
    count = len(solution.X)
    poses_at, at = 9 * count, 6 * count
    index = np.concatenate([
        np.arange(poses_at, poses_at + at), np.arange(9), np.arange(poses_at - 9, poses_at), [poses_at + at]
    ])  # fmt: skip
    joint = joint_covariance(solution.U, index) if solution.ok else np.full((len(index),) * 2, np.nan)
    first = np.concatenate([np.arange(6), np.arange(at, at + 9)])
    last = np.concatenate([np.arange(at - 6, at), np.arange(at + 9, at + 18)])
    views = len(solution.squares)
    return BundleSolution(
        T_world_body=np.array([pose(x) for x in solution.X]),
        velocity_world_m_s=solution.X[:, 12:15].copy(),
        gyro_bias_rad_s=solution.X[:, 15:18].copy(),
        accel_bias_m_s2=solution.X[:, 18:21].copy(),
        first_covariance=joint[np.ix_(first, first)],
        last_covariance=joint[np.ix_(last, last)],
        scale_sigma=scale_sigma(solution.X, joint[:at, :at]) if solution.ok else float("inf"),
        time_offset_s=float(solution.calibration[0]),
        time_offset_sigma_s=float(np.sqrt(joint[-1, -1])) if problem.time_offset_sigma_s > 0.0 else 0.0,
        reprojection_px=float(np.sqrt(np.median(solution.squares[:, 0]))) if views > 0 else float("nan"),
        sigma_px=float("nan"),
        outliers=float("nan"),
        inertial_ratio=2.0 * inertial.cost(solution.X, solution.calibration, links, gravity_m_s2) / (9.0 * (count - 1)),
        views=views,
        iterations=solution.iterations,
        converged=solution.ok,
    )


def _states(problem: BundleProblem) -> Array:
    X = np.zeros((len(problem.T_world_body), STATE))
    X[:, :9] = problem.T_world_body[:, :3, :3].reshape(-1, 9)
    X[:, 9:12] = problem.T_world_body[:, :3, 3]
    X[:, 12:15] = problem.velocity_world_m_s
    X[:, 15:18], X[:, 18:21] = problem.gyro_bias_rad_s, problem.accel_bias_m_s2
    return X


def _links(problem: BundleProblem, noise: ImuNoise) -> Links:
    spans, n = problem.spans, len(problem.spans)
    dt = np.array([s.dt_s for s in spans])
    walk = np.repeat([noise.gyroscope_random_walk, noise.accelerometer_random_walk], 3)
    none: NDArray[np.float64] = np.zeros(n)
    return Links(
        inertial=np.ones(n, dtype=np.bool_),
        dt=dt,
        dR=np.array([s.dR for s in spans]),
        dv=np.array([s.dv_m_s for s in spans]),
        dp=np.array([s.dp_m for s in spans]),
        by_imu=np.array([jacobian_by_imu(s) for s in spans]),
        information=np.array([information(s) for s in spans]),
        bias=np.array([np.concatenate([s.gyro_bias_rad_s, s.accel_bias_m_s2]) for s in spans]),
        walk_information=1.0 / (np.maximum(walk, 1e-9) ** 2 * dt[:, None]),
        guess=np.tile(np.eye(4), (n, 1, 1)),
        guess_weight=np.zeros((n, 2)),
        velocity_weight=none,
        extra=np.zeros(n, dtype=np.bool_),
        extra_H=np.zeros((n, 12, 12)),
        extra_b=np.zeros((n, 12)),
        extra_at=np.zeros((n, 2, STATE)),
        rest_weight=np.zeros(n + 1),
    )


def _gauge(problem: BundleProblem, sigmas: Array) -> Prior:
    """Return the prior on frame 0: position and yaw fixed, biases loosely, tilt and velocity free."""
    up = problem.T_world_body[0, 2, :3]
    H = np.zeros((CALIBRATION + 15, CALIBRATION + 15))
    known = np.flatnonzero(sigmas)
    H[known, known] = sigmas[known] ** -2
    state = H[CALIBRATION:, CALIBRATION:]
    state[:3, :3] = np.outer(up, up) / GAUGE_SIGMA_RAD**2 + 1e-2 * np.eye(3)  # 10 rad: only keeps it solvable
    state[3:6, 3:6] = np.eye(3) / GAUGE_SIGMA_M**2
    state[6:9, 6:9] = 1e-4 * np.eye(3)  # 100 m/s
    state[9:12, 9:12] = np.eye(3) / problem.gyro_bias_sigma_rad_s**2
    state[12:, 12:] = np.eye(3) / problem.accel_bias_sigma_m_s2**2
    return Prior(H, np.zeros(len(H)), np.zeros(CALIBRATION))
