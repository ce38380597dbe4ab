"""Batch optimisation on the window's kernels: arrays in, arrays out, no marginalisation.

For the start of a run, where a few seconds of frames have to give scale, velocity, gravity's direction and biases at
once: the states lie in a gravity-aligned frame whose yaw and origin are free, so that roll and pitch of the first state
are gravity's direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.camera import Rig
from vislam.config import WindowConfig
from vislam.imu import ImuNoise, Preintegrated
from vislam.messages import Array, Observations
from vislam.window import visual
from vislam.window.layout import CALIBRATION, STATE, Camera, Links, Prior
from vislam.window.linear import joint_covariance
from vislam.window.posterior import pose, scale_sigma
from vislam.window.solver import Problem, Room, optimise
from vislam.window.spans import information, jacobian_by_bias
from vislam.window.tracks import RHO_START, TrackTable

_TOLERANCE = 1e-6


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
    reprojection_px: float  # median error of an observation in units of sigma_px
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
    """Optimise poses, velocities, biases and landmarks of a few frames to convergence.

    The time offset and the extrinsic rotation are held. Position and yaw of frame 0 are fixed to the gauge's sigmas
    of `config`.

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
    X = _states(problem)
    tracks = TrackTable(config, rig)
    for k, seen in enumerate(problem.observations):
        tracks.add(k, seen)
    selection = tracks.select(ids)
    camera = Camera(
        T_body_cam=rig.T_body_cams[0],
        T_cam0_cams=np.array([np.linalg.inv(rig.T_body_cams[0]) @ T for T in rig.T_body_cams[:2]]),
        rate=np.zeros((count, 3)),
        applied_offset_s=np.zeros(count),
        active=np.zeros(CALIBRATION, dtype=np.bool_),
        huber_k=config.huber_k,
        rho_information=config.rho_sigma_1_m**-2,
    )
    calibration = np.zeros(CALIBRATION)
    points = np.zeros((len(selection.slots), 3))
    fresh = np.ones(len(points), dtype=np.bool_)
    visual.start(X, calibration, selection.views, camera, fresh, RHO_START, points)
    held = np.zeros(count, dtype=np.bool_)
    links, gauge = _links(problem, noise), _gauge(problem, config)
    solution = optimise(
        Problem(X, X.copy(), held, points, calibration, selection.views, camera, links, gauge, gravity_m_s2, True),
        max_iterations,
        _TOLERANCE,
        Room(),
    )
    poses_at = 9 * count
    index = np.concatenate([np.arange(poses_at, poses_at + 6 * count), np.arange(9), np.arange(poses_at - 9, poses_at)])
    joint = joint_covariance(solution.U, index) if solution.ok else np.full((len(index),) * 2, np.nan)
    at = 6 * count
    first = np.concatenate([np.arange(6), np.arange(at, at + 9)])
    last = np.concatenate([np.arange(at - 6, at), np.arange(at + 9, at + 18)])
    return BundleSolution(
        T_world_body=np.array([pose(x) for x in solution.X]),
        velocity_world_m_s=solution.X[:, 12:15].copy(),
        gyro_bias_rad_s=solution.X[:, 15:18].copy(),
        accel_bias_m_s2=solution.X[:, 18:21].copy(),
        first_covariance=joint[np.ix_(first, first)],
        last_covariance=joint[np.ix_(last, last)],
        scale_sigma=scale_sigma(solution.X, joint[:at, :at]) if solution.ok else float("inf"),
        reprojection_px=float(np.sqrt(np.median(solution.squares[:, 0]))) if len(selection.rows) > 0 else float("nan"),
        views=len(selection.rows),
        iterations=solution.iterations,
        converged=solution.ok and solution.iterations < max_iterations,
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
    walk = np.repeat([noise.gyro_bias_walk, noise.accel_bias_walk], 3)
    none: NDArray[np.float64] = np.zeros(n)
    return Links(
        inertial=np.ones(n, dtype=np.bool_),
        dt=dt,
        dR=np.array([s.dR for s in spans]),
        dv=np.array([s.dv_m_s for s in spans]),
        dp=np.array([s.dp_m for s in spans]),
        by_bias=np.array([jacobian_by_bias(s) for s in spans]),
        information=np.array([information(s) for s in spans]),
        bias=np.array([np.concatenate([s.gyro_bias_rad_s, s.accel_bias_m_s2]) for s in spans]),
        walk_information=1.0 / (np.maximum(walk, 1e-9) ** 2 * dt[:, None]),
        guess=np.tile(np.eye(4), (n, 1, 1)),
        guess_weight=np.zeros((n, 2)),
        velocity_weight=none,
        rest_weight=np.zeros(n + 1),
    )


def _gauge(problem: BundleProblem, config: WindowConfig) -> Prior:
    """Return the prior on frame 0: position and yaw fixed, biases loosely, tilt and velocity free."""
    up = problem.T_world_body[0, 2, :3]
    H = np.zeros((CALIBRATION + 15, CALIBRATION + 15))
    state = H[CALIBRATION:, CALIBRATION:]
    state[:3, :3] = np.outer(up, up) / config.gauge_sigma_rad**2 + 1e-2 * np.eye(3)  # 10 rad: only keeps it solvable
    state[3:6, 3:6] = np.eye(3) / config.gauge_sigma_m**2
    state[6:9, 6:9] = 1e-4 * np.eye(3)  # 100 m/s
    state[9:12, 9:12] = np.eye(3) / problem.gyro_bias_sigma_rad_s**2
    state[12:, 12:] = np.eye(3) / problem.accel_bias_sigma_m_s2**2
    return Prior(H, np.zeros(len(H)), np.zeros(CALIBRATION))
