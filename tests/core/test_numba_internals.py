"""What is replaced in numba: how cached kernels are read, compiled and linked; a switch undoes it."""

import ast
import hashlib
import inspect
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core import caching, codegen
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


LONG = """
import numpy as np
from vislam.core.jit import njit

@njit(cache=True)
def long(a, b):
    return a @ b + b @ a.T - np.linalg.inv(a) @ (b * b)

@njit(cache=True)
def outer(a, b):
    c = a.copy()
    for k in range(3):
        c = long(c, b) / (1.0 + k)
    return c
"""


def test_what_is_too_long_to_be_inlined_is_linked_as_it_is_with_the_same_answer(folder: Path, monkeypatch) -> None:
    (folder / "kernels.py").write_text(LONG)
    script = """
import kernels, numpy as np
rows = np.random.default_rng(3).normal(size=(2, 4, 4))
print(kernels.outer(*rows).tobytes().hex(), sum(kernels.outer.stats.cache_hits.values()), end=" ")
library = kernels.outer.overloads[kernels.outer.signatures[0]].library
print(len(vars(library).get("_long", ())))
"""
    answer, hits, long = _ask(folder, script)
    assert (hits, int(long) > 0) == ("0", True)
    assert _ask(folder, script)[:2] == [answer, "1"]
    monkeypatch.setenv("VISLAM_PLAIN_NUMBA", "1")
    assert _ask(folder, script) == [answer, "0", "0"]


STORE_WHEN_ASKED = """
import sys, kernels
from numba.core.caching import FunctionCache
store = FunctionCache.save_overload
def when_asked(cache, sig, data):
    print("compiled", flush=True)
    sys.stdin.readline()
    store(cache, sig, data)
FunctionCache.save_overload = when_asked
print(kernels.half(3.0), sum(kernels.half.stats.cache_hits.values()))
"""
SAY_WHEN_WAITING = """
import kernels, time
from vislam.core import compiling_turns
sleep = time.sleep
def waits(seconds):
    print("waits", flush=True)
    compiling_turns.time.sleep = sleep
compiling_turns.time.sleep = waits
print(kernels.half(3.0), sum(kernels.half.stats.cache_hits.values()))
"""


@pytest.mark.parametrize("is_killed", [False, True])
def test_one_process_compiles_a_kernel_and_others_wait_while_it_lives(folder: Path, is_killed: bool) -> None:
    command = [sys.executable, "-c"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "cwd": folder}
    with subprocess.Popen([*command, STORE_WHEN_ASKED], **pipes) as first:
        assert first.stdout.readline() == "compiled\n"
        with subprocess.Popen([*command, SAY_WHEN_WAITING], **pipes) as second:
            assert second.stdout.readline() == "waits\n"
            if is_killed:
                first.kill()
            first.communicate(None if is_killed else "store it\n")
            assert second.communicate()[0] == f"1.5 {int(not is_killed)}\n"
    assert list(folder.rglob("*.compiling")) == []


def test_where_files_cannot_be_locked_a_kernel_is_compiled_at_once(folder: Path) -> None:
    refused = "import errno, fcntl, time\ndef refuse(*_): raise OSError(errno.ENOLCK, '')\nfcntl.flock = refuse\n"
    script = ASK.format(kernel="half", arguments="3.0").replace("import", f"{refused}time.sleep = None\nimport", 1)
    assert _ask(folder, script)[:2] == ["1.5", "0"]


REPLACED = {  # SHA-256 of their code in numba 0.68, without comments and docstrings
    "_unserialize": "161c0d9a4935aa36",
    "_get_module_for_linking": "5053a3ac7254fae6",
    "_optimize_final_module": "cb25120c79416d2d",
    "finalize": "38cb6017abb70450",
    "load_overload": "4dfd0465282fc086",
    "save_overload": "dbc23ab2657aaa5a",
    "raise_with_shape_context": "1ae016537751aef6",
}


@pytest.mark.parametrize("name", REPLACED)
def test_what_is_replaced_means_what_it_meant(name: str) -> None:
    """Read what a new numba does there before its hash is written here and its version allowed in pyproject.toml."""
    sources = (inspect.getsource(module) for module in (codegen, arrayobj, caching))
    functions = [
        n for s in sources for n in ast.walk(ast.parse(s)) if isinstance(n, ast.FunctionDef) and n.name == name
    ]
    (function,) = (f for f in functions if len(f.body) > 1 or name == "raise_with_shape_context")
    if ast.get_docstring(function):
        function.body.pop(0)
    assert hashlib.sha256(ast.unparse(function).encode()).hexdigest()[:16] == REPLACED[name]
