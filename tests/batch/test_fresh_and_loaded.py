"""What a solver's kernels compute must not depend on whether they were compiled just now or loaded."""

import os
import subprocess
import sys

import pytest

from worlds.compiled import optimised, optimised_afresh

# kernels that kernels call are compiled twice, alone and within their callers: rounding must not tell which one runs
COVARIANCES = """
import hashlib, pathlib, sys, numpy as np
from vislam.batch.posegraph.files import read_pose_graph
from vislam.batch.posegraph.noise import covariances_of_edges
from vislam.batch.posegraph.structure import Structure
problem = read_pose_graph(pathlib.Path(sys.argv[1]))
at, ones = np.arange(len(problem.edges)), np.ones(len(problem.edges))
S, _ = covariances_of_edges(Structure(problem), problem, problem.poses, ones, at, ones > 0.0)
print(hashlib.sha256(S.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_compiled_afresh_and_loaded_the_same_bytes_come_out(tmp_path_factory, tmp_path) -> None:
    fresh = optimised_afresh(tmp_path_factory)
    assert "compiling" not in optimised(fresh, tmp_path / "loaded")
    names = [folder / "optimized.g2o" for folder in (fresh / "graph_optimized", tmp_path / "loaded")]
    assert names[0].read_bytes() == names[1].read_bytes()


@pytest.mark.slow
def test_covariances_compiled_afresh_and_loaded_are_the_same(tmp_path_factory, tmp_path) -> None:
    graph = optimised_afresh(tmp_path_factory) / "graph.g2o"
    command = [sys.executable, "-c", COVARIANCES, str(graph)]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    said = [subprocess.run(command, env=environment, capture_output=True, check=True).stdout for _ in range(2)]
    assert said[0] == said[1]
