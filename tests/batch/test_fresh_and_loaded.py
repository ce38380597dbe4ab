"""What a solver's kernels compute must not depend on whether they were compiled just now or loaded."""

import json

import pytest

from worlds.compiled import optimised, optimised_afresh


@pytest.mark.slow
def test_compiled_afresh_and_loaded_the_same_bytes_come_out(tmp_path_factory, tmp_path) -> None:
    """Kernels that others call are compiled twice, alone and within their callers: rounding must not show which ran."""
    fresh = optimised_afresh(tmp_path_factory)
    assert "compiling" not in optimised(fresh, tmp_path / "loaded")
    folders = (fresh / "graph_optimized", tmp_path / "loaded")
    poses = [(folder / "optimized.g2o").read_bytes() for folder in folders]
    assert poses[0] == poses[1]
    noise = [json.loads((folder / "summary.json").read_text())["noise"] for folder in folders]  # of edges' covariances
    assert noise[0] == noise[1]
    assert noise[0]
