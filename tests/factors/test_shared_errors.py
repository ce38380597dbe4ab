"""What a window's edges err in common."""

import numpy as np

from vislam.core.geometry import so3_exp, transform
from vislam.core.memory import EdgeRecord, GravityRecord
from vislam.factors.window import SharedErrors


def drive(sigma: float, count: int = 50) -> tuple[SharedErrors, np.ndarray]:
    """Return the errors of edges of 0.5 m each, in a slow curve, whose lengths are known to `sigma`, and the poses."""
    shared, poses = SharedErrors(), [np.eye(4)]
    step = transform(so3_exp(np.array([0.0, 0.0, 0.03])), np.array([0.5, 0.0, 0.0]))
    R = step[:3, :3]
    covariance = np.eye(6) * 1e-6
    covariance[3:, 3:] += np.outer(R.T @ step[:3, 3], R.T @ step[:3, 3]) * sigma**2
    for k in range(1, count):
        poses.append(poses[-1] @ step)
        shared.take(EdgeRecord(k, step, covariance, True))
    return shared, np.array(poses)


def test_a_common_scale_moves_every_pose_by_its_way_from_the_first() -> None:
    shared, poses = drive(0.04)
    ids = [0, 7, 49]
    effect = shared.effect(ids, poses).reshape(3, 6, 3)
    assert not effect[:, :, 1:].any()  # nothing has been said of level
    for k, moved in zip(ids, effect[:, :, 0], strict=True):
        np.testing.assert_allclose(poses[k, :3, :3] @ moved[3:], 0.04 * poses[k, :3, 3], atol=1e-12)
        assert not moved[:3].any()


def test_lengths_known_as_well_as_directions_have_nothing_in_common() -> None:
    shared, poses = drive(0.0)
    assert not shared.effect([49], poses).any()


def test_an_edge_that_replaces_another_takes_its_part_and_a_weak_link_has_none() -> None:
    shared, poses = drive(0.04, 3)
    before = shared.effect([2], poses)[:, 0]
    weak = EdgeRecord(2, transform(np.eye(3), np.array([0.5, 0.0, 0.0])), np.diag([1, 1, 1, 25.0, 1, 1]), False, True)
    shared.take(weak)
    after = shared.effect([2], poses)[:, 0]
    assert 0.0 < np.linalg.norm(after) < 0.6 * np.linalg.norm(before)


def test_level_is_known_as_at_the_best_keyframe_and_turns_the_way() -> None:
    shared, poses = drive(0.0)
    for k, sigma_rad in ((10, 0.02), (20, 0.005), (30, 0.01)):
        shared.level(GravityRecord(k, np.array([0.0, 0.0, 1.0]), sigma_rad))
    effect = shared.effect([49], poses)
    turned = so3_exp(np.array([0.005, 0.0, 0.0])) @ poses[49, :3, 3] - poses[49, :3, 3]
    np.testing.assert_allclose(poses[49, :3, :3] @ effect[3:, 1], turned, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(effect[:3, 1:], axis=0), 0.005)
