"""Pose graphs optimised: from every start, with parts, fixed poses and what is missing."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vislam.batch.posegraph import certificate as graph_certificate
from vislam.batch.posegraph import structure as graph_structure
from vislam.batch.posegraph.g2o import read_g2o
from vislam.batch.posegraph.optimize import optimize_pose_graph
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.uncertainty import Uncertainty
from vislam.batch.posegraph.worlds import simulate_graph
from vislam.config import GraphWorldConfig, PoseGraphConfig
from vislam.core.errors import UsageError
from vislam.core.geometry import invert, se3_exp

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from benchmarks.peers.gtsam_route import gtsam_levenberg_marquardt

BEST = {  # chi2; gtsam's Levenberg-Marquardt from certified optima
    "intel": 45.0042331, "MIT": 41.2069469, "manhattan": 3549.04107, "M3500": 137.914878,
    "smallGrid3D": 1035.85066, "sphere2500": 1351.40193, "parking-garage": 1.26838480, "tinyGrid3D": 18.627819,
}  # fmt: skip


def world(d, n=60, loops=40, seed=0, sigma=0.02):
    """Return a problem of a walk with loops, its poses chained from odometry, and the truth."""
    rng = np.random.default_rng(seed)

    def lift(xi):  # a tangent of the plane as one of space
        return xi if d == 3 else np.array([0.0, 0.0, xi[0], xi[1], xi[2], 0.0])

    def lower(T):
        return T if d == 3 else T[np.ix_([0, 1, 3], [0, 1, 3])]

    k = 3 * (d - 1)
    steps = [
        se3_exp(lift(np.concatenate([rng.normal(size=k // 2 if d == 3 else 1) * 0.3, [1.0] + [0.0] * (d - 1)])))
        for _ in range(n - 1)
    ]
    truth = [np.eye(4)]
    for step in steps:
        truth.append(truth[-1] @ step)
    pairs = [(i, i + 1) for i in range(n - 1)]
    while len(pairs) < n - 1 + loops:
        i, j = rng.integers(0, n, 2).tolist()
        if abs(i - j) > 1:
            pairs.append((i, j))
    Z = [invert(truth[i]) @ truth[j] @ se3_exp(lift(rng.normal(size=k) * sigma)) for i, j in pairs]
    drifted = [np.eye(4)]
    for T in Z[: n - 1]:
        drifted.append(drifted[-1] @ T)
    information = np.tile(np.eye(k) / sigma**2, (len(pairs), 1, 1))
    as_array = [np.ascontiguousarray([lower(T) for T in many]) for many in (drifted, Z, truth)]
    problem = PoseGraphProblem(
        d, 10 * np.arange(n), as_array[0], np.zeros(n, bool), np.array(pairs), as_array[1], information
    )  # fmt: skip
    return problem, as_array[2]


@pytest.mark.parametrize("d", [2, 3])
def test_all_starts_and_gtsam_find_the_same_optimum(d):
    problem, truth = world(d)
    first = optimize_pose_graph(problem)
    assert first.converged
    assert first.start_costs[first.start_name] == min(first.start_costs.values())
    assert list(first.costs) == sorted(first.costs, reverse=True)
    freedom = problem.tangent * (len(problem.edges) - len(problem.ids) + 1)
    assert 0.7 < first.costs[-1] / freedom < 1.4
    assert np.abs(first.poses - truth)[:, :d, d].max() < 1.0
    for start in ("file", "odometry", "tree", "chordal", *(["angles"] if d == 2 else [])):
        again = optimize_pose_graph(problem, PoseGraphConfig(start=start))
        assert again.costs[-1] == pytest.approx(first.costs[-1], rel=1e-7)
        assert again.poses == pytest.approx(first.poses, abs=1e-4)
    assert gtsam_levenberg_marquardt(problem, first.start).costs[-1] == pytest.approx(first.costs[-1], rel=1e-6)
    twice = optimize_pose_graph(problem)
    assert twice.poses.tobytes() == first.poses.tobytes()


@pytest.mark.parametrize("d", [2, 3])
def test_parts_are_anchored_each_and_fixed_poses_stay(d):
    problem, _ = world(d)
    keep = np.all((problem.edges < 20) | (problem.edges == 20), axis=1) | np.all(problem.edges > 30, axis=1)
    fixed = problem.fixed.copy()
    fixed[[5, 12]] = True
    poses = problem.poses.copy()
    poses[12, 0, d] += 0.3
    apart = replace(
        problem, fixed=fixed, poses=poses, edges=problem.edges[keep], measurements=problem.measurements[keep],
        information=problem.information[keep],
    )  # fmt: skip
    solution = optimize_pose_graph(apart)
    assert solution.parts == 1 + 10 + 1  # 0 to 20, ten lone ones, 31 to the end
    assert "12 parts" in " ".join(solution.notes)
    assert np.allclose(solution.poses[[5, 12, 25, 31]], poses[[5, 12, 25, 31]], atol=1e-9)
    assert solution.converged
    assert solution.costs[-1] < apart.chi2(poses)


@pytest.mark.parametrize("shape", ["torus", "manhattan"])
def test_conjugate_gradients_find_the_same_optimum(shape):
    problem = simulate_graph(shape, GraphWorldConfig(poses=1000, loops_per_pose=2.0)).problem
    fixed = problem.fixed.copy()
    fixed[[5, 120]] = True
    edges = problem.edges
    keep = np.all(edges < 700, axis=1) | np.all(edges > 700, axis=1)  # two parts and a lone pose
    apart = replace(
        problem, fixed=fixed, edges=edges[keep], measurements=problem.measurements[keep],
        information=problem.information[keep],
    )  # fmt: skip
    for made in (problem, apart):
        best = optimize_pose_graph(made)
        other = optimize_pose_graph(made, PoseGraphConfig(equations="gradients"))
        assert other.converged
        assert other.costs[-1] == pytest.approx(best.costs[-1], rel=1e-7)
        assert np.abs(other.poses - best.poses).max() < 0.02
    again = optimize_pose_graph(apart, PoseGraphConfig(equations="gradients"))
    assert again.poses.tobytes() == other.poses.tobytes()


def test_what_needs_a_factor_says_so_where_it_is_too_large(monkeypatch):
    problem = simulate_graph("torus", GraphWorldConfig(poses=300, loops_per_pose=4.0)).problem
    for module in (graph_structure, graph_certificate):
        monkeypatch.setattr(module, "FACTOR_MAX_BYTES", 100_000)
    solution = optimize_pose_graph(problem)
    assert solution.converged
    certificate = graph_certificate.certify(problem, solution.poses)
    assert not certificate.certified
    assert "factor" in certificate.reason
    with pytest.raises(UsageError, match="300 poses and 1499 edges"):
        Uncertainty(problem, solution.poses)
    with pytest.raises(UsageError, match="fills a factor"):
        optimize_pose_graph(problem, PoseGraphConfig(robust="gnc"))


def test_a_long_walk_in_the_plane_starts_from_angles():
    made = simulate_graph("manhattan", GraphWorldConfig(poses=10_000))
    solution = optimize_pose_graph(made.problem)
    assert solution.start_name == "angles"  # the chordal relaxation fades over 10,000 poses
    assert len(solution.costs) <= 7
    freedom = 3 * (len(made.problem.edges) - 9_999)
    assert 0.97 < solution.costs[-1] / freedom < 1.03


def test_what_has_no_start_gets_one():
    problem, _ = world(3)
    with pytest.raises(UsageError, match="in the plane"):
        optimize_pose_graph(problem, PoseGraphConfig(start="angles"))
    poses = problem.poses.copy()
    poses[[0, 7, 8, 30]] = np.nan
    best = optimize_pose_graph(problem).costs[-1]
    for start in ("auto", "file", "odometry"):
        solution = optimize_pose_graph(problem.with_poses(poses), PoseGraphConfig(start=start))
        assert solution.costs[-1] == pytest.approx(best, rel=1e-7)
    nothing = optimize_pose_graph(problem.with_poses(np.full_like(poses, np.nan)))
    assert nothing.costs[-1] == pytest.approx(best, rel=1e-7)
    assert "file" not in nothing.start_costs


def test_directions_without_information_do_no_harm():
    problem, _ = world(3)
    information = problem.information.copy()
    information[:, 3:, :] = information[:, :, 3:] = 0.0
    loose = optimize_pose_graph(replace(problem, information=information))
    assert np.isfinite(loose.poses).all()
    assert loose.costs[-1] <= optimize_pose_graph(problem).costs[-1]
    lone = PoseGraphProblem(
        3, np.array([4]), np.full((1, 4, 4), np.nan), np.zeros(1, bool), np.empty((0, 2), np.int64),
        np.empty((0, 4, 4)), np.empty((0, 6, 6)),
    )  # fmt: skip
    assert optimize_pose_graph(lone).poses.tolist() == [np.eye(4).tolist()]


@pytest.mark.data
@pytest.mark.parametrize("name", BEST)
def test_the_best_known_cost_is_reached(data_root, name):
    problem = read_g2o(data_root / "g2o" / f"{name}.g2o")
    solution = optimize_pose_graph(problem)
    assert solution.costs[-1] <= BEST[name] * (1.0 + 1e-6)
    assert len(solution.costs) <= 10
    assert not any("--robust auto" in note for note in solution.notes)
