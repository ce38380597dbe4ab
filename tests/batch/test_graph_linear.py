"""The linear algebra of pose graphs against dense matrices, and the derivatives against differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.batch.posegraph.arithmetic import Edges, Normal, linearise_2d, linearise_3d, retract_2d, retract_3d
from vislam.batch.posegraph.cholesky import Factor
from vislam.batch.posegraph.clusters import ClusteredSolver, Clusters
from vislam.batch.posegraph.ordering import adjacency, minimum_degree
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.symbolic import analyse
from vislam.core.geometry import se3_exp


def _system(rng, n, a, b, d):
    """Return the blocks of a random positive definite matrix of the graph, and the matrix."""
    symbolic = analyse(n, a, b)
    diagonal, off, A = np.tile(0.1 * np.eye(d), (n, 1, 1)), np.zeros((len(a), d, d)), 0.1 * np.eye(n * d)
    for e, ends in enumerate(zip(a, b, strict=True)):
        J = rng.normal(size=(2, d, d))
        at = [slice(i * d, (i + 1) * d) for i in ends]
        for i, s, Ji in zip(ends, at, J, strict=True):
            if i >= 0:
                diagonal[i] += Ji.T @ Ji
                A[s, s] += Ji.T @ Ji
        if min(ends) >= 0:
            A[at[0], at[1]] += J[0].T @ J[1]
            A[at[1], at[0]] += J[1].T @ J[0]
            off[e] = (J[1].T @ J[0] if symbolic.later_is_to[e] else J[0].T @ J[1]).T
    return symbolic, diagonal, off, A


@given(st.integers(1, 60), st.integers(0, 200), st.sampled_from([1, 2, 3, 6]), st.integers(0, 10**6), st.booleans())
@settings(deadline=None, max_examples=60)
def test_solutions_are_those_of_the_dense_matrix(n, m, d, seed, chain):
    rng = np.random.default_rng(seed)
    ends = rng.integers(-1 if n > 1 else 0, n, (m, 2))
    if chain:
        ends = np.concatenate([ends, np.column_stack([np.arange(n - 1), np.arange(1, n)])])
    ends = ends[ends[:, 0] != ends[:, 1]]
    symbolic, diagonal, off, A = _system(rng, n, ends[:, 0].copy(), ends[:, 1].copy(), d)
    assert sorted(symbolic.place.tolist()) == list(range(n))
    factor = Factor(symbolic, d)
    assert factor.factorise(diagonal, off)
    rhs = rng.normal(size=(n, d))
    expected = np.linalg.solve(A, rhs.ravel()).reshape(n, d)
    assert np.allclose(factor.solve(rhs), expected, rtol=1e-9, atol=1e-11 * np.abs(expected).max())


@given(st.integers(1, 80), st.integers(0, 60), st.sampled_from([1, 3, 6]), st.integers(1, 20), st.integers(0, 10**6))
@settings(deadline=None, max_examples=40)
def test_conjugate_gradients_solve_what_the_factor_does(n, m, d, size, seed):
    rng = np.random.default_rng(seed)
    ends = rng.integers(-1 if n > 1 else 0, n, (m, 2))
    ends = np.concatenate([ends[ends[:, 0] != ends[:, 1]], np.column_stack([np.arange(n - 1), np.arange(1, n)])])
    symbolic, diagonal, off, A = _system(rng, n, ends[:, 0].copy(), ends[:, 1].copy(), d)
    clusters = Clusters(n, ends, size)
    assert sorted(set(clusters.of.tolist())) == list(range(len(clusters.first)))
    assert np.array_equal(clusters.of[clusters.first], np.arange(len(clusters.first)))
    solver = ClusteredSolver(clusters, d, 1e-10)
    turned = (solver.later_is_to != symbolic.later_is_to)[:, None, None]
    motions = np.eye(d) + 0.2 * rng.normal(size=(n, d, d))
    assert solver.factorise(diagonal, np.where(turned, off.transpose(0, 2, 1), off), motions)
    rhs = rng.normal(size=(n, d))
    assert np.allclose(A @ solver.solve(rhs).ravel(), rhs.ravel(), atol=1e-6)
    assert solver.solve(0.0 * rhs).tolist() == (0.0 * rhs).tolist()
    assert not solver.factorise(-diagonal, off, motions)


def test_large_fronts_and_what_is_not_definite():
    rng = np.random.default_rng(5)
    n = 90
    a, b = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    a, b = a[a < b], b[a < b]
    symbolic, diagonal, off, A = _system(rng, n, a, b, 6)
    factor = Factor(symbolic, 6)
    assert factor.factorise(diagonal, off)
    rhs = rng.normal(size=(n, 6))
    assert np.allclose(A @ factor.solve(rhs).ravel(), rhs.ravel(), atol=1e-9)
    for bad in (-1e3, np.nan):
        worse = diagonal.copy()
        worse[17, 2, 2] = bad
        assert not factor.factorise(worse, off)
    assert factor.factorise(diagonal, off)


@given(st.integers(1, 80), st.integers(0, 300), st.integers(0, 10**6))
@settings(deadline=None, max_examples=100)
def test_orderings_are_permutations(n, m, seed):
    rng = np.random.default_rng(seed)
    a, b = rng.integers(0, n, (2, m))
    a, b = a[a != b], b[a != b]
    begins, neighbours = adjacency(n, a, b)
    for i in range(n):
        expected = set(b[a == i].tolist()) | set(a[b == i].tolist())
        assert sorted(neighbours[begins[i] : begins[i + 1]].tolist()) == sorted(expected)
    assert sorted(minimum_degree(begins, neighbours).tolist()) == list(range(n))


def test_a_grid_and_a_star_stay_sparse():
    side = 30
    place = np.arange(side * side).reshape(side, side)
    a = np.concatenate([place[:, :-1].ravel(), place[:-1].ravel()])
    b = np.concatenate([place[:, 1:].ravel(), place[1:].ravel()])
    assert analyse(side * side, a, b).blocks < 25 * side * side  # in rows it would be 30 n, by nested dissection 14 n
    hub = analyse(2000, np.zeros(1999, dtype=np.int64), np.arange(1, 2000))
    assert hub.blocks < 20 * 2000


def _pose(rng, d, size):
    if d == 3:
        return se3_exp(np.concatenate([rng.normal(size=3) * size, rng.normal(size=3) * 2]))
    angle = rng.normal() * size
    T = np.eye(3)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[:2, 2] = rng.normal(size=2) * 2
    return T


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("size", [1e-6, 1e-3, 0.06, 0.7, 2.0])
def test_derivatives_are_exact(d, size):
    rng = np.random.default_rng(int(1e6 * size))
    k = 3 * (d - 1)
    poses, Z = np.array([_pose(rng, d, size) for _ in range(2)]), _pose(rng, d, size)[None]
    W = rng.normal(size=(1, k, k))
    problem = PoseGraphProblem(
        d, np.arange(2), poses, np.zeros(2, bool), np.array([[0, 1]]), Z, W @ W.transpose(0, 2, 1)
    )
    linearise, retract = (linearise_2d, retract_2d) if d == 2 else (linearise_3d, retract_3d)
    diagonal, off, gradient = np.empty((2, k, k)), np.empty((1, k, k)), np.empty((2, k))
    weight, out = np.array([1.7]), np.empty_like(poses)
    later = np.array([True])
    measured = Edges(problem.edges, later, Z, problem.information)
    cost = linearise(measured, np.arange(2), poses, weight, Normal(diagonal, off, gradient))
    assert cost == pytest.approx(problem.chi2(poses, weight), rel=1e-12)
    differences = []
    for step in 1e-6 * np.eye(2 * k).reshape(2 * k, 2, k):
        retract(poses, np.arange(2), step, out)
        upper = problem.chi2(out, weight)
        retract(poses, np.arange(2), -step, out)
        differences.append((upper - problem.chi2(out, weight)) / 4e-6)
    assert np.allclose(gradient.ravel(), differences, atol=1e-7 * np.abs(differences).max() + 1e-9)
    # both ends moved alike leave the error as it is: J_i = -J_j Ad; with the gradient this fixes all blocks
    H = np.block([[diagonal[0], off[0]], [off[0].T, diagonal[1]]])
    eigenvalues = np.linalg.eigvalsh(H)
    assert np.sum(eigenvalues > 1e-9 * eigenvalues[-1]) == k
    assert np.all(np.abs(eigenvalues[:k]) < 1e-9 * eigenvalues[-1])
    off_turned = np.empty_like(off)
    turned = measured._replace(later_is_to=~later)
    linearise(turned, np.arange(2), poses, weight, Normal(diagonal, off_turned, gradient))
    assert np.allclose(off_turned[0], off[0].T)
    fixed = np.array([0, -1])
    only = Normal(np.empty((1, k, k)), np.empty((1, k, k)), np.empty((1, k)))
    linearise(measured, fixed, poses, weight, only)
    assert np.allclose(only[0][0], diagonal[0])
    assert np.allclose(only[2][0], gradient[0])
