"""`vislam posegraph FILE.g2o`: what it writes, what it says, and how it ends."""

import csv
import json

import numpy as np
import pytest
from test_graph_optimize import world

from vislam.batch.posegraph.g2o import read_g2o, write_g2o
from vislam.cli import run_verb
from vislam.trajectory import read_kitti, read_tum


@pytest.mark.parametrize("d", [2, 3])
def test_a_file_gets_its_optimum_in_all_formats(tmp_path, capsys, d):
    problem, _ = world(d)
    path, out = tmp_path / "walk.g2o", tmp_path / "out"
    write_g2o(problem, path)
    assert run_verb(["posegraph", str(path), "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == json.loads((out / "summary.json").read_text())
    optimum = read_g2o(out / "optimized.g2o")
    assert optimum.chi2(optimum.poses) == pytest.approx(told["chi2_after"], rel=1e-9)
    assert told["chi2_after"] < told["chi2_before"] < problem.chi2(problem.poses)
    tum = read_tum(out / "trajectory.tum")
    assert tum.t_ns.tolist() == (problem.ids * 10**9).tolist()
    kitti = read_kitti(out / "trajectory_kitti.txt", tum.t_ns)
    assert np.allclose(kitti.T_world_body, tum.T_world_body, atol=1e-8)
    assert np.allclose(tum.positions_m[:, :d], optimum.poses[:, :d, d], atol=1e-8)
    rows = list(csv.DictReader((out / "poses.csv").open()))
    assert [int(row["id"]) for row in rows] == problem.ids.tolist()
    assert np.allclose([float(row["y_m"]) for row in rows], optimum.poses[:, 1, d], atol=1e-12)
    edges = list(csv.DictReader((out / "edges.csv").open()))
    assert sum(float(row["chi2_after"]) for row in edges) == pytest.approx(told["chi2_after"], rel=1e-6)
    page = (out / "report.html").read_text()
    assert page.count("<svg") == 3
    assert told["chi2_file"] == pytest.approx(problem.chi2(problem.poses), rel=1e-9)
    assert f"from {told['chi2_file']:.6g} of the file&#x27;s poses" in page
    unlike = (".html", ".json")  # hold times, as does log.txt
    first = {p.name: p.read_bytes() for p in out.iterdir() if p.suffix not in unlike and p.name != "log.txt"}
    assert run_verb(["posegraph", str(path), "--out", str(out), "--no-noise"]) == 0
    said = capsys.readouterr().out
    assert "chi2" in said
    assert told["noise"]
    assert "noise of" not in said
    assert first == {p.name: p.read_bytes() for p in out.iterdir() if p.name in first}


def test_a_graph_whose_factor_does_not_fit_is_solved_and_reported(tmp_path, monkeypatch):
    for module in ("structure", "certificate"):
        monkeypatch.setattr(f"vislam.batch.posegraph.{module}.FACTOR_MAX_BYTES", 100_000)
    write_g2o(world(3, n=300, loops=400)[0], tmp_path / "torus.g2o")
    assert run_verb(["posegraph", str(tmp_path / "torus.g2o"), "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.parametrize("options", [(), ("--robust", "auto", "--covariances"), ("--rescale-noise",)])
def test_poses_that_are_all_fixed_are_answered_with_their_cost(tmp_path, capsys, options):
    path = tmp_path / "fixed.g2o"
    path.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0.1\nFIX 0 1\nEDGE_SE2 0 1 1 0 0 4 0 0 4 0 4\n")
    assert run_verb(["posegraph", str(path), "--out", str(tmp_path / "out"), "--json", *options]) == 0
    assert json.loads(capsys.readouterr().out)["chi2_after"] == pytest.approx(0.04)


def test_exit_codes(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    problem, _ = world(2)
    path = tmp_path / "walk.g2o"
    write_g2o(problem, path)
    assert run_verb(["posegraph", "walk.g2o", "--no-report", "--iterations", "1", "--start", "odometry"]) == 4
    assert "not converged" in capsys.readouterr().out
    assert not (tmp_path / "walk_optimized" / "report.html").exists()
    path.write_text(path.read_text()[:-30])
    assert run_verb(["posegraph", "walk.g2o"]) == 3
    assert "walk.g2o:" in capsys.readouterr().err
    assert run_verb(["posegraph", "absent.g2o"]) == 3
    assert run_verb(["posegraph", "walk.g2o", "--start", "magic"]) == 2
