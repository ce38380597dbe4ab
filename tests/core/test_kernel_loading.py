"""Kernels that come from the cache: machine code at once, LLVM's module only for whoever inlines them."""

import subprocess
import sys
from pathlib import Path

import pytest

MODULE = """
from vislam.core.jit import njit

@njit(cache=True)
def half(x):
    return 0.5 * x

@njit(cache=True)
def area(a, b):
    return half(a * b)
"""
ASK = """
import kernels
print(kernels.{kernel}({arguments}), sum(kernels.{kernel}.stats.cache_hits.values()), end=" ")
library = kernels.{kernel}.overloads[kernels.{kernel}.signatures[0]].library
print(library._shared_module is None, end=" ")
"""


def _ask(folder: Path, script: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=folder)
    return done.stdout.split()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with two kernels, one of which calls the other, and nothing compiled."""
    (tmp_path / "kernels.py").write_text(MODULE)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    return tmp_path


def test_a_kernel_from_the_cache_has_no_module_and_the_same_answer(folder: Path) -> None:
    script = ASK.format(kernel="half", arguments="3.0")
    assert _ask(folder, script) == ["1.5", "0", "False"]
    assert _ask(folder, script) == ["1.5", "1", "True"]


def test_a_kernel_from_the_cache_can_be_inlined_into_one_that_is_compiled(folder: Path) -> None:
    half = ASK.format(kernel="half", arguments="3.0")
    area = ASK.format(kernel="area", arguments="3.0, 4.0")
    _ask(folder, half)
    assert _ask(folder, half + area) == ["1.5", "1", "True", "6.0", "0", "False"]
    assert _ask(folder, half + area) == ["1.5", "1", "True", "6.0", "1", "True"]
