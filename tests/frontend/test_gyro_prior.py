"""A flat scene hides small translations in the rotation; what the gyroscope knows decides."""

import numpy as np
import pytest

from vislam.core.geometry import so3_exp, so3_log
from vislam.vision.two_view import RotationPrior, direction_given_rotation, refine_two_view

SEED = 5
SIGMA = 0.3 / 450.0


def flat_scene(rng, R, t, count=150):
    """Return directions on z = 1 of points of a wall, seen by the keyframe and by the moved camera, with noise."""
    points = np.column_stack([rng.uniform(-1.2, 1.2, count), rng.uniform(-0.9, 0.9, count), np.full(count, 2.5)])
    moved = (points - t) @ R
    key, now = points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]
    return key, now + rng.normal(0.0, SIGMA, now.shape)


@pytest.mark.parametrize("axis", [0, 1])
def test_the_prior_finds_direction_and_rotation_before_a_wall(axis):
    print("seed", SEED)
    rng = np.random.default_rng(SEED)
    R, t = so3_exp(np.array([0.01, -0.03, 0.02])), np.zeros(3)
    t[axis] = 0.08
    key, now = flat_scene(rng, R, t)
    prior = RotationPrior(R @ so3_exp(rng.normal(0.0, 1e-3, 3)), 1e-3)
    start = direction_given_rotation(prior.R_key_cam, key, now)
    found = refine_two_view(prior.R_key_cam, start, key, now, SIGMA, 3.0, prior)
    assert found.converged
    assert found.inliers.mean() > 0.95
    angle_deg = np.rad2deg(np.arccos(np.clip(found.direction_key @ t / 0.08, -1.0, 1.0)))
    assert angle_deg < 5.0
    assert np.rad2deg(np.linalg.norm(so3_log(R.T @ found.R_key_cam))) < 0.2
    assert np.all(np.isfinite(found.covariance))


def test_the_direction_is_exact_without_noise_and_none_without_points():
    R, t = so3_exp(np.array([0.2, -0.1, 0.05])), np.array([0.3, -0.1, 0.2])
    rng = np.random.default_rng(SEED)
    points = np.column_stack([rng.uniform(-1, 1, (40, 2)), rng.uniform(2, 6, 40)])
    moved = (points - t) @ R
    key, now = points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]
    now[::7] = np.nan
    direction = direction_given_rotation(R, key, now)
    assert abs(abs(direction @ t) / np.linalg.norm(t) - 1.0) < 1e-9
    assert direction_given_rotation(R, key, np.full_like(now, np.nan)) is None
