"""Large pose graphs by overlapping domains: the cost of the whole, the same bytes wherever, and a worker that dies."""

from dataclasses import replace

import numpy as np
import pytest

from dask_cluster import dask_cluster
from vislam import VislamError
from vislam.batch import (
    DaskTeam,
    dask_client,
    optimize_pose_graph,
    read_pose_graph,
    simulate_graph,
    write_pose_graph,
    write_simulated,
)
from vislam.batch.posegraph.domains import Alone
from vislam.cli import run_verb
from vislam.config import GraphWorldConfig, PoseGraphConfig
from waiting import HUNG_S

WORLD = GraphWorldConfig(poses=4000, loops_per_pose=1.5, rotation_sigma_deg=0.5)


@pytest.fixture
def small_domains(monkeypatch):
    """Make graphs of thousands of poses what those of a million are."""
    monkeypatch.setattr("vislam.batch.posegraph.domains._DOMAIN", 400)


@pytest.mark.parametrize("shape", ["manhattan", "torus", "grid3d"])
@pytest.mark.usefixtures("small_domains")
def test_domains_end_with_the_cost_of_the_whole(shape):
    made = simulate_graph(shape, replace(WORLD, poses=2000))
    whole, parts = optimize_pose_graph(made.problem), optimize_pose_graph(made.problem, team=Alone())
    assert parts.converged
    assert parts.start_name == "domains"
    assert parts.costs[-1] == pytest.approx(whole.costs[-1], rel=1e-6)
    # the anchor is the same pose, so what is left between both is what cost cannot tell
    assert np.abs(parts.poses - whole.poses).max() < 0.02


@pytest.mark.usefixtures("small_domains")
def test_what_is_fixed_stays_and_parts_that_nothing_joins_are_solved_each():
    made = simulate_graph("manhattan", WORLD)
    apart = made.problem.edges.max(axis=1) < 2500
    apart |= made.problem.edges.min(axis=1) >= 2500
    fixed = np.zeros(len(made.truth), dtype=bool)
    fixed[[0, 700, 2400]] = True
    # file poses of what is fixed are the true ones, of all else there are none
    poses = np.where(fixed[:, None, None], made.truth, np.nan)
    problem = replace(made.problem.with_edges(apart), fixed=fixed, poses=poses)
    whole, parts = optimize_pose_graph(problem), optimize_pose_graph(problem, team=Alone())
    assert parts.parts == whole.parts >= 2
    assert parts.anchors.tolist() == whole.anchors.tolist()
    assert np.array_equal(parts.poses[fixed], made.truth[fixed])
    assert parts.costs[-1] == pytest.approx(whole.costs[-1], rel=1e-6)


@pytest.mark.usefixtures("small_domains")
def test_edges_found_false_stay_out_and_a_files_start_is_taken():
    made = simulate_graph("manhattan", replace(WORLD, poses=1500, outlier_fraction=0.1))
    whole = optimize_pose_graph(made.problem, PoseGraphConfig(robust="gnc"))
    parts = optimize_pose_graph(made.problem, PoseGraphConfig(robust="gnc"), team=Alone())
    assert np.array_equal(parts.weights, whole.weights)
    assert len(parts.rejected) > 0
    assert parts.costs[-1] == pytest.approx(whole.costs[-1], rel=1e-6)
    near = made.problem.with_edges(whole.weights != 0.0).with_poses(whole.poses)
    again = optimize_pose_graph(near, PoseGraphConfig(start="file"), team=Alone())
    assert again.start_name == "file"
    assert again.costs[0] == pytest.approx(whole.costs[-1], rel=1e-9)
    assert again.costs[-1] <= again.costs[0]


def test_a_killed_worker_changes_nothing(small_domains, tmp_path):
    made = simulate_graph("torus", WORLD)
    alone = optimize_pose_graph(made.problem, team=Alone())
    with dask_cluster(tmp_path) as (address, workers), dask_client(address, 0) as client:
        done = []

        def kill_one(iteration, _):
            done.append(iteration)
            if iteration == 2:
                workers["one"].kill()
                workers["one"].wait(HUNG_S)

        found = optimize_pose_graph(made.problem, progress=kill_one, team=DaskTeam(client))
        assert len(client.scheduler_info()["workers"]) == 1
    assert done[-1] > 2
    assert found.poses.tobytes() == alone.poses.tobytes()
    assert found.costs == alone.costs


def test_the_verb_solves_by_processes_of_its_own(small_domains, tmp_path, capsys):
    made = simulate_graph("manhattan", replace(WORLD, poses=1500))
    write_simulated(made, tmp_path / "walk.g2o")
    out = tmp_path / "out"
    assert (
        run_verb(["posegraph", str(tmp_path / "walk.g2o"), "--engine", "dask", "--out", str(out), "--no-report"]) == 0
    )
    read = read_pose_graph(tmp_path / "walk.g2o")
    write_pose_graph(read, tmp_path / "alone.g2o", optimize_pose_graph(read, team=Alone()).poses)
    assert (out / "optimized.g2o").read_bytes() == (tmp_path / "alone.g2o").read_bytes()
    assert "domains start" in capsys.readouterr().out


def test_a_cluster_without_workers_is_not_waited_for(tmp_path, monkeypatch):
    made = simulate_graph("manhattan", replace(WORLD, poses=20))
    with dask_cluster(tmp_path, names=()) as (address, _), dask_client(address, 0) as client:
        monkeypatch.setattr("vislam.core.cluster._ANSWER_S", 1.0)
        team = DaskTeam(client)
        with pytest.raises(VislamError, match="no workers"):
            optimize_pose_graph(made.problem, team=team)


def test_what_domains_cannot_is_refused():
    made = simulate_graph("manhattan", replace(WORLD, poses=20))
    with pytest.raises(VislamError, match="--start auto or file"):
        optimize_pose_graph(made.problem, PoseGraphConfig(start="tree"), team=Alone())
    landmark = replace(made.problem, is_point=np.arange(20) == 19)
    with pytest.raises(VislamError, match="landmarks or priors"):
        optimize_pose_graph(landmark, team=Alone())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--workers", "3"), "of --engine dask"),
        (("--engine", "dask", "--scheduler", "tcp://127.0.0.1:9", "--workers", "3"), "workers of its own"),
        (("--engine", "dask", "--scheduler", "tcp://127.0.0.1:9"), "no Dask scheduler answers"),
    ],
)
def test_a_cluster_that_cannot_be_is_one_line(options, message, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("vislam.core.cluster._ANSWER_S", 0.5)
    write_simulated(simulate_graph("manhattan", replace(WORLD, poses=20)), tmp_path / "walk.g2o")
    out = tmp_path / "out"
    assert run_verb(["posegraph", str(tmp_path / "walk.g2o"), "--out", str(out), *options]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert len(error.splitlines()) == 1
    assert not out.exists()
