"""Where optimisation starts: whatever the frame of the priors and whatever the file lacks, the optimum is found."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_graph_optimize import world

from vislam.batch.posegraph.optimize import optimize_pose_graph
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.solver import levenberg_marquardt
from vislam.batch.posegraph.structure import Structure
from vislam.config import PoseGraphConfig


def in_the_world(seed):
    """A problem with priors in a frame turned and moved by up to 500 km, landmarks, missing poses; and the truth."""
    rng = np.random.default_rng(seed)
    d = int(rng.integers(2, 4))
    problem, truth = world(d, n=40, loops=int(rng.integers(0, 15)), seed=seed)
    frame = np.eye(d + 1)
    frame[:d, :d] = Rotation.random(random_state=seed).as_matrix() if d == 3 else _turned(rng.uniform(-np.pi, np.pi))
    frame[:d, d] = rng.uniform(-1.0, 1.0, d) * 10.0 ** rng.uniform(0.0, 5.7)
    truth = frame @ truth
    n, points = len(truth), int(rng.integers(0, 5))
    landmarks = np.tile(np.eye(d + 1), (points, 1, 1))
    landmarks[:, :d, d] = truth[rng.integers(0, n, points), :d, d] + rng.normal(size=(points, d)) * 3.0
    truth = np.concatenate([truth, landmarks, np.eye(d + 1)[None]])
    at = np.sort(rng.choice(n, int(rng.integers(4, 10)), replace=False))
    full = rng.random(len(at)) < rng.integers(0, 2) * 0.3
    seen = np.array(
        [(i, n + k) for k in range(points) for i in rng.choice(n, 6, replace=False)], dtype=np.int64
    ).reshape(-1, 2)
    ends = np.concatenate([problem.edges, np.column_stack([np.full(len(at), len(truth) - 1), at]), seen])
    is_position = np.concatenate([np.zeros(len(problem.edges), bool), ~full, np.ones(len(seen), bool)])
    between = np.linalg.inv(truth[ends[:, 0]]) @ truth[ends[:, 1]]
    Z = between.copy()
    Z[: len(problem.edges)] = problem.measurements
    Z[is_position, :d, :d] = np.eye(d)
    Z[len(problem.edges) :, :d, d] += rng.normal(size=(len(ends) - len(problem.edges), d)) * 0.05
    k = problem.tangent
    information = np.tile(np.eye(k) / 0.05**2, (len(ends), 1, 1))
    information[: len(problem.edges)] = problem.information
    information[is_position, : k - d] = information[is_position, :, : k - d] = 0.0
    poses = np.concatenate([problem.poses, landmarks, np.eye(d + 1)[None]])
    missing = rng.random(n + points) < rng.choice([0.0, 0.3, 1.0])
    poses[:-1][missing] = np.nan
    fixed = np.arange(len(truth)) == len(truth) - 1
    is_point = (np.arange(len(truth)) >= n) & ~fixed
    graph = PoseGraphProblem(
        d, np.arange(len(truth)), poses, fixed, ends, Z, information, (), (), is_point, is_position, len(truth) - 1
    )
    return graph, truth


def _turned(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@pytest.mark.parametrize("seeds", [range(50), range(50, 100)])
def test_the_optimum_is_found_wherever_the_world_is(seeds):
    missed = []
    for seed in seeds:
        graph, truth = in_the_world(seed)
        ones = np.ones(len(graph.edges))
        best = levenberg_marquardt(Structure(graph), truth, ones, iterations=50, tolerance=1e-12).costs[-1]
        found = optimize_pose_graph(graph).costs[-1]
        if not found <= best * (1.0 + 1e-4):
            missed.append((seed, best, found))
    assert not missed


@pytest.mark.parametrize("seed", range(6))
def test_starts_of_exact_measurements_lie_on_the_priors(seed):
    graph, truth = in_the_world(seed)
    d, measurements = graph.dimension, np.linalg.inv(truth[graph.edges[:, 0]]) @ truth[graph.edges[:, 1]]
    measurements[graph.is_position, :d, :d] = np.eye(d)
    exact = replace(graph, measurements=np.ascontiguousarray(measurements))
    for start in ("chordal", "tree", "odometry"):
        assert optimize_pose_graph(exact, PoseGraphConfig(start=start)).start_costs[start] < 1e-6


def test_starts_that_end_elsewhere_are_counted():
    problem, _ = world(2, n=60, loops=40)
    at = np.flatnonzero(np.abs(np.diff(problem.edges, axis=1)[:, 0]) != 1)[0]
    measurements = problem.measurements.copy()
    measurements[at, :2, 2] += 30.0
    notes = optimize_pose_graph(replace(problem, measurements=measurements)).notes
    assert any("starts were solved" in note and "end with this cost" in note for note in notes)
    assert not any("starts were solved" in note for note in optimize_pose_graph(problem).notes)
