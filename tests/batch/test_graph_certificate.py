"""What is proven of pose-graph solutions: published optima, wrong minima, and bounds that nothing is below."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from vislam.batch.posegraph import certificate as graph_certificate
from vislam.batch.posegraph.arithmetic import retract_3d
from vislam.batch.posegraph.certificate import bounding_weights, certify, isotropic_weights
from vislam.batch.posegraph.files import read_pose_graph
from vislam.batch.posegraph.g2o import write_g2o
from vislam.batch.posegraph.isotropic import IsotropicGraph
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.solver import levenberg_marquardt
from vislam.batch.posegraph.staircase import minimise
from vislam.batch.posegraph.starts import chordal_start, odometry_start
from vislam.batch.posegraph.structure import Structure
from vislam.batch.posegraph.uncertainty import Uncertainty
from vislam.batch.posegraph.worlds import Shape, SimulatedGraph, simulate_graph
from vislam.cli import run_verb
from vislam.config import GraphWorldConfig

Array = np.ndarray

# costs that SE-Sync's authors publish as global minima (IJRR 2019, tables 1 and 2), and those that their program gives
# for the files that the tables do not have
PUBLISHED = {
    "intel": 52.35, "MIT": 61.154, "manhattan": 6431.4, "parking-garage": 1.2625, "sphere2500": 1687.0,
    "smallGrid3D": 1025.40,
}  # fmt: skip


def _solved(problem: PoseGraphProblem, start: Array) -> Array:
    ones = np.ones(len(problem.edges))
    return levenberg_marquardt(Structure(problem), start, ones, iterations=100, tolerance=1e-12).poses


def _beside(first: PoseGraphProblem, second: PoseGraphProblem) -> PoseGraphProblem:
    """Return both as one graph, in two parts."""
    n = len(first.ids)
    return replace(
        first, ids=np.arange(2 * n), poses=np.concatenate([first.poses, second.poses]), fixed=np.zeros(2 * n, bool),
        edges=np.concatenate([first.edges, second.edges + n]),
        measurements=np.concatenate([first.measurements, second.measurements]),
        information=np.concatenate([first.information, second.information]),
    )  # fmt: skip


def _made(shape: Shape, poses: int = 120, **settings: float) -> SimulatedGraph:
    return simulate_graph(shape, GraphWorldConfig(poses=poses, **settings))


@pytest.mark.data
@pytest.mark.parametrize("name", PUBLISHED)
def test_the_published_optimum_is_found_and_proven(name: str, data_root: Path) -> None:
    problem = read_pose_graph(data_root / "g2o" / f"{name}.g2o")
    solution = _solved(problem, chordal_start(Structure(problem), np.ones(len(problem.edges))))
    certificate = certify(problem, solution)
    assert certificate.certified, certificate.reason
    assert certificate.isotropic_cost == pytest.approx(PUBLISHED[name], rel=3e-4)
    assert certificate.isotropic_bound >= certificate.isotropic_cost * (1.0 - 1e-6)
    assert 0.6 * certificate.chi2 < certificate.chi2_bound <= certificate.chi2
    assert certificate.spectral_gap > 1e-5


@pytest.mark.data
def test_out_of_a_wrong_minimum_of_a_real_graph_the_global_one_is_found(data_root: Path) -> None:
    problem = read_pose_graph(data_root / "g2o" / "MIT.g2o")
    certificate = certify(problem, _solved(problem, odometry_start(problem, Structure(problem).anchors)))
    assert certificate.chi2 > 100.0, "chi2 has a local minimum there"
    assert not certificate.certified
    assert certificate.better is not None
    best = certify(problem, certificate.better)
    assert best.certified, best.reason
    assert best.chi2 == pytest.approx(41.2069469, rel=1e-7)


def _ring(n: int, turns: int) -> tuple[PoseGraphProblem, Array]:
    """A ring of equal steps that turns once, and poses that go round `turns` times."""
    angle = 2.0 * np.pi / n

    def turn(a: float) -> Array:
        return np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])

    Z = np.eye(3)
    Z[:2, :2], Z[:2, 2] = turn(angle), [1.0, 0.0]
    poses = np.tile(np.eye(3), (n, 1, 1))
    for i in range(1, n):
        poses[i, :2, :2] = turn(angle * turns * i)
        poses[i, :2, 2] = poses[i - 1, :2, 2] + poses[i - 1, :2, 0]
    edges = np.column_stack([np.arange(n), (np.arange(n) + 1) % n])
    problem = PoseGraphProblem(
        2,
        np.arange(n),
        poses,
        np.zeros(n, dtype=bool),
        edges,
        np.tile(Z, (n, 1, 1)),
        np.tile(100.0 * np.eye(3), (n, 1, 1)),
    )
    return problem, _solved(problem, poses)


@pytest.mark.parametrize(("n", "turns"), [(24, 2), (60, 2), (24, 0), (40, 3)])
def test_a_twisted_ring_is_not_certified_and_leads_to_the_straight_one(n: int, turns: int) -> None:
    problem, twisted = _ring(n, turns)
    certificate = certify(problem, twisted)
    assert certificate.chi2 > 50.0, "a minimum of chi2, of another winding"
    assert not certificate.certified
    assert certificate.better is not None
    assert_allclose(certificate.better[0], twisted[0], atol=1e-12, err_msg="the anchor keeps its pose")
    best = certify(problem, certificate.better)
    assert best.certified, best.reason
    assert best.chi2 < 1e-9


def test_twisted_rings_without_a_joint_are_each_straightened() -> None:
    one, twisted = _ring(24, 2)
    problem = _beside(one, one)
    poses = np.concatenate([twisted, _ring(24, 2)[1]])
    for _ in range(3):
        certificate = certify(problem, poses)
        if certificate.better is None:
            break
        poses = certificate.better
    assert certificate.certified, certificate.reason
    assert certificate.chi2 < 1e-9


def test_a_descent_that_has_not_converged_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    made = _made("sphere")
    solution = _solved(made.problem, made.truth)
    noise = np.random.default_rng(3).normal(scale=0.5, size=(len(solution), 6))
    far = np.empty_like(solution)
    retract_3d(solution, np.arange(len(solution)), noise, far)
    monkeypatch.setattr(graph_certificate, "minimise", lambda graph, X: (X, np.inf))
    certificate = certify(made.problem, far)
    assert certificate.isotropic_cost == pytest.approx(certificate.isotropic_bound, rel=1e-3)
    assert certificate.better is not None
    assert made.problem.chi2(certificate.better) == pytest.approx(made.problem.chi2(solution), rel=1e-7)


def test_where_the_relaxation_is_not_tight_it_says_so() -> None:
    made = _made("grid3d", 60)
    wild = Rotation.from_rotvec(np.random.default_rng(5).normal(scale=3.0, size=(len(made.problem.edges), 3)))
    measurements = made.problem.measurements.copy()
    measurements[:, :3, :3] = wild.as_matrix()
    problem = replace(made.problem, measurements=measurements)
    certificate = certify(problem, _solved(problem, chordal_start(Structure(problem), np.ones(len(problem.edges)))))
    assert not certificate.certified
    assert "the relaxation has its minimum in" in certificate.reason
    assert 0.0 < certificate.isotropic_bound < certificate.isotropic_cost
    rng = np.random.default_rng(0)
    graph = IsotropicGraph(problem, *isotropic_weights(problem))
    for _ in range(5):
        poses = made.truth.copy()
        poses[:, :3, :3] = Rotation.random(len(poses), rng=rng).as_matrix()
        assert graph.value(minimise(graph, poses[:, :3])[0]) >= certificate.isotropic_bound


@pytest.mark.parametrize("shape", ["grid3d", "torus", "sphere", "manhattan"])
def test_made_graphs_are_certified_and_their_bound_is_near(shape: Shape) -> None:
    made = _made(shape)
    certificate = certify(made.problem, _solved(made.problem, made.truth))
    assert certificate.certified, certificate.reason
    assert certificate.chi2_bound <= certificate.chi2
    assert certificate.chi2_bound > 0.98 * certificate.chi2, "isotropic information: both costs are nearly the same"
    if shape != "manhattan":  # in the plane SE-Sync's cost weighs rotations twice
        assert certificate.chi2_bound == pytest.approx(min(certificate.isotropic_bound, certificate.chi2), rel=1e-8)
    assert certificate.least_eigenvalue == pytest.approx(0.0, abs=certificate.tolerance)
    assert certificate.proven_eigenvalue <= certificate.least_eigenvalue + certificate.tolerance


@pytest.mark.parametrize("shape", ["torus", "manhattan"])
@pytest.mark.parametrize("anisotropy", [1.0, 6.0])
def test_the_bounding_cost_is_nowhere_above_chi2(shape: Shape, anisotropy: float) -> None:
    made = _made(shape, anisotropy=anisotropy)
    rng = np.random.default_rng(3)
    k = made.problem.tangent
    A = rng.normal(size=(len(made.problem.edges), k, k))
    problem = replace(made.problem, information=made.problem.information + 30.0 * A @ A.transpose(0, 2, 1))
    graph = IsotropicGraph(problem, *bounding_weights(problem))
    for size in (0.0, 0.01, 0.3, 3.0):
        d = problem.dimension
        noise = rng.normal(size=(len(made.truth), d, d)) * size
        poses = made.truth.copy()
        poses[:, :d, :d], _ = np.linalg.qr(poses[:, :d, :d] + noise)
        poses[:, :d, d - 1] *= np.sign(np.linalg.det(poses[:, :d, :d]))[:, None]
        poses[:, :d, d] += rng.normal(size=(len(poses), d)) * size
        assert graph.value(poses[:, :d]) <= problem.chi2(poses) * (1.0 + 1e-9)
    solution = _solved(problem, made.truth)
    assert certify(problem, solution).chi2_bound <= problem.chi2(solution)


@pytest.mark.parametrize("shape", ["sphere", "manhattan"])
def test_the_eigenvalue_is_that_of_the_dense_matrix(shape: Shape) -> None:
    """The certificate matrix by its definition, translations eliminated by a dense pseudo-inverse."""
    made = _made(shape, poses=25, rotation_sigma_deg=4.0)
    problem, d, n = made.problem, made.problem.dimension, 25
    kappa, tau = isotropic_weights(problem)
    graph = IsotropicGraph(problem, kappa, tau)
    for poses in (minimise(graph, made.truth[:, :d])[0], made.truth[:, :d]):
        M = np.zeros((n * (d + 1), n * (d + 1)))
        for (i, j), Z, k, t in zip(problem.edges, problem.measurements, kappa, tau, strict=True):
            difference = np.zeros((d + 1, n * (d + 1)))
            difference[:, j * (d + 1) : (j + 1) * (d + 1)] = np.eye(d + 1)
            difference[:, i * (d + 1) : (i + 1) * (d + 1)] = -Z.T
            M += difference.T @ np.diag([k] * d + [t]) @ difference
        X = poses[:, :d].transpose(0, 2, 1).reshape(-1, d)
        assert graph.value(poses) == pytest.approx(np.trace(X.T @ M @ X))
        force = (M @ X).reshape(n, d + 1, d)
        for i in range(n):
            L = poses[i, :d, :d].T @ force[i, :d].T
            at = slice(i * (d + 1), i * (d + 1) + d)
            M[at, at] -= 0.5 * (L + L.T)
        is_t = np.arange(n * (d + 1)) % (d + 1) == d
        cross = M[np.ix_(~is_t, is_t)]
        Q = M[np.ix_(~is_t, ~is_t)] - cross @ np.linalg.pinv(M[np.ix_(is_t, is_t)]) @ cross.T
        dense = np.linalg.eigvalsh(Q)
        spectrum = graph.spectrum(poses)
        assert spectrum.least == pytest.approx(dense[0], rel=1e-5, abs=1e-6 * dense[-1] * 1e-3)
        assert spectrum.gap == pytest.approx(dense[d], rel=1e-5)
        assert -spectrum.proven <= dense[0] + spectrum.rounding


def test_two_parts_are_proven_together() -> None:
    first, second = _made("torus", seed=1).problem, _made("torus", seed=2).problem
    n, both = len(first.ids), _beside(first, second)
    solution = _solved(both, chordal_start(Structure(both), np.ones(len(both.edges))))
    whole = certify(both, solution)
    parts = [certify(p, solution[at]) for p, at in ((first, slice(0, n)), (second, slice(n, None)))]
    assert whole.certified
    assert whole.isotropic_cost == pytest.approx(sum(part.isotropic_cost for part in parts))
    assert whole.chi2_bound == pytest.approx(sum(part.chi2_bound for part in parts), rel=1e-6)


def test_a_solution_that_is_no_minimum_comes_back_better() -> None:
    made = _made("sphere")
    certificate = certify(made.problem, made.truth)
    assert not certificate.certified
    assert certificate.better is not None
    assert made.problem.chi2(certificate.better) < 0.99 * certificate.chi2
    assert certify(made.problem, certificate.better).certified


def test_rejected_edges_do_not_count() -> None:
    made = _made("manhattan", outlier_fraction=0.3)
    weights = np.where(made.outlier, 0.0, 1.0)
    clean = replace(
        made.problem, edges=made.problem.edges[~made.outlier], measurements=made.problem.measurements[~made.outlier],
        information=made.problem.information[~made.outlier],
    )  # fmt: skip
    solution = _solved(clean, made.truth)
    assert certify(made.problem, solution, weights).certified
    assert certify(made.problem, solution, weights).chi2 == pytest.approx(clean.chi2(solution))
    assert not certify(made.problem, _solved(made.problem, made.truth)).certified


def test_what_cannot_be_proven_says_why() -> None:
    made = _made("torus")
    solution = _solved(made.problem, made.truth)
    fixed = certify(replace(made.problem, fixed=np.arange(len(solution)) < 2), solution)
    assert not fixed.certified
    assert "fixed" in fixed.reason
    free = made.problem.information.copy()
    last = (made.problem.edges == len(solution) - 1).any(axis=1)
    free[last] = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    loose = certify(replace(made.problem, information=free), solution)
    assert not loose.certified
    assert "translations" in loose.reason


def test_the_verb_tells_and_keeps_the_certificate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = _made("torus")
    path, out = tmp_path / "torus.g2o", tmp_path / "out"
    write_g2o(made.problem, path)
    assert run_verb(["optimize", str(path), "--out", str(out), "--covariances"]) == 0
    assert "\ncertified: " in capsys.readouterr().out
    entry = json.loads((out / "summary.json").read_text())["certificate"]
    assert entry["certified"]
    assert 0.98 * entry["chi2"] < entry["chi2_bound"] <= entry["chi2"]
    assert "certified" in (out / "report.html").read_text()
    rows = np.loadtxt(out / "covariances.csv", delimiter=",", skiprows=1)
    problem = read_pose_graph(out / "optimized.g2o")
    expected = Uncertainty(problem, problem.poses).of(np.array([50]))[0]
    assert np.allclose(rows[50, 1:], expected[np.triu_indices(6)], rtol=1e-5)
    assert run_verb(["optimize", str(path), "--out", str(out), "--no-certify", "--no-report"]) == 0
    assert "certified" not in capsys.readouterr().out
    assert json.loads((out / "summary.json").read_text())["certificate"] is None
