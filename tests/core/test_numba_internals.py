"""What is replaced in numba: cached kernels have no LLVM module until one inlines them; a switch undoes it."""

import ast
import hashlib
import inspect
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core import codegen
from numba.np import arrayobj

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


CALLEE = """
from vislam.core.jit import njit

@njit(cache=True)
def bent(x):
    return {factor} * x
"""
CALLER = """
from callee import bent
from constants import OFFSET
from vislam.core.jit import njit

@njit(cache=True)
def between(x):
    return bent(x) + OFFSET

@njit(cache=True)
def outer(x):
    return between(x)
"""


def test_a_kernel_is_compiled_again_where_another_file_that_it_stands_on_has_changed(folder: Path) -> None:
    def ask() -> list[str]:
        return _ask(folder, "import caller as c; print(c.outer(1.0), sum(c.outer.stats.cache_hits.values()))")

    (folder / "caller.py").write_text(CALLER)
    (folder / "constants.py").write_text("OFFSET = 1.0\n")
    (folder / "callee.py").write_text(CALLEE.format(factor=2.0))
    assert ask() == ["3.0", "0"]
    assert ask() == ["3.0", "1"]
    (folder / "callee.py").write_text(CALLEE.format(factor=20.0))  # of another size, as stamps of time may be coarse
    assert ask() == ["21.0", "0"]
    (folder / "constants.py").write_text("OFFSET = 5.00\n")
    assert ask() == ["25.0", "0"]
    assert ask() == ["25.0", "1"]


def test_a_kernel_from_the_cache_has_no_module_until_one_inlines_it_and_the_same_answer(folder: Path) -> None:
    half = ASK.format(kernel="half", arguments="3.0")
    area = ASK.format(kernel="area", arguments="3.0, 4.0")
    assert _ask(folder, half) == ["1.5", "0", "False"]
    assert _ask(folder, half + area) == ["1.5", "1", "True", "6.0", "0", "False"]
    assert _ask(folder, half + area) == ["1.5", "1", "True", "6.0", "1", "True"]


def test_the_switch_leaves_numba_as_it_is(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = ASK.format(kernel="half", arguments="3.0")
    _ask(folder, script)
    monkeypatch.setenv("VISLAM_PLAIN_NUMBA", "1")
    assert _ask(folder, script) == ["1.5", "0", "False"]  # it does not know our stamps
    assert _ask(folder, script) == ["1.5", "1", "False"]


REPLACED = {  # SHA-256 of their code in numba 0.68, without comments and docstrings
    "_unserialize": "161c0d9a4935aa36",
    "_get_module_for_linking": "5053a3ac7254fae6",
    "raise_with_shape_context": "1ae016537751aef6",
}


@pytest.mark.parametrize("name", REPLACED)
def test_what_is_replaced_means_what_it_meant(name: str) -> None:
    """Read what a new numba does there before its hash is written here and its version allowed in pyproject.toml."""
    sources = (inspect.getsource(module) for module in (codegen, arrayobj))
    functions = [
        n for s in sources for n in ast.walk(ast.parse(s)) if isinstance(n, ast.FunctionDef) and n.name == name
    ]
    (function,) = (f for f in functions if len(f.body) > 1 or name == "raise_with_shape_context")
    if ast.get_docstring(function):
        function.body.pop(0)
    assert hashlib.sha256(ast.unparse(function).encode()).hexdigest()[:16] == REPLACED[name]
