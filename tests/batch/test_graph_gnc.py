"""False loops are found and left out; true ones stay, whatever scale the stated variances have."""

from dataclasses import replace

import numpy as np
import pytest
from test_graph_optimize import world

from vislam.batch.posegraph.gnc import joining_edges
from vislam.batch.posegraph.optimize import optimize_pose_graph
from vislam.config import PoseGraphConfig


def _with_false_loops(problem, count, seed):
    """Return the problem with `count` loops that say of random poses what others say of theirs."""
    rng = np.random.default_rng(seed)
    ends = rng.integers(0, len(problem.ids), (8 * count, 2))
    ends = ends[np.abs(ends[:, 0] - ends[:, 1]) > 1][:count]
    like = rng.choice(np.flatnonzero(np.abs(np.diff(problem.edges, axis=1)[:, 0]) > 1), count)
    return replace(
        problem,
        edges=np.concatenate([problem.edges, ends]),
        measurements=np.concatenate([problem.measurements, problem.measurements[like]]),
        information=np.concatenate([problem.information, problem.information[like]]),
    )


@pytest.mark.parametrize("robust", ["gnc", "auto"])
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("overstated", [1.0, 1e4])
def test_half_of_the_loops_may_be_false(d, overstated, robust):
    problem, _ = world(d, n=120, loops=60, seed=3)
    problem = replace(problem, information=problem.information / overstated)
    clean = optimize_pose_graph(problem)
    robust = optimize_pose_graph(_with_false_loops(problem, 60, seed=4), PoseGraphConfig(robust=robust))
    true, false = robust.weights[: len(problem.edges)], robust.weights[len(problem.edges) :]
    assert false.sum() == 0
    assert true.mean() > 0.97
    assert robust.rejected.tolist() == np.flatnonzero(robust.weights == 0.0).tolist()
    assert np.abs(robust.poses - clean.poses)[:, :d, d].max() < 0.1
    plain = optimize_pose_graph(_with_false_loops(problem, 60, seed=4))
    assert np.abs(plain.poses - clean.poses)[:, :d, d].max() > 1.0


@pytest.mark.parametrize("robust", ["gnc", "auto"])
@pytest.mark.parametrize("d", [2, 3])
def test_without_false_loops_nothing_is_lost(d, robust):
    problem, _ = world(d, n=80, loops=50, seed=5)
    assert optimize_pose_graph(problem, PoseGraphConfig(robust=robust)).weights.mean() > 0.97
    chain = replace(
        problem, edges=problem.edges[:79], measurements=problem.measurements[:79], information=problem.information[:79]
    )
    alone = optimize_pose_graph(chain, PoseGraphConfig(robust=robust))
    assert alone.weights.tolist() == [1.0] * 79
    assert alone.undecided == ()


def test_parts_are_joined_once_whole():
    few, _ = world(2, n=4, loops=1)
    parts = replace(few, edges=np.array([[0, 1], [2, 3], [1, 2], [0, 3]]))
    assert joining_edges(parts, np.array([True, True, False, False])).tolist() == [False, False, True, False]
