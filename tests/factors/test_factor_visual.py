import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.core.geometry import invert, se3_exp, tangent_basis, transform
from vislam.factors.noise_models import DIRECTION_FLOOR_DEG, gaussian
from vislam.factors.visual import (
    direction_as_pose,
    direction_factor,
    direction_measurement,
    direction_residual,
)

LEVER_M = np.array([0.08, 0.03, -0.02])
SOFT_M = 0.005


def _measure(T_a: np.ndarray, T_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the exact unscaled measurement of two poses and cam0's motion in body a."""
    T = invert(T_a) @ T_b
    t = T[:3, 3] + T[:3, :3] @ LEVER_M - LEVER_M
    return transform(np.ascontiguousarray(T[:3, :3]), t / np.linalg.norm(t)), t


def _case(seed: int, motion_m: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    T_a = se3_exp(rng.normal(size=6))
    return T_a, T_a @ se3_exp(np.concatenate([0.3 * rng.normal(size=3), motion_m * rng.normal(size=3)]))


@given(seed=st.integers(0, 10_000), motion_m=st.sampled_from([0.02, 0.3, 3.0]), turn=st.sampled_from([0.01, 0.3, 1.5]))
def test_jacobians_equal_finite_differences(seed: int, motion_m: float, turn: float) -> None:
    T_a, T_b = _case(seed, motion_m)
    rng = np.random.default_rng(seed + 1)
    measured, _ = _measure(
        T_a, T_b @ se3_exp(turn * rng.normal(size=6) * np.array([0.3, 0.3, 0.3, 1, 1, 1]) * motion_m)
    )
    d = direction_measurement(measured, np.eye(6), 0.0)

    def residual(A: np.ndarray, B: np.ndarray) -> np.ndarray:
        return direction_residual(A, B, d.R_a_b, d.direction_a, d.tangent, LEVER_M, SOFT_M)[0]

    _, J_a, J_b = direction_residual(T_a, T_b, d.R_a_b, d.direction_a, d.tangent, LEVER_M, SOFT_M)
    h = 1e-6 * min(1.0, motion_m)
    for i in range(6):
        step = np.zeros(6)
        step[i] = h
        numeric_a = (residual(T_a @ se3_exp(step), T_b) - residual(T_a @ se3_exp(-step), T_b)) / (2 * h)
        numeric_b = (residual(T_a, T_b @ se3_exp(step)) - residual(T_a, T_b @ se3_exp(-step))) / (2 * h)
        scale = 1.0 + max(np.abs(J_a).max(), np.abs(J_b).max())
        np.testing.assert_allclose(J_a[:, i], numeric_a, atol=2e-5 * scale)
        np.testing.assert_allclose(J_b[:, i], numeric_b, atol=2e-5 * scale)


@pytest.mark.parametrize("seed", range(5))
def test_residual_is_zero_at_the_truth_and_blind_to_scale(seed: int) -> None:
    T_a, T_b = _case(seed)
    measured, t = _measure(T_a, T_b)
    d = direction_measurement(measured, np.eye(6), 0.0)
    R = measured[:3, :3]
    for scale in (0.3, 1.0, 7.0):
        T = T_a @ transform(R.copy(), scale * t - (R - np.eye(3)) @ LEVER_M)
        r = direction_residual(T_a, T, d.R_a_b, d.direction_a, d.tangent, LEVER_M, SOFT_M)[0]
        np.testing.assert_allclose(r, 0.0, atol=1e-9)


def test_small_residual_is_the_angle_and_the_opposite_direction_is_not_a_minimum() -> None:
    T_a = np.eye(4)
    d = direction_measurement(transform(np.eye(3), np.array([1.0, 0, 0])), np.eye(6), 0.0)
    norms = []
    for angle in np.deg2rad([1.0, 30.0, 90.0, 150.0]):
        T_b = transform(np.eye(3), 4.0 * np.array([np.cos(angle), np.sin(angle), 0.0]))
        r = direction_residual(T_a, T_b, d.R_a_b, d.direction_a, d.tangent, np.zeros(3), SOFT_M)[0]
        norms.append(np.linalg.norm(r))
    assert norms[0] == pytest.approx(np.deg2rad(1.0), rel=1e-3)
    assert norms == sorted(norms)


def test_gtsam_gets_the_jacobians_in_its_own_layout() -> None:
    T_a, T_b = _case(4)
    measured, _ = _measure(T_a, T_b @ se3_exp(np.full(6, 0.05)))
    d = direction_measurement(measured, np.diag([1e-4] * 3 + [1e-2] * 3), 0.01)
    model = gaussian(d.covariance, 1e6)
    factor = direction_factor(0, 1, d, lever_m=LEVER_M, soft_m=SOFT_M, model=model)
    values = gtsam.Values()
    values.insert(0, gtsam.Pose3(T_a))
    values.insert(1, gtsam.Pose3(T_b))
    A, b = factor.linearize(values).jacobian()
    r, J_a, J_b = direction_residual(T_a, T_b, d.R_a_b, d.direction_a, d.tangent, LEVER_M, SOFT_M)
    W = model.R()
    np.testing.assert_allclose(A, W @ np.hstack([J_a, J_b]), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(b, -W @ r, rtol=1e-9, atol=1e-9)


def test_without_parallax_only_rotation_counts() -> None:
    d = direction_measurement(se3_exp(np.array([0.1, 0, 0, 0, 0, 0])), np.eye(6), 0.0)
    assert not d.has_direction
    factor = direction_factor(0, 1, d, lever_m=LEVER_M, soft_m=SOFT_M, model=gaussian(d.covariance, 1e6))
    values = gtsam.Values()
    values.insert(0, gtsam.Pose3())
    values.insert(1, gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.1, 0, 0])), np.array([3.0, 2.0, 1.0])))
    assert factor.error(values) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_direction_as_pose_lets_scale_go_and_holds_direction(seed: int) -> None:
    T_a, T_b = _case(seed)
    measured, t = _measure(T_a, T_b)
    sigma = 0.01
    covariance = np.diag([1e-6] * 3 + [sigma**2] * 3)
    covariance[3:, 3:] -= np.deg2rad(DIRECTION_FLOOR_DEG) ** 2 * np.eye(3)  # which it adds
    mean, out = direction_as_pose(measured, covariance, LEVER_M, invert(T_a) @ T_b)
    np.testing.assert_allclose(mean, invert(T_a) @ T_b, atol=1e-12)
    R = measured[:3, :3]

    def chi2(t_camera: np.ndarray) -> float:
        offset = R.T @ (t_camera - (R - np.eye(3)) @ LEVER_M - mean[:3, 3])
        return float(offset @ np.linalg.solve(out[3:, 3:], offset))

    assert chi2(1.5 * t) == pytest.approx(0.01, rel=1e-3)  # half a step of scale is a tenth of a sigma
    side = tangent_basis(t / np.linalg.norm(t))[:, 0]
    assert chi2(t + 3.0 * sigma * np.linalg.norm(t) * side) == pytest.approx(9.0, rel=1e-3)
