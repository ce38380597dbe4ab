"""Covariances of pose-graph solutions, against gtsam, against dense inverses and against simulation."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.solver import levenberg_marquardt
from vislam.batch.posegraph.starts import chordal_start
from vislam.batch.posegraph.structure import Structure
from vislam.batch.posegraph.uncertainty import Uncertainty, ellipses
from vislam.batch.posegraph.worlds import Shape, simulate_graph
from vislam.config import GraphWorldConfig
from vislam.core.errors import DataError, UsageError

Array = np.ndarray
SHAPES: tuple[Shape, ...] = ("sphere", "manhattan")


def _solved(problem: PoseGraphProblem) -> Array:
    structure, ones = Structure(problem), np.ones(len(problem.edges))
    return levenberg_marquardt(structure, chordal_start(structure, ones), ones, iterations=50, tolerance=1e-12).poses


def _made(shape: Shape, poses: int = 80) -> tuple[PoseGraphProblem, Array]:
    """A graph with full information matrices and ids that have gaps, at its minimum."""
    made = simulate_graph(shape, GraphWorldConfig(poses=poses, seed=2, anisotropy=2.0))
    rng = np.random.default_rng(5)
    k = made.problem.tangent
    A = rng.normal(size=(len(made.problem.edges), k, k))
    problem = replace(
        made.problem,
        ids=3 * made.problem.ids + 7,
        information=made.problem.information + 30.0 * A @ A.transpose(0, 2, 1),
    )
    return problem, _solved(problem)


def _gtsam_marginals(problem: PoseGraphProblem, poses: Array) -> gtsam.Marginals:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    space = problem.dimension == 3

    def pose(T: Array) -> gtsam.Pose3 | gtsam.Pose2:
        return gtsam.Pose3(T) if space else gtsam.Pose2(T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0]))

    order = range(6) if space else (1, 2, 0)
    between = gtsam.BetweenFactorPose3 if space else gtsam.BetweenFactorPose2
    for (i, j), Z, W in zip(problem.edges.tolist(), problem.measurements, problem.information, strict=True):
        model = gtsam.noiseModel.Gaussian.Information(W[np.ix_(order, order)])
        graph.add(between(i, j, pose(Z), model))
    for i, T in enumerate(poses):
        values.insert(i, pose(T))
    prior = gtsam.PriorFactorPose3 if space else gtsam.PriorFactorPose2
    graph.add(prior(0, pose(poses[0]), gtsam.noiseModel.Isotropic.Sigma(problem.tangent, 1e-7)))
    return gtsam.Marginals(graph, values)


@pytest.mark.parametrize("shape", SHAPES)
def test_covariances_are_those_of_gtsam(shape: Shape) -> None:
    problem, poses = _made(shape)
    uncertainty, peer = Uncertainty(problem, poses), _gtsam_marginals(problem, poses)
    own = np.arange(6) if problem.dimension == 3 else np.array([2, 0, 1])  # gtsam has x y angle in the plane
    chosen = np.array([0, 3, 41, 79])
    for i, covariance in zip(chosen.tolist(), uncertainty.of(problem.ids[chosen]), strict=True):
        theirs = peer.marginalCovariance(i)[np.ix_(own, own)]
        assert np.allclose(covariance, theirs, rtol=1e-5, atol=1e-6 * np.abs(theirs).max() + 1e-13)
    for i, j in ((3, 60), (60, 3), (0, 20), (20, 0)):
        joint = peer.jointMarginalCovariance([i, j])
        Sii, Sij, Sjj = (joint.at(a, b)[np.ix_(own, own)] for a, b in ((i, i), (i, j), (j, j)))
        T = np.linalg.inv(poses[j]) @ poses[i]
        if problem.dimension == 3:
            Ad = gtsam.Pose3(T).AdjointMap()
        else:
            Ad = gtsam.Pose2(T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])).AdjointMap()[np.ix_(own, own)]
        expected = Ad @ Sii @ Ad.T - Ad @ Sij - (Ad @ Sij).T + Sjj
        got = uncertainty.relative(problem.ids[[[i, j]]])[0]
        assert np.allclose(got, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("poses", [2, 3, 400])
def test_all_at_once_and_one_by_one_agree(shape: Shape, poses: int) -> None:
    problem, solution = _made(shape, poses)
    uncertainty = Uncertainty(problem, solution)
    together = uncertainty.of_all()
    assert np.all(together[0] == 0.0), "the anchor is certain"
    chosen = np.arange(0, poses, max(poses // 10, 1))
    assert np.allclose(together[chosen], uncertainty.of(problem.ids[chosen]), rtol=1e-8, atol=1e-14)
    assert np.array_equal(together, together.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(together[1:]).min() > 0.0


@pytest.mark.parametrize("shape", SHAPES)
def test_errors_of_simulated_solutions_are_as_large_as_said(shape: Shape) -> None:
    """Normalised squared errors of 30 noise draws have the mean that their dimension says (5 sigma)."""
    last, pair, errors, relative = 59, (20, 50), [], []
    for seed in range(30):
        made = simulate_graph(
            shape, GraphWorldConfig(poses=60, seed=seed, rotation_sigma_deg=0.3, translation_sigma_m=0.01)
        )
        problem, poses = made.problem, _solved(made.problem)
        uncertainty = Uncertainty(problem, poses)

        def normalised(T: Array, true: Array, covariance: Array, problem: PoseGraphProblem = problem) -> float:
            two, none = np.stack([np.eye(len(T)), T]), np.zeros(2, dtype=bool)
            edge = PoseGraphProblem(
                problem.dimension, np.arange(2), two, none, np.array([[0, 1]]), true[None].copy(),
                np.linalg.inv(covariance)[None],
            )  # fmt: skip
            return edge.chi2(edge.poses)

        # the solution's first pose is the true one, by the anchor
        errors.append(normalised(poses[last], made.truth[last], uncertainty.of(np.array([last]))[0]))
        T, true = (np.linalg.inv(P[pair[0]]) @ P[pair[1]] for P in (poses, made.truth))
        relative.append(normalised(T, true, uncertainty.relative(np.array([pair]))[0]))
    k = problem.tangent
    for values in (errors, relative):
        assert np.mean(values) == pytest.approx(k, abs=5.0 * np.sqrt(2.0 * k / 30))


def test_ellipses_hold_their_probability_and_lie_where_the_pose_is() -> None:
    rng = np.random.default_rng(1)
    problem, poses = _made("sphere")
    covariance = Uncertainty(problem, poses).of_all()[40:41]
    for axes in ((0, 1), (2, 0)):
        outline = ellipses(poses[40:41], covariance, 0.9, axes)[0]
        assert np.allclose(outline[:-1].mean(axis=0), poses[40, axes, 3], atol=1e-9)
        draws = (
            poses[40, :3, 3] + rng.multivariate_normal(np.zeros(3), covariance[0, 3:, 3:], 20000) @ poses[40, :3, :3].T
        )
        from matplotlib.path import Path as Outline

        inside = Outline(outline).contains_points(draws[:, axes]).mean()
        assert inside == pytest.approx(0.9, abs=0.015)
    twice = ellipses(poses[40:41], covariance, 0.9, enlarged=2.0)[0]
    once = ellipses(poses[40:41], covariance, 0.9)[0]
    centre = poses[40, :2, 3]
    assert np.allclose(twice - centre, 2.0 * (once - centre))
    assert ellipses(poses[:0], covariance[:0]).shape[0] == 0


def test_rejected_edges_and_undetermined_poses() -> None:
    problem, poses = _made("manhattan")
    weights = np.ones(len(problem.edges))
    loops = np.flatnonzero(np.diff(problem.edges, axis=1)[:, 0] > 1)
    weights[loops] = 0.0
    last = problem.ids[-1:]
    with_loops, without = Uncertainty(problem, poses).of(last)[0], Uncertainty(problem, poses, weights).of(last)[0]
    assert np.trace(without[1:, 1:]) > 3.0 * np.trace(with_loops[1:, 1:])
    blind = problem.information.copy()
    blind[(problem.edges == len(poses) - 1).any(axis=1)] = np.diag([1.0, 0.0, 0.0])
    with pytest.raises(DataError, match="undetermined"):
        Uncertainty(replace(problem, information=blind), poses)
    with pytest.raises(UsageError, match="no pose 8"):
        Uncertainty(problem, poses).of(np.array([7, 8]))
    apart = weights.copy()
    apart[(problem.edges == 40).any(axis=1)] = 0.0
    cut = Uncertainty(problem, poses, apart)
    with pytest.raises(UsageError, match="connect"):
        cut.relative(problem.ids[[[3, 40]]])
    assert np.all(cut.of(problem.ids[40:41]) == 0.0), "alone, it is its own anchor"
