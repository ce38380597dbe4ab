"""Graphs of poses by hand: what is exact comes out exact, and what cannot be used is refused by name."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError, UsageError, VislamError
from vislam.core.geometry import invert, se3_exp, transform
from vislam.core.messages import LoopDecision
from vislam.graph import Graph
from vislam.imu import ImuNoise
from worlds.lap import RIG, World
from worlds.parts import GRAVITY_M_S2, R_BODY_CAM

TIGHT = (1e-4, 1e-4)
ODOMETRY = (0.01, 0.02)
COUNT = 24
STEP = se3_exp(np.array([0.02, -0.01, 2.0 * np.pi / COUNT, 0.5, 0.0, 0.1]))
TRUTH = np.stack([np.linalg.matrix_power(STEP, k) for k in range(COUNT + 1)])
LENS = Camera(752, 480, 458.0, 457.0, 367.0, 248.0, 0.0, "radtan", (-0.28, 0.07, 2e-4, 2e-5))
SILENT = ImuNoise(1.7e-4, 2.0e-3, 1.9393e-5, 3.0e-3, 200.0)


def chain(count: int = COUNT, rng: np.random.Generator | None = None) -> Graph:
    """A chain of odometry from the identity; with `rng` as noisy as it says."""
    graph = Graph()
    graph.prior(graph.add_pose(), np.eye(4), TIGHT)
    for k in range(count):
        noise = np.zeros(6) if rng is None else rng.normal(size=6) * np.repeat(ODOMETRY, 3)
        graph.between(k, graph.add_pose(), STEP @ se3_exp(noise), ODOMETRY)
    return graph


def pair(*priors: tuple[float, float]) -> Graph:
    """One pose, with priors about its x: value and sigma."""
    graph = Graph()
    graph.add_pose()
    for x, sigma in priors:
        graph.prior(0, transform(np.eye(3), np.array([x, 0.0, 0.0])), (0.1, sigma))
    return graph


@pytest.mark.parametrize("incremental", [False, True])
def test_a_chain_without_noise_is_where_it_truly_is(incremental: bool) -> None:
    graph = chain()
    result = graph.optimise(incremental=incremental)
    np.testing.assert_allclose(graph.poses(), TRUTH, atol=1e-9)
    assert result.cost < 1e-15 and result.note == ""
    assert len(graph) == COUNT + 1


def test_two_priors_meet_where_their_information_balances() -> None:
    graph = pair((0.0, 0.1), (1.0, 0.2))
    graph.optimise()
    assert graph.poses()[0, 0, 3] == pytest.approx(0.2, abs=1e-6)
    assert graph.covariance(0)[3, 3] == pytest.approx(1.0 / (0.1**-2 + 0.2**-2), rel=1e-6)


def test_covariances_of_a_straight_chain_add_up() -> None:
    graph = Graph()
    graph.prior(graph.add_pose(), np.eye(4), (1e-6, 1e-3))
    for k in range(4):
        graph.between(k, graph.add_pose(), transform(np.eye(3), np.array([1.0, 0.0, 0.0])), (1e-6, 0.1))
    graph.optimise()
    for k in range(5):
        assert graph.covariance(k)[3, 3] == pytest.approx(1e-6 + k * 0.01, rel=1e-4)
    assert graph.covariance(2, 4)[3, 9] == pytest.approx(0.02, rel=1e-3)  # what both have in common
    assert graph.relative_covariance(2, 4)[3, 3] == pytest.approx(0.02, rel=1e-3)


def test_covariances_may_be_given_whole_or_by_axis() -> None:
    matrix = np.diag([1e-4] * 3 + [1e-2, 4e-2, 9e-2])
    for noise in (matrix, np.sqrt(np.diag(matrix))):
        graph = Graph()
        graph.prior(graph.add_pose(), np.eye(4), noise)
        graph.optimise()
        np.testing.assert_allclose(graph.covariance(0), matrix, atol=1e-12)


def test_batch_and_incremental_agree() -> None:
    graphs = [chain(rng=np.random.default_rng(4)) for _ in range(2)]
    for graph, incremental in zip(graphs, (False, True), strict=True):
        graph.optimise(incremental=incremental)
        graph.between(0, COUNT, TRUTH[-1], ODOMETRY)
        for _ in range(5):
            graph.optimise(incremental=incremental)
    np.testing.assert_allclose(graphs[0].poses(), graphs[1].poses(), atol=1e-3)
    np.testing.assert_allclose(graphs[0].covariance(7), graphs[1].covariance(7), rtol=1e-2, atol=1e-6)


def test_a_pose_at_a_time_gives_what_all_at_once_give() -> None:
    steps, whole = Graph(), chain(rng=np.random.default_rng(5))
    whole.optimise()
    rng = np.random.default_rng(5)
    steps.prior(steps.add_pose(), np.eye(4), TIGHT)
    for k in range(COUNT):
        noise = rng.normal(size=6) * np.repeat(ODOMETRY, 3)
        steps.between(k, steps.add_pose(), STEP @ se3_exp(noise), ODOMETRY)
        steps.optimise(incremental=True)
    np.testing.assert_allclose(steps.poses(), whole.poses(), atol=1e-6)


def test_edges_may_come_in_any_order_and_direction() -> None:
    graph = Graph()
    for _ in range(COUNT + 1):
        graph.add_pose()
    for k in reversed(range(COUNT)):
        graph.between(k + 1, k, invert(STEP), ODOMETRY)
    graph.prior(COUNT, TRUTH[-1], TIGHT)
    graph.optimise()
    np.testing.assert_allclose(graph.poses(), TRUTH, atol=1e-8)


@pytest.mark.parametrize("incremental", [False, True])
def test_a_true_loop_is_believed_and_a_false_one_is_not(incremental: bool) -> None:
    graph = chain(rng=np.random.default_rng(6))
    graph.optimise(incremental=incremental)
    drift_m = np.linalg.norm((graph.poses() - TRUTH)[-1, :3, 3])
    true = graph.loop(0, COUNT, TRUTH[-1], (0.005, 0.01))
    false = graph.loop(2, COUNT // 2, np.eye(4), (0.005, 0.01))
    result = graph.optimise(incremental=incremental)
    assert (result.accepted, result.rejected) == ((true,), (false,))
    assert np.linalg.norm((graph.poses() - TRUTH)[-1, :3, 3]) < 0.2 * drift_m
    reports = graph.loops()
    assert [report.decision for report in reports] == [LoopDecision.ACCEPTED, LoopDecision.REJECTED]
    assert reports[0].weight > 0.3 and reports[1].weight == 0.0
    assert "beyond" in reports[1].reason


def test_a_false_loop_inside_of_a_wide_gate_is_taken_out_when_the_rest_contradicts_it() -> None:
    graph = Graph()
    graph.prior(graph.add_pose(), np.eye(4), TIGHT)
    for k in range(10):
        graph.between(k, graph.add_pose(), transform(np.eye(3), np.array([1.0, 0.0, 0.0])), (0.1, 0.5))
    wrong = transform(np.eye(3), np.array([9.0, 1.0, 0.0]))
    number = graph.loop(0, 10, wrong, (0.01, 0.01))
    assert graph.optimise().accepted == (number,)
    graph.prior(10, transform(np.eye(3), np.array([10.0, 0.0, 0.0])), (0.01, 0.01))
    assert graph.optimise().rejected == (number,)
    np.testing.assert_allclose(graph.poses()[10, :3, 3], [10.0, 0.0, 0.0], atol=1e-3)


def inertial(count: int = 16) -> tuple[World, Graph]:
    """A world whose samples have a bias and no noise, and its graph of inertial spans."""
    quiet = ImuNoise(0.0, 0.0, 0.0, 0.0, 200.0)
    world = World(duration_s=count / 5.0, noise=quiet, walk=False, gyro_bias=np.array([0.01, -0.02, 0.005]))
    graph = Graph(imu=SILENT, gravity_m_s2=GRAVITY_M_S2)
    graph.prior(graph.add_pose(), world.truth[0], TIGHT)
    for k in range(1, count):
        graph.add_pose()
        span = world.span(k)
        graph.imu(k - 1, k, span.t_ns, span.gyro_rad_s, span.accel_m_s2)
    return world, graph


@pytest.mark.parametrize("incremental", [False, True])
def test_inertial_samples_give_velocity_and_biases_beside_odometry(incremental: bool) -> None:
    world, graph = inertial()
    for k in range(1, len(graph)):
        graph.between(k - 1, k, invert(world.truth[k - 1]) @ world.truth[k], (1e-3, 1e-3))
    for _ in range(3 if incremental else 1):
        graph.optimise(incremental=incremental)
    np.testing.assert_allclose(graph.poses(), world.truth[: len(graph)], atol=1e-3)
    np.testing.assert_allclose(graph.velocities(), world.velocity[: len(graph)], atol=0.01)
    np.testing.assert_allclose(graph.biases()[:, :3], np.tile(world.gyro_bias, (len(graph), 1)), atol=1e-3)
    np.testing.assert_allclose(graph.biases()[-1, 3:], world.accel_bias, atol=0.02)


def test_inertial_samples_alone_carry_a_pose_whose_state_is_given() -> None:
    world, graph = inertial(4)
    graph.velocity(0, world.velocity[0], 1e-3)
    graph.bias(0, world.gyro_bias, world.accel_bias, 1e-5, 1e-4)
    graph.optimise()
    np.testing.assert_allclose(graph.poses(), world.truth[:4], atol=1e-3)


def see_landmarks(rig: Rig, sigma_px: float = 0.5) -> tuple[Graph, np.ndarray, np.ndarray]:
    """Three poses beside one another, the last without odometry to speak of, and landmarks that all of them see."""
    rng = np.random.default_rng(8)
    points = rng.uniform([3.0, -1.5, -1.0], [6.0, 1.5, 1.0], (25, 3))
    truth = np.stack(
        [transform(Rotation.from_euler("z", 0.05 * k).as_matrix(), np.array([0.1 * k, -0.3 * k, 0])) for k in range(3)]
    )
    graph = Graph(rig=rig)
    graph.prior(graph.add_pose(), truth[0], TIGHT)
    graph.between(0, graph.add_pose(), invert(truth[0]) @ truth[1], (1e-3, 1e-3))
    graph.between(1, graph.add_pose(), invert(truth[1]) @ truth[2] @ se3_exp(np.full(6, 0.02)), (0.3, 1.0))
    for point in points:
        landmark = graph.add_landmark()
        for k, T in enumerate(truth):
            for camera, (lens, T_body_cam) in enumerate(zip(rig.cameras, rig.T_body_cams, strict=True)):
                pixel = lens.project((invert(T @ T_body_cam) @ np.append(point, 1.0))[None, :3])[0]
                graph.view(k, landmark, pixel, sigma_px, camera)
    return graph, truth, points


T_BODY_CAM = transform(R_BODY_CAM, np.array([0.05, 0.02, 0.0]))
STEREO = Rig((LENS, LENS), (T_BODY_CAM, T_BODY_CAM @ transform(np.eye(3), np.array([0.11, 0.0, 0.0]))))


@pytest.mark.parametrize("rig", [RIG, Rig((LENS,), (T_BODY_CAM,)), STEREO], ids=["pinhole", "distorted", "stereo"])
def test_landmarks_tie_poses_through_any_lens(rig: Rig) -> None:
    graph, truth, points = see_landmarks(rig)
    graph.optimise()
    np.testing.assert_allclose(graph.poses(), truth, atol=1e-4)
    np.testing.assert_allclose(graph.landmarks(), points, atol=1e-3)
    assert np.all(np.sqrt(np.diag(graph.covariance(2))) < 0.05)


def test_a_landmark_is_placed_as_soon_as_rays_cross() -> None:
    graph = Graph(rig=RIG)
    graph.prior(graph.add_pose(), np.eye(4), TIGHT)
    landmark = graph.add_landmark()
    point = np.array([4.0, 0.2, 0.1, 1.0])
    graph.view(0, landmark, RIG.cameras[0].project((invert(RIG.T_body_cams[0]) @ point)[None, :3])[0])
    graph.optimise()
    assert np.isnan(graph.landmarks()).all()
    assert "landmarks 1 (0 placed)" in repr(graph)
    T = transform(np.eye(3), np.array([0.0, 0.5, 0.0]))
    graph.between(0, graph.add_pose(), T, TIGHT)
    graph.view(1, landmark, RIG.cameras[0].project((invert(T @ RIG.T_body_cams[0]) @ point)[None, :3])[0])
    graph.optimise()
    np.testing.assert_allclose(graph.landmarks(), [point[:3]], atol=1e-3)


def test_a_graph_prints_what_it_is() -> None:
    graph = chain(3)
    assert repr(graph) == "Graph(poses 4, between 3, priors 1; not optimised)"
    graph.loop(0, 3, TRUTH[3], ODOMETRY)
    graph.optimise()
    assert repr(graph).startswith("Graph(poses 4, between 3, priors 1, loops 1 (1 believed); cost ")
    assert repr(graph).endswith("by batch-lm)")


BROKEN = np.diag([1.0, 1.0, 1.1, 1.0])


@pytest.mark.parametrize(
    ("call", "error", "says"),
    [
        (lambda g: g.between(0, 9, np.eye(4), ODOMETRY), UsageError, "no pose 9"),
        (lambda g: g.between(0, -1, np.eye(4), ODOMETRY), UsageError, "no pose -1"),
        (lambda g: g.between(1, 1, np.eye(4), ODOMETRY), UsageError, "to itself"),
        (lambda g: g.loop(0, 9, np.eye(4), ODOMETRY), UsageError, "no pose 9"),
        (lambda g: g.prior(9, np.eye(4), ODOMETRY), UsageError, "no pose 9"),
        (lambda g: g.covariance(9), UsageError, "no pose 9"),
        (lambda g: g.covariance(), UsageError, "which poses"),
        (lambda g: g.between(0, 1, BROKEN, ODOMETRY), DataError, "edge from pose 0 to 1: .*rigid"),
        (lambda g: g.between(0, 1, np.eye(3), ODOMETRY), DataError, "4x4"),
        (lambda g: g.between(0, 1, np.full((4, 4), np.nan), ODOMETRY), DataError, "finite"),
        (lambda g: g.between(0, 1, "near", ODOMETRY), DataError, "array of numbers"),
        (lambda g: g.add_pose(BROKEN), DataError, "guess of pose 4"),
        (lambda g: g.between(0, 1, np.eye(4), (0.1, -0.1)), DataError, "positive"),
        (lambda g: g.between(0, 1, np.eye(4), (0.1, 0.1, 0.1)), DataError, "noise is"),
        (lambda g: g.between(0, 1, np.eye(4), -np.eye(6)), DataError, "eigenvalue"),
        (lambda g: g.between(0, 1, np.eye(4), np.diag([1.0] * 5 + [0.0])), DataError, "eigenvalue"),
        (lambda g: g.velocity(0, [1.0, 2.0], 0.1), DataError, "three finite numbers"),
        (lambda g: g.velocity(0, [1.0, 2.0, 3.0], 0.0), DataError, "sigma"),
        (lambda g: g.imu(0, 1, [0, 1], np.zeros((2, 3)), np.zeros((2, 3))), UsageError, "no IMU"),
        (lambda g: g.view(0, 0, [1.0, 2.0]), UsageError, "0 landmarks"),
    ],
)
def test_what_cannot_be_used_is_refused_by_name_and_leaves_the_graph_as_it_was(call, error, says) -> None:
    graph = chain(3)
    graph.optimise()
    before, poses = repr(graph), graph.poses()
    with pytest.raises(error, match=says):
        call(graph)
    graph.optimise()
    assert repr(graph) == before
    np.testing.assert_allclose(graph.poses(), poses, atol=1e-12)


def test_inertial_samples_that_do_not_fit_are_refused() -> None:
    graph = Graph(imu=SILENT)
    graph.add_pose(), graph.add_pose()
    times = np.arange(0, 10**8, 5 * 10**6)
    still = np.tile([0.0, 0.0, 9.81], (len(times), 1))
    for t_ns, gyro, says in (
        (times * 1e-9, 0 * still, "whole times in ns"),
        (times[::-1], 0 * still, "increase"),
        (times[:1], 0 * still[:1], "two whole times"),
        (times, 0 * still[1:], "20 stamps"),
        (times, np.nan * still, "NaN"),
        (np.append(times[:-1], 60 * 10**9), 0 * still, "holes"),
    ):
        with pytest.raises(DataError, match=says):
            graph.imu(0, 1, t_ns, gyro, still[: len(t_ns)])
    assert "IMU" not in repr(graph)


def test_views_that_do_not_fit_are_refused() -> None:
    graph = Graph(rig=RIG)
    graph.add_pose(), graph.add_landmark()
    with pytest.raises(UsageError, match="no camera 1"):
        graph.view(0, 0, [10.0, 20.0], camera=1)
    with pytest.raises(DataError, match="two numbers"):
        graph.view(0, 0, [10.0, 20.0, 30.0])
    with pytest.raises(DataError, match="no ray"):
        graph.view(0, 0, [np.nan, 20.0])


def test_poses_that_hang_on_nothing_are_named() -> None:
    graph = Graph()
    graph.add_pose()
    with pytest.raises(UsageError, match="1 of 1 poses, first 0, hang on nothing"):
        graph.optimise()
    graph.prior(0, np.eye(4), TIGHT)
    graph.optimise()
    graph.loop(0, graph.add_pose(), np.eye(4), ODOMETRY)  # a loop may be false, so it holds no pose
    with pytest.raises(UsageError, match="1 of 2 poses, first 1"):
        graph.optimise()
    with pytest.raises(UsageError, match="pose 1 came after"):
        graph.poses()
    graph.between(0, 1, np.eye(4), ODOMETRY)
    assert graph.optimise().accepted == (0,)


def test_what_measurements_leave_open_has_no_covariance() -> None:
    graph = Graph(rig=RIG)
    graph.prior(graph.add_pose(), np.eye(4), TIGHT)
    graph.add_pose(np.eye(4))
    landmark = graph.add_landmark([4.0, 0.0, 0.0])
    pixel = RIG.cameras[0].project((invert(RIG.T_body_cams[0]) @ [4.0, 0.0, 0.0, 1.0])[None, :3])[0]
    graph.view(0, landmark, pixel)
    graph.view(1, landmark, pixel)
    with pytest.raises(VislamError):
        graph.optimise()
        graph.covariance(1)
