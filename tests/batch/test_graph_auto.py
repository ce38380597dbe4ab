"""`--robust auto`: false loops of every kind go, true ones stay, and what evidence does not decide is said."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from test_graph_gnc import _with_false_loops
from test_graph_optimize import world

from needs import missing
from vislam.batch.posegraph import optimize
from vislam.batch.posegraph.files import read_pose_graph
from vislam.batch.posegraph.noise import covariances_of_edges, noise_of_kinds, rescaled
from vislam.batch.posegraph.optimize import optimize_pose_graph
from vislam.batch.posegraph.solver import kernel_weights
from vislam.batch.posegraph.structure import Structure
from vislam.batch.posegraph.worlds import simulate_graph
from vislam.config import GraphWorldConfig, PoseGraphConfig
from vislam.core.geometry import align_points

AUTO = PoseGraphConfig(robust="auto")


def _city(fraction, group, poses=400):
    return simulate_graph(
        "manhattan", GraphWorldConfig(poses=poses, outlier_fraction=fraction, alias_group=group, seed=3)
    )


def _random_loops():
    """A city whose loops join any poses."""
    problem = _city(0.0, 1, poses=300).problem
    loops = np.flatnonzero(np.abs(np.diff(problem.edges, axis=1)[:, 0]) != 1)
    edges, rng = problem.edges.copy(), np.random.default_rng(0)
    edges[loops] = np.column_stack([rng.integers(0, 140, len(loops)), rng.integers(150, 300, len(loops))])
    return replace(problem, edges=edges)


@pytest.mark.parametrize(("fraction", "group"), [(0.1, 1), (0.5, 1), (0.8, 1), (0.5, 10), (0.7, 10)])
def test_false_loops_of_a_city_go_and_true_ones_stay(fraction, group):
    city = _city(fraction, group)
    solution = optimize_pose_graph(city.problem, AUTO)
    loops = np.abs(np.diff(city.problem.edges, axis=1)[:, 0]) != 1
    assert solution.weights[city.outlier].sum() == 0
    assert solution.weights[loops & ~city.outlier].mean() > 0.97
    assert "loops agree" in solution.robust_reason


@pytest.mark.parametrize("false", [0, 6])
def test_a_way_that_closes_once_is_closed(false):
    """However little stated noise of odometry tells of a single place: nothing seen as often speaks against it."""
    problem, truth = world(2, n=150, loops=0, seed=1)
    rng = np.random.default_rng(2)
    near = np.column_stack([np.arange(5), 140 + np.arange(5)])
    far = np.column_stack([rng.integers(10, 60, false), rng.integers(80, 130, false)])
    edges = np.concatenate([problem.edges, near, far])
    measured = np.linalg.inv(truth[edges[len(problem.edges) :, 0]]) @ truth[edges[len(problem.edges) :, 1]]
    measured[len(near) :] = np.eye(3)
    measurements = np.concatenate([problem.measurements, measured])
    information = np.concatenate([problem.information, np.repeat(problem.information[:1], len(measured), axis=0)])
    spoilt = replace(problem, edges=edges, measurements=measurements, information=0.003 * information)
    solution = optimize_pose_graph(spoilt, AUTO)
    assert solution.weights[149:154].all()
    assert not solution.weights[154:].any()


def test_tails_of_loops_whose_noise_is_stated_too_large_are_kept():
    city = _city(0.0, 1)
    information = city.problem.information / 100.0
    rng = np.random.default_rng(1)
    loops = np.flatnonzero(np.abs(np.diff(city.problem.edges, axis=1)[:, 0]) != 1)
    measurements = city.problem.measurements.copy()
    for e in rng.choice(loops, 10, replace=False).tolist():
        measurements[e, :2, 2] += rng.choice([-1.0, 1.0], 2) * 0.45  # nine sigmas as they are, one of those stated
    problem = replace(city.problem, information=information, measurements=measurements)
    assert optimize_pose_graph(problem, AUTO).weights.all()


def test_loops_that_say_anything_are_not_believed_and_that_is_said():
    problem = _random_loops()
    loops = np.flatnonzero(np.abs(np.diff(problem.edges, axis=1)[:, 0]) != 1)
    solution = optimize_pose_graph(problem, AUTO)
    assert solution.weights[loops].mean() < 0.05
    away = np.linalg.norm(solution.poses[:, :2, 2] - problem.poses[:, :2, 2], axis=1)
    assert solution.weights[loops].any() or "undecided" in " ".join(solution.notes)
    assert solution.weights.sum() == 299 or "places" in " ".join(solution.notes), "it says between what"
    assert solution.weights[loops].any() or away.max() < 1e-6


@pytest.mark.parametrize("robust", ["cauchy", "geman-mcclure", "dcs"])
def test_kernels_on_their_own(robust):
    problem, _ = world(2, n=120, loops=60, seed=3)
    solution = optimize_pose_graph(_with_false_loops(problem, 20, seed=4), PoseGraphConfig(robust=robust))
    assert solution.weights[len(problem.edges) :].sum() == 0
    assert solution.weights[: len(problem.edges)].mean() > 0.6
    weights = kernel_weights(robust, np.array([0.0, 4.0, 400.0]), 4.0)
    assert weights[0] == 1.0
    assert np.all(np.diff(weights) <= 0.0)
    assert weights[2] < 0.02


def test_residuals_show_by_how_much_the_noise_is_stated_wrongly():
    city = _city(0.0, 1)
    odometry = np.abs(np.diff(city.problem.edges, axis=1)[:, 0]) == 1
    information = city.problem.information * np.where(odometry, 4.0, 0.1)[:, None, None]
    problem = replace(city.problem, information=information)
    for _ in range(5):
        poses = optimize_pose_graph(problem).poses
        noise = noise_of_kinds(problem, poses)
        problem = rescaled(problem, noise)
    kinds = ["odometry rotation", "odometry translation", "loops rotation", "loops translation"]
    assert [kind.kind for kind in noise] == kinds
    ratio = problem.information / city.problem.information.clip(1e-300)
    assert np.allclose(np.diagonal(ratio, axis1=1, axis2=2), 1.0, atol=0.3)


@pytest.mark.parametrize(("fraction", "robust", "hints"), [(0.0, "none", 0), (0.02, "none", 1), (0.8, "gnc", 1)])
def test_loops_that_contradict_each_other_are_warned_of(fraction, robust, hints):
    solution = optimize_pose_graph(_city(fraction, 1).problem, PoseGraphConfig(robust=robust))
    assert sum("--robust auto" in note for note in solution.notes) == hints


def test_a_sample_shows_what_all_edges_show(monkeypatch):
    city = _city(0.0, 1)
    poses = optimize_pose_graph(city.problem).poses
    every = noise_of_kinds(city.problem, poses)
    monkeypatch.setattr("vislam.batch.posegraph.noise._SAMPLE_MAX", 50)
    for some, all_of_it in zip(noise_of_kinds(city.problem, poses), every, strict=True):
        assert some.chi2 == all_of_it.chi2
        assert some.redundancy == pytest.approx(all_of_it.redundancy, rel=0.05)


@pytest.mark.parametrize("d", [2, 3])
def test_no_edge_gives_a_solution_more_than_it_says(d):
    problem, _ = world(d, n=60, loops=6, seed=5)
    loops = np.abs(np.diff(problem.edges, axis=1)[:, 0]) != 1
    turn = problem.tangent - problem.dimension
    weak = problem.information.copy()
    weak[~loops, :turn, :turn] *= 1e-4  # so that residuals of loops are large, and hardly anything confirms them
    problem = replace(problem, information=weak)
    poses = optimize_pose_graph(problem).poses
    W, at = problem.information, np.arange(len(problem.edges))
    inside, ones = np.ones(len(at), dtype=bool), np.ones(len(at))
    S, _ = covariances_of_edges(Structure(problem), problem, poses, ones, at, inside)
    L = np.linalg.cholesky(W)
    share = np.linalg.eigvalsh(L.transpose(0, 2, 1) @ S @ L)
    assert share.min() > -1e-6
    assert share.max() < 1.0 + 1e-6


@pytest.mark.data
@pytest.mark.parametrize(("name", "share", "false"), [
    ("MIT", 1.0, 0), ("MIT", 1.0, 80), ("M3500", 1.0, 0), ("smallGrid3D", 1.0, 0), ("intel", 0.98, 0),
])  # fmt: skip
def test_files_keep_their_loops_and_no_false_ones(name, share, false, data_root):
    problem = read_pose_graph(data_root / "g2o" / f"{name}.g2o")
    plain, robust = optimize_pose_graph(problem), optimize_pose_graph(_with_false_loops(problem, false, seed=2), AUTO)
    loops = np.flatnonzero(np.abs(np.diff(problem.edges, axis=1)[:, 0]) != 1)
    assert robust.weights[loops].mean() >= share
    assert not robust.weights[len(problem.edges) :].any()
    assert any("chance may explain" in note for note in robust.notes) == (false > 0)
    d = problem.dimension
    ours, theirs = np.zeros((len(problem.ids), 3)), np.zeros((len(problem.ids), 3))
    ours[:, :d], theirs[:, :d] = robust.poses[:, :d, d], plain.poses[:, :d, d]
    T = align_points(ours, theirs)
    apart = np.sqrt(np.mean(np.sum((ours @ T[:3, :3].T + T[:3, 3] - theirs) ** 2, axis=1)))
    assert apart <= 1e-3 * np.ptp(theirs, axis=0).max()


@pytest.mark.data
@pytest.mark.parametrize(("true_loops", "true_share", "false_share"), [(3348, 0.95, 0.15), (1832, 0.85, 0.05)])
def test_lecture_hall_with_real_aliasing(true_loops, true_share, false_share, data_root):
    """Its false loops come in dozens from the same two places, and agree; true ones are left out till they are half."""
    folder = data_root / "tuc_lecture_hall"
    if not folder.is_dir():
        missing(f"{folder}")
    problem = read_pose_graph(folder / "Lecture_Hall.g2o")
    with (folder / "Lecture_Hall_loops.csv").open() as file:
        far = {(int(r["from"]), int(r["to"])): float(r["true_distance_m"]) > 3.0 for r in csv.DictReader(file)}
    label = np.array([{None: 0, False: 1, True: 2}[far.get((a, b))] for a, b in problem.ids[problem.edges].tolist()])
    true = np.flatnonzero(label == 1)
    out = np.random.default_rng(0).choice(true, len(true) - true_loops, replace=False)
    problem, label = problem.with_edges(np.delete(np.arange(len(label)), out)), np.delete(label, out)
    solution = optimize_pose_graph(problem, AUTO)
    assert solution.weights[label == 1].mean() >= true_share
    assert solution.weights[label == 2].mean() <= false_share
    truth = np.loadtxt(folder / "Lecture_Hall_truth.txt")
    ours, real = np.zeros((len(truth), 3)), np.zeros((len(truth), 3))
    ours[:, :2], real[:, :2] = solution.poses[:, :2, 2], truth[:, 1:3]
    T = align_points(ours, real)
    assert np.sqrt(np.mean(np.sum((ours @ T[:3, :3].T + T[:3, 3] - real) ** 2, axis=1))) <= 0.40


def test_where_the_poses_that_decided_lead_nowhere_the_other_starts_are_solved(monkeypatch):
    problem, _ = world(2, n=60, loops=30, seed=3)
    config = PoseGraphConfig(robust="auto", iterations=5)
    right, decide = optimize_pose_graph(problem, config), optimize._decision
    thrown = np.random.default_rng(1).uniform(-np.pi, np.pi, 60)

    def poses_thrown_about(*given):
        decision = decide(*given)
        poses = decision.poses.copy()
        poses[1:, :2, :2] = np.array([[np.cos(thrown), -np.sin(thrown)], [np.sin(thrown), np.cos(thrown)]]).T[1:]
        return replace(decision, poses=poses)

    monkeypatch.setattr(optimize, "_decision", poses_thrown_about)
    found = optimize_pose_graph(problem, config)
    assert found.converged and found.costs[-1] == pytest.approx(right.costs[-1], rel=1e-6)
