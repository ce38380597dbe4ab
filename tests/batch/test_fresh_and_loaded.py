"""What a solver's kernels compute must not depend on whether they were compiled just now or loaded."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_graph_optimize import world

from vislam.batch.posegraph.g2o import write_g2o


@pytest.mark.slow
def test_compiled_afresh_and_loaded_the_same_bytes_come_out(tmp_path: Path) -> None:
    problem, _ = world(2)
    write_g2o(problem, tmp_path / "walk.g2o")
    command = [sys.executable, "-m", "vislam", "posegraph", "walk.g2o", "--no-report", "--no-certify"]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    answers = []
    for _ in ("afresh", "loaded"):
        said = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stderr
        answers.append((tmp_path / "walk_optimized" / "optimized.g2o").read_bytes())
        assert ("compiling" in said) == (len(answers) == 1)
    assert answers[0] == answers[1]
