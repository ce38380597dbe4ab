"""The fits of a motion over a floor: exact answers, derivatives, covariances, and what the points cannot tell."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.config import PlanarConfig
from vislam.core.errors import UsageError
from vislam.core.geometry import invert, se3_log, so3_exp, transform
from vislam.core.messages import Array
from vislam.frontend.planar.fit import (
    FloorPair,
    _equations,
    _turned,
    _Views,
    camera_motion,
    floor_points,
    joint_fit,
    scale_sigma,
    split_fit,
)
from vislam.frontend.planar.floor import make_mount
from worlds.floor import rig

H = 0.6
HEAVE_M = 0.002
PX = 1.0 / 230.0
R0 = make_mount(PlanarConfig(height_m=H), rig().T_body_cams[0][:3, :3].copy()).R_level_cam
PRIOR = np.diag([np.deg2rad(0.3) ** 2] * 2 + [np.deg2rad(0.05) ** 2] * 2)


def seen(
    motion: Array, R_key: Array, R_now: Array, count: int = 120, seed: int = 0, lift_m: float = 0.0
) -> tuple[Array, Array]:
    """Rays [N, 2] of floor points in the keyframe and after a motion, exactly."""
    rng = np.random.default_rng(seed)
    floor = np.column_stack([rng.uniform(0.9, 4.0, count), rng.uniform(-1.0, 1.0, count), np.full(count, -H)])
    c, s = np.cos(motion[0]), np.sin(motion[0])
    later = (floor - [motion[1], motion[2], lift_m]) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    rays = [points @ R for points, R in ((floor, R_key), (later, R_now))]
    return rays[0][:, :2] / rays[0][:, 2:], rays[1][:, :2] / rays[1][:, 2:]


def pair(motion: Array, tilt: Array, noise_px: float = 0.0, seed: int = 0, lift_m: float = 0.0) -> FloorPair:
    """Floor points whose tilts are off by what the fit has to find [4]."""
    R_key, R_now = _turned(R0, tilt[0], tilt[1]), _turned(R0, tilt[0] + tilt[2], tilt[1] + tilt[3])
    key, now = seen(motion, R_key, R_now, seed=seed, lift_m=lift_m)
    now = now + np.random.default_rng(seed + 1).normal(0.0, noise_px * PX, now.shape)
    return FloorPair(key, now, R0, R0, H, PX)


@given(st.floats(-0.2, 0.2), st.floats(-0.3, 0.5), st.floats(-0.2, 0.2), st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_exact_points_give_the_exact_motion(theta: float, x: float, y: float, seed: int) -> None:
    motion = np.array([theta, x, y])
    points = pair(motion, np.zeros(4), seed=seed)
    use = points.usable(5.0)
    assert use.sum() > 50
    for yaw in (None, theta):
        start = points.searched(use, yaw, seed)
        assert np.allclose(start, motion, atol=1e-6)
    fit = joint_fit(points, use, np.zeros(3), 0.3, 3.0, PRIOR, HEAVE_M)
    assert not fit.failure and fit.inliers[use].all()
    assert np.allclose(fit.motion, motion, atol=1e-7) and np.allclose(fit.tilt, 0.0, atol=1e-6)


def test_the_tilt_of_both_images_is_found() -> None:
    motion, tilt = np.array([0.03, 0.45, 0.02]), np.deg2rad([0.2, 0.4, -0.03, 0.05])
    points = pair(motion, tilt)
    wide = np.eye(4) * np.deg2rad(1.0) ** 2
    fit = joint_fit(points, points.usable(5.0), np.array([0.0, 0.4, 0.0]), 0.3, 3.0, wide, 1e-4)
    assert np.rad2deg(np.abs(fit.tilt - tilt)).max() < 0.01
    assert np.allclose(fit.motion, motion, atol=3e-4)
    blind = joint_fit(points, points.usable(5.0), np.array([0.0, 0.4, 0.0]), 0.3, 3.0, np.eye(4) * 1e-12, 1e-6)
    assert abs(blind.motion[1] - motion[1]) > 20 * abs(fit.motion[1] - motion[1])  # what tilt costs when not fitted


def test_derivatives_are_those_of_the_residuals() -> None:
    points = pair(np.array([0.05, 0.3, -0.1]), np.zeros(4))
    at = np.array([0.04, 0.28, -0.09, 0.01, -0.02, 0.005, 0.008, 0.004])

    def gradient(x: Array) -> tuple[Array, float]:
        A, g, squares = np.empty((8, 8)), np.empty(8), np.empty(len(points.rays))
        key, now = _turned(R0, x[3], x[4]), _turned(R0, x[3] + x[5], x[4] + x[6])
        _equations(_Views(points.rays, points.seen, H, PX, 1e6), key, now, x[[0, 1, 2, 7]], A, g, squares)
        return -2.0 * g, float(squares.sum())

    exact, _ = gradient(at)
    h = 1e-6
    for k in range(8):
        # tilts enter by so3_exp, whose derivative at small angles is the rotation itself: to one part in a hundred
        step = h * np.eye(8)[k]
        slope = (gradient(at + step)[1] - gradient(at - step)[1]) / (2 * h)
        assert exact[k] == pytest.approx(slope, rel=0.02, abs=1e-2 * np.abs(exact).max())


def test_covariance_is_that_of_the_errors() -> None:
    motion, rng = np.array([0.04, 0.4, 0.03]), np.random.default_rng(8)
    errors, covariance = [], np.zeros((6, 6))
    for seed in range(60):
        tilt = rng.normal(0.0, np.sqrt(np.diag(PRIOR)))
        lift_m = rng.normal(0.0, HEAVE_M)
        points = pair(motion, tilt, noise_px=0.3, seed=seed, lift_m=lift_m)
        fit = joint_fit(points, points.usable(5.0), motion, 0.3, 3.0, PRIOR, HEAVE_M)
        T, covariance = camera_motion(fit, R0, R0)
        key, now = _turned(R0, tilt[0], tilt[1]), _turned(R0, tilt[0] + tilt[2], tilt[1] + tilt[3])
        yaw = np.asarray(so3_exp(np.array([0.0, 0.0, motion[0]])))
        true = transform(key.T @ yaw @ now, key.T @ np.array([motion[1], motion[2], lift_m]))
        errors.append(se3_log(invert(true) @ T))
    nees = np.array([e @ np.linalg.solve(covariance, e) for e in errors])
    assert 4.5 < nees.mean() < 8.0
    assert fit.variance == pytest.approx(1.0, abs=0.5)


def test_outliers_do_not_matter_until_they_are_most() -> None:
    motion = np.array([0.02, 0.3, 0.0])
    points = pair(motion, np.zeros(4), noise_px=0.2)
    rng = np.random.default_rng(2)
    wrong = rng.random(len(points.rays)) < 0.4
    points.seen[wrong] += rng.normal(0.0, 30 * PX, (wrong.sum(), 2))
    use = points.usable(5.0)
    fit = joint_fit(points, use, points.searched(use, None, 1), 0.3, 3.0, PRIOR, HEAVE_M)
    assert np.linalg.norm(fit.motion[1:] - motion[1:]) < 0.003
    assert not fit.inliers[wrong & use].any() or fit.inliers[wrong & use].mean() < 0.05


def test_without_motion_nothing_is_learnt_of_scale() -> None:
    points = pair(np.zeros(3), np.zeros(4), noise_px=0.2)
    fit = joint_fit(points, points.usable(5.0), np.zeros(3), 0.3, 3.0, PRIOR, HEAVE_M)
    assert np.sqrt(fit.covariance[4, 4]) > 0.9 * np.sqrt(PRIOR[1, 1])
    assert scale_sigma(fit, np.eye(2)) == 0.0
    moved = pair(np.array([0.0, 0.4, 0.0]), np.zeros(4), noise_px=0.2)
    far = joint_fit(moved, moved.usable(5.0), np.array([0.0, 0.4, 0.0]), 0.3, 3.0, PRIOR, HEAVE_M)
    assert np.sqrt(far.covariance[4, 4]) < 0.5 * np.sqrt(PRIOR[1, 1])
    half_degree = scale_sigma(far, np.eye(2) * np.deg2rad(0.5) ** 2)
    assert 0.01 < half_degree < 0.05  # 2.5 % is the rule of thumb


def test_the_split_needs_points_on_both_sides_of_the_horizon() -> None:
    points = pair(np.array([0.0, 0.3, 0.0]), np.zeros(4))
    use = points.usable(5.0)
    fit = split_fit(points, use, np.zeros(len(use), dtype=bool), 0.3, PRIOR, HEAVE_M, 6, 0)
    assert "above the horizon" in fit.failure


@given(st.floats(1.0, 60.0), st.floats(-20.0, 20.0))
@settings(max_examples=30, deadline=None)
def test_a_mount_is_what_it_was_made_of(tilt_deg: float, roll_deg: float) -> None:
    config = PlanarConfig(height_m=0.5, tilt_deg=tilt_deg, roll_deg=roll_deg)
    mount = make_mount(config, rig(tilt_deg, roll_deg).T_body_cams[0][:3, :3].copy())
    assert mount.tilt_deg == pytest.approx(tilt_deg) and mount.roll_deg == pytest.approx(roll_deg)
    assert np.allclose(mount.R_level_body, np.eye(3), atol=1e-9)  # that rig's body is level at that tilt and roll
    turned = mount.turned(np.array([0.0, 0.01]))
    assert turned.tilt_deg == pytest.approx(tilt_deg + np.rad2deg(0.01), abs=0.02)


@pytest.mark.parametrize("height_m", [None, 0.0, -1.0, float("nan"), 1e4])
def test_a_height_that_cannot_be_is_refused(height_m: float | None) -> None:
    with pytest.raises(UsageError, match=r"height of the camera above the floor"):
        make_mount(PlanarConfig(height_m=height_m), rig().T_body_cams[0][:3, :3].copy())


def test_rays_above_the_horizon_meet_no_floor() -> None:
    assert np.isnan(floor_points(np.array([[0.0, -1.0]]), R0, H)).all()
    straight = floor_points(np.array([[0.0, 0.0]]), R0, H)[0]
    assert straight[0] == pytest.approx(H / np.tan(np.deg2rad(18.0))) and abs(straight[1]) < 1e-9
