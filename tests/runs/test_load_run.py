"""What a run left comes back as plain values, shows itself, and says what is wrong with a folder."""

import base64
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest

from run_folder import FRAMES, make_run
from vislam import load_run
from vislam.core.errors import DataError


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("loaded") / "run")


@pytest.fixture
def copied(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "run")


def test_a_run_comes_back_as_arrays(folder):
    run = load_run(folder)
    assert list(run.trajectories) == ["ekf", "graph", "live", "truth"]
    assert run.trajectories["graph"].T_world_body.shape == (FRAMES, 4, 4)
    states = run.states["graph"]
    assert states.covariance.shape == (len(states), 15, 15)
    np.testing.assert_array_equal(states.keyframe_id, np.arange(len(states)))
    np.testing.assert_allclose(states.T_world_body[3], run.trajectories["graph"].T_world_body[30], atol=1e-6)
    assert (len(run.loops), run.loops[0].decision) == (60, "accepted")
    assert run.metrics["keyframes"] == len(states)


def test_a_run_says_what_it_holds(folder):
    text = repr(load_run(str(folder)))
    assert str(folder) in text
    assert "trajectories['graph']: 1200 poses" in text
    assert "60 candidates, 12 accepted" in text


def test_a_notebook_gets_a_picture_of_it(folder):
    html = load_run(folder)._repr_html_()
    image = base64.b64decode(re.search(r"base64,([^\"]+)", html)[1])
    assert image.startswith(b"\x89PNG")
    assert "ATE" in html


def test_names_from_a_file_cannot_become_markup(copied):
    (copied / "trajectory_graph.tum").rename(copied / "trajectory_<script>.tum")
    assert "<script>" not in load_run(copied)._repr_html_()


def test_matplotlib_is_loaded_for_a_picture_only(folder):
    code = f"import sys, vislam; repr(vislam.load_run({str(folder)!r})); sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_run_that_was_killed_is_read_as_far_as_it_came(copied):
    for name in ("metrics.json", "loops.csv", "states_graph.csv", "trajectory_truth.tum"):
        (copied / name).unlink()
    run = load_run(copied)
    assert (run.metrics, run.loops, list(run.states)) == ({}, (), ["ekf"])
    assert "no verdict" in repr(run)
    assert "<img" in run._repr_html_()


@pytest.mark.parametrize("name", ["trajectory_graph.tum", "states_ekf.csv", "loops.csv", "metrics.json"])
def test_a_damaged_file_is_named(copied, name):
    path = copied / name
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2].rstrip()[:-3])
    with pytest.raises(DataError, match=re.escape(name)):
        load_run(copied)


def test_a_folder_without_a_run_is_refused_with_the_next_step(tmp_path):
    with pytest.raises(DataError, match="vislam run SOURCE --out"):
        load_run(tmp_path / "nothing")
    with pytest.raises(DataError, match="give the --out of a run"):
        load_run(tmp_path)
