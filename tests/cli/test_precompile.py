"""What `./run setup` compiles ahead: jobs leave stamps when they are done, and are not done again."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest

from vislam.cli import precompile
from vislam.cli.verbs import VERBS, ahead
from vislam.cli.verbs.ahead import JOBS, Job
from worlds.compiled import optimised_afresh


@pytest.fixture(autouse=True)
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder for compiled code."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return tmp_path


def test_jobs_are_verbs() -> None:
    assert {verb[0] for job in JOBS.values() for verb in job.verbs} <= set(VERBS)


@pytest.mark.slow
def test_a_job_compiles_once(kernels: Path, tmp_path_factory, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    shutil.copytree(optimised_afresh(tmp_path_factory) / "kernels", kernels, dirs_exist_ok=True)  # the rest is left
    before = len(list(kernels.rglob("*.nbc")))
    monkeypatch.setattr(ahead, "JOBS", {"graphs": JOBS["graphs"]})
    assert precompile.main([]) == 0
    assert "compiled in" in capsys.readouterr().err
    assert len(list(kernels.rglob("*.nbc"))) > max(before, 20)
    monkeypatch.setattr(subprocess, "Popen", None)
    assert precompile.main([]) == 0
    assert capsys.readouterr().err == ""


def test_a_job_that_failed_leaves_no_stamp_and_no_error(kernels: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(ahead, "JOBS", {"unknown to the child": Job(1, ())})
    assert precompile.main([]) == 0
    assert "not all could be compiled ahead" in capsys.readouterr().err
    assert list(kernels.rglob("vislam-compiled-*")) == []


def test_a_stamp_holds_for_one_source_only(kernels: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    source = tmp_path / "package" / "kernel.py"
    source.parent.mkdir()
    monkeypatch.setattr(ahead, "_PACKAGE", source.parent)
    monkeypatch.setattr(ahead, "JOBS", {"cart": JOBS["cart"]})
    compiled: list[str] = []

    @contextmanager
    def child(command: list[str], **_: object) -> Iterator[SimpleNamespace]:
        compiled.append(command[-1])
        yield SimpleNamespace(stdout=["a kernel\n"], returncode=0)

    monkeypatch.setattr(subprocess, "Popen", child)
    for text, count in (("a = 1\n", 1), ("a = 1\n", 1), ("a = 2\n", 2)):
        source.write_text(text)
        assert precompile.main([]) == 0
        assert compiled == ["cart"] * count
    source.write_text("a = 3\n")
    assert not ahead.compile_ahead(["cart"])  # a verb compiles again what changed only, when it needs it
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "package"))
    monkeypatch.setenv("VISLAM_COMPILING", "cart")
    assert not ahead.compile_ahead(["cart"])  # within a job: it would never end
    monkeypatch.delenv("VISLAM_COMPILING")
    assert ahead.compile_ahead(["cart"])
    assert not ahead.compile_ahead(["cart"])
    assert compiled == ["cart"] * 3


def test_a_child_says_nothing_but_names_of_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = (
        "import sys; from vislam.cli import precompile as p\n"
        "p.JOBS = {'version': p.Job(1, (('--version',), ('posegraph', 'absent.g2o')))}\n"
        "sys.exit(p.main(['version']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (3, "", "")


@pytest.mark.parametrize("verb", ["live", "drive"])
def test_what_runs_in_processes_compiles_before_they_begin(verb: str, tmp_path, monkeypatch) -> None:
    main = import_module(f"vislam.cli.verbs.{verb}")
    monkeypatch.setattr(main, "compile_ahead", lambda jobs: pytest.fail(jobs[-1]))
    options = {"live": ["--source", "virtual-cart"], "drive": ["--goal", "0", "0", "0", "--real-time"]}[verb]
    with pytest.raises(pytest.fail.Exception, match="live"):
        main.main([*options, "--out", str(tmp_path / "run")])
