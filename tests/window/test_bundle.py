"""The batch entry: scale, velocity, gravity and biases of a few seconds of one camera and an IMU, from a bad start."""

from dataclasses import replace

import numpy as np
import pytest

from vislam.config import WindowConfig
from vislam.core.geometry import so3_exp
from vislam.imu import preintegrate
from vislam.window.bundle import BundleProblem, solve
from worlds.motion import EUROC_NOISE, Motion
from worlds.parts import GRAVITY_M_S2
from worlds.room import MONO, World


def rough_problem(seed: int, scale: float) -> tuple[BundleProblem, list]:
    """Return frames over 3 s whose start has the wrong scale and a tilt of two degrees."""
    packets, truths = World(Motion.random(seed, 1.3), MONO, seed, duration_s=3.0, tracks=60).packets()
    rng = np.random.default_rng(seed)
    tilt = so3_exp(np.array([*np.deg2rad(rng.normal(size=2) * 2.0), 0.0]))
    T = np.array([t[0] for t in truths])
    first = T[0, :3, 3].copy()
    T[:, :3, :3] = tilt @ T[:, :3, :3]
    T[:, :3, 3] = first + scale * (T[:, :3, 3] - first) @ tilt.T
    problem = BundleProblem(
        T_world_body=T,
        velocity_world_m_s=scale * np.array([t[1] for t in truths]) @ tilt.T,
        gyro_bias_rad_s=np.zeros(3),
        accel_bias_m_s2=np.zeros(3),
        observations=[p.observations for p in packets],
        spans=[preintegrate(p.imu, noise=EUROC_NOISE) for p in packets[1:]],
        gyro_bias_sigma_rad_s=0.02,
        accel_bias_sigma_m_s2=0.1,
    )
    return problem, truths


@pytest.mark.parametrize("scale", [0.6, 1.5])
def test_scale_is_found_and_its_sigma_is_honest(scale: float) -> None:
    errors = []
    for seed in (1, 2, 3):
        problem, truths = rough_problem(seed, scale)
        solution = solve(problem, WindowConfig(), MONO, EUROC_NOISE, GRAVITY_M_S2)
        assert solution.converged
        found = solution.T_world_body[:, :3, 3] - solution.T_world_body[0, :3, 3]
        true = np.array([t[0][:3, 3] for t in truths]) - truths[0][0][:3, 3]
        error = np.linalg.norm(found) / np.linalg.norm(true) - 1.0
        assert abs(error) < 0.03
        errors.append(error / solution.scale_sigma)
        up_error = np.arccos(min(1.0, solution.T_world_body[-1, 2, :3] @ truths[-1][0][2, :3]))
        assert up_error < np.deg2rad(1.0)
        assert np.abs(solution.gyro_bias_rad_s[-1] - truths[-1][2][:3]).max() < 0.003
        assert 0.5 < solution.reprojection_px < 2.0
    print("scale errors in sigmas:", np.round(errors, 2))
    assert np.abs(errors).max() < 4.0


def test_lists_that_do_not_fit_are_refused() -> None:
    problem, _ = rough_problem(1, 1.0)
    with pytest.raises(ValueError, match="M - 1 spans"):
        solve(replace(problem, spans=problem.spans[1:]), WindowConfig(), MONO, EUROC_NOISE, GRAVITY_M_S2)
