"""Kernels compile quicker than numba's own, and what is changed for that is changed only meanwhile."""

import gc

import numpy as np
import pytest
from numba.core import config, event

from vislam.core.jit import njit


@njit()
def assign(out: np.ndarray, values: np.ndarray) -> None:
    """Assign to a slice."""
    out[1:] = values


def test_shapes_that_do_not_match_are_refused() -> None:
    out = np.zeros(4)
    assign(out, np.arange(3.0))
    assert out.tolist() == [0.0, 0.0, 1.0, 2.0]
    with pytest.raises(ValueError, match="different size"):
        assign(out, np.arange(2.0))


def test_no_strings_are_compiled_for_an_assignment() -> None:
    with event.install_recorder("numba:compile") as compiled:
        njit()(assign.py_func)(np.zeros((4, 2)), np.ones((3, 2)))
    names = {item.data["dispatcher"].py_func.__module__ for _, item in compiled.buffer}
    assert names
    assert not any("unicode" in name for name in names)


@pytest.mark.parametrize("enabled", [True, False])
def test_collector_and_level_are_as_they_were_after_a_compilation(monkeypatch, enabled: bool) -> None:
    monkeypatch.delenv("NUMBA_OPT", raising=False)
    meanwhile: list[tuple[bool, int]] = []

    class Look(event.Listener):
        def on_start(self, _) -> None:
            meanwhile.append((gc.isenabled(), int(config.OPT)))

        def on_end(self, _) -> None:
            pass

    was_enabled, level = gc.isenabled(), config.OPT
    (gc.enable if enabled else gc.disable)()
    try:
        with event.install_listener("numba:compile", Look()):
            njit()(lambda x: x + 1)(1)
        assert gc.isenabled() == enabled
    finally:
        (gc.enable if was_enabled else gc.disable)()
    assert meanwhile == [(False, 2)]
    assert config.OPT is level


def test_a_kernel_that_does_not_compile_leaves_all_as_it_was() -> None:
    level = config.OPT
    with pytest.raises(Exception, match="unknown"):
        njit()(lambda x: x.unknown)(1)
    assert gc.isenabled()
    assert config.OPT is level
