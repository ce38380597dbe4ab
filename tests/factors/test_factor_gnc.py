import gtsam
import numpy as np
import pytest
from graph_world import World

from vislam.errors import DataError, UsageError
from vislam.factors.gnc import gnc_loops
from vislam.factors.keys import X, poses_of
from vislam.factors.noise import cauchy, gaussian
from vislam.factors.visual import pose_factor
from vislam.messages import Array


def chain(world: World) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, Array]:
    """A gauge prior in slot 0 and noisy odometry, which the values follow; also as poses [M, 4, 4]."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(world.truth[0]), gaussian(np.eye(6) * 1e-6, 1e6)))
    model = gaussian(world.vo_covariance, 1e6)
    T = world.truth[0]
    poses = [T]
    values.insert(X(0), gtsam.Pose3(T))
    for k in range(1, world.count):
        T_step = world.vo(k).T_keyframe_body
        assert T_step is not None
        graph.add(pose_factor(X(k - 1), X(k), T_step, model))
        T = T @ T_step
        poses.append(T)
        values.insert(X(k), gtsam.Pose3(T))
    return graph, values, np.stack(poses)


@pytest.mark.parametrize("seed", [1, 2])
def test_half_of_the_loops_false_and_none_of_them_kept(seed: int) -> None:
    world = World(60.0, seed=seed)
    graph, values, odometry = chain(world)
    inliers = list(range(graph.size()))
    rng = np.random.default_rng(seed)
    true, false = [], []
    for n, k in enumerate(range(105, world.count, 4)):
        for edge, kind in (
            (world.loop(n, k - 100, k), true),
            (world.false_loop(n, int(rng.integers(0, k - 20)), k), false),
        ):
            kind.append(graph.size())
            model = cauchy(gaussian(edge.covariance, 1e6), 2.0)  # the kernel must not survive inside
            graph.add(pose_factor(X(edge.from_id), X(edge.to_id), edge.T_from_to, model))
    optimum, weights = gnc_loops(graph, values, inliers)
    assert len(true) == len(false) > 45
    assert np.all(weights[true] > 0.99) and np.all(weights[false] < 0.01) and np.all(weights[inliers] == 1.0)
    before = np.sqrt(np.mean(np.sum((odometry - world.truth)[:, :3, 3] ** 2, axis=1)))
    after = np.sqrt(np.mean(np.sum((poses_of(optimum) - world.truth)[:, :3, 3] ** 2, axis=1)))
    print(f"odometry {before:.3f} m, after {after:.3f} m")
    assert after < 0.5 * before


def test_without_loops_odometry_stays() -> None:
    world = World(4.0)
    graph, values, odometry = chain(world)
    optimum, weights = gnc_loops(graph, values, range(graph.size()))
    np.testing.assert_allclose(poses_of(optimum), odometry, atol=1e-6)
    assert np.all(weights == 1.0)


def test_what_cannot_be_used_is_told() -> None:
    world = World(2.0)
    graph, values, _ = chain(world)
    with pytest.raises(UsageError, match="slots"):
        gnc_loops(graph, values, [0, 500])
    with pytest.raises(DataError, match="GNC"):
        gnc_loops(graph, gtsam.Values(), [0])
    bad = world.loop(0, 0, 5)
    T = bad.T_from_to.copy()
    T[0, 3] = np.nan
    graph.add(pose_factor(X(0), X(5), T, gaussian(bad.covariance, 1e6)))
    with pytest.raises(DataError, match="GNC"):
        gnc_loops(graph, values, [0])
    graph.remove(1)
    with pytest.raises(UsageError, match="empty slots"):
        gnc_loops(graph, values, [0])
