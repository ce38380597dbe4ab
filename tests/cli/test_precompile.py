"""What `./run setup` compiles ahead: jobs leave stamps when they are done, and are not done again."""

import subprocess
import sys
from pathlib import Path

import pytest

from vislam.cli import precompile
from vislam.cli.precompile import JOBS, Job
from vislam.cli.verbs import VERBS


@pytest.fixture(autouse=True)
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder for compiled code."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return tmp_path


def test_jobs_are_verbs() -> None:
    assert {verb[0] for job in JOBS.values() for verb in job.verbs} <= set(VERBS)


@pytest.mark.slow
def test_a_job_compiles_once(kernels: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(precompile, "JOBS", {"graphs": JOBS["graphs"]})
    assert precompile.main([]) == 0
    assert "compiled in" in capsys.readouterr().err
    assert len(list(kernels.rglob("*.nbc"))) > 20
    monkeypatch.setattr(subprocess, "Popen", None)
    assert precompile.main([]) == 0
    assert capsys.readouterr().err == ""


def test_a_job_that_failed_leaves_no_stamp_and_no_error(kernels: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(precompile, "JOBS", {"unknown to the child": Job("nothing", 1, ())})
    assert precompile.main([]) == 0
    assert "not all could be compiled ahead" in capsys.readouterr().err
    assert list(kernels.rglob("vislam-compiled-*")) == []


def test_a_stamp_holds_for_one_source_only(kernels: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    source = tmp_path / "package" / "kernel.py"
    source.parent.mkdir()
    source.write_text("a = 1\n")
    monkeypatch.setattr(precompile, "_PACKAGE", source.parent)
    precompile._set_done("cart", precompile._stamp())
    assert precompile._is_done("cart", precompile._stamp())
    source.write_text("a = 2\n")
    assert not precompile._is_done("cart", precompile._stamp())


def test_a_child_says_nothing_but_names_of_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = (
        "import sys; from vislam.cli import precompile as p\n"
        "p.JOBS = {'version': p.Job('', 1, (('--version',), ('posegraph', 'absent.g2o')))}\n"
        "sys.exit(p.main(['version']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (3, "", "")
