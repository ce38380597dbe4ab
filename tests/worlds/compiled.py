"""A pose graph optimised where nothing was compiled: what came out, and the kernels that it left."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from worlds.shared import shared

GRAPH = ("simulate", "--graph", "sphere", "--poses", "60", "--out", "graph.g2o")
OPTIMISE = ("posegraph", "graph.g2o", "--no-report", "--no-certify")


def optimised_afresh(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `kernels`, `graph.g2o`, and what `optimised` said and made of it as the first of all."""

    def make(folder: Path) -> None:
        subprocess.run([sys.executable, "-m", "vislam", *GRAPH], cwd=folder, capture_output=True, check=True)
        assert "compiling" in optimised(folder, folder / "graph_optimized")

    return shared(tmp_path_factory, "optimised-afresh", make)


def optimised(folder: Path, out: Path) -> str:
    """Optimise the graph of a folder with its kernels; return what was said."""
    command = [sys.executable, "-m", "vislam", *OPTIMISE, "--out", str(out)]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "kernels")}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True).stderr
