"""What a solver's kernels compute must not depend on whether they were compiled just now or loaded."""

import pytest

from worlds.compiled import optimised, optimised_afresh


@pytest.mark.slow
def test_compiled_afresh_and_loaded_the_same_bytes_come_out(tmp_path_factory, tmp_path) -> None:
    fresh = optimised_afresh(tmp_path_factory)
    assert "compiling" not in optimised(fresh, tmp_path / "loaded")
    names = [folder / "optimized.g2o" for folder in (fresh / "graph_optimized", tmp_path / "loaded")]
    assert names[0].read_bytes() == names[1].read_bytes()
