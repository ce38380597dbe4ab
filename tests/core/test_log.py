"""log.txt of a run folder: what was logged and warned of, by every process, whatever happened."""

import logging
import re
import subprocess
import sys
import time
import warnings
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.cli.verbs import terminal
from vislam.core import log
from vislam.core.errors import DataError, UsageError
from vislam.live.processes.child import Failure, Flag, Life, Signals, guarded

LINE = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z \S+.*\[\d+\] (DEBUG|INFO|WARNING|ERROR) [\w.]+: .+")
_LOG = logging.getLogger("vislam.test")


@pytest.fixture(autouse=True)
def as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the level back, and let every warning come."""
    monkeypatch.setattr(logging.getLogger("vislam"), "level", logging.INFO)
    warnings.simplefilter("always")


def logged(folder: Path) -> str:
    return (folder / "log.txt").read_text(encoding="utf-8")


def test_a_line_has_time_process_level_and_the_first_the_revision(tmp_path: Path) -> None:
    with log.log_to(tmp_path, ["vislam", "run"]):
        _LOG.info("hello")
    lines = logged(tmp_path).splitlines()
    assert all(LINE.fullmatch(line) for line in lines)
    assert re.search(r"vislam \S+.*: vislam run$", lines[0])
    assert lines[1].endswith("vislam.test: hello")


def test_warnings_of_numpy_end_in_the_log_and_not_in_the_terminal(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with log.log_to(tmp_path, []):
        np.divide(np.ones(1), np.zeros(1))
    assert "divide by zero" in logged(tmp_path)
    assert capfd.readouterr().err == ""


def test_levels_choose_what_of_ours_is_kept(tmp_path: Path) -> None:
    for level, kept in (("debug", 2), ("info", 1), ("error", 0)):
        (tmp_path / level).mkdir()
        log.set_level(level)
        with log.log_to(tmp_path / level, []):
            _LOG.debug("said of ours")
            _LOG.info("said of ours")
            logging.getLogger("numba").info("said of others")
        assert (
            logged(tmp_path / level).count("said of ours") == kept
            if kept
            else not (tmp_path / level / "log.txt").exists()
        )
        assert not kept or "said of others" not in logged(tmp_path / level)
    with pytest.raises(UsageError, match="no log level 'loud'; there are: debug"):
        log.set_level("loud")


def test_an_error_is_a_line_and_a_bug_a_traceback(tmp_path: Path) -> None:
    with pytest.raises(DataError), log.log_to(tmp_path, []):
        raise DataError("no such image")
    assert logged(tmp_path).rstrip().endswith("no such image")
    with pytest.raises(ZeroDivisionError), log.log_to(tmp_path, []):
        print(1 // 0)
    assert "Traceback" in logged(tmp_path)


def test_what_was_said_before_the_folder_was_there_is_kept(tmp_path: Path) -> None:
    with log.log_to(tmp_path / "later", []):
        _LOG.info("early")
        (tmp_path / "later").mkdir()
        _LOG.info("late")
    assert re.search("early.*late", logged(tmp_path / "later"), re.DOTALL)


def test_a_process_that_is_killed_leaves_what_it_said(tmp_path: Path) -> None:
    script = (
        "import logging, os, signal; from pathlib import Path; from vislam.core.log import log_to\n"
        f"with log_to(Path({str(tmp_path)!r}), []):\n"
        "    logging.getLogger('vislam.test').warning('last word'); os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == -9
    assert "last word" in logged(tmp_path)


def speak(life: Life) -> None:
    """Say something in every way, then fail; for a process of a live run."""
    logging.getLogger("vislam.test").info("from the child")
    warnings.warn("a warning from the child", stacklevel=1)
    raise DataError("that was all")


def test_records_of_the_processes_of_a_live_run_come_to_the_same_log(tmp_path: Path) -> None:
    context = get_context("spawn")
    hears, says = context.Pipe(duplex=False)
    process = context.Process(target=guarded, args=("x", says, Signals(Flag(), Flag()), speak), name="vislam x")
    with log.log_to(tmp_path, []):
        process.start()
        says.close()
        while not isinstance(message := hears.recv(), Failure):
            log.take_record(message)
        process.join()
    assert re.search(r"vislam x\[\d+\] INFO vislam\.test: from the child", logged(tmp_path))
    assert re.search(r"vislam x\[\d+\] WARNING py\.warnings: .*a warning from the child", logged(tmp_path))


def test_a_folder_that_holds_no_run_gets_no_log(tmp_path: Path) -> None:
    assert run_verb(["loops", str(tmp_path), "--undo", "7"]) == 3
    assert list(tmp_path.iterdir()) == []


def test_without_a_terminal_progress_is_a_line_every_ten_seconds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    with terminal.progress_bar("ride") as progress, terminal.rewritten_line() as show:
        for second in range(25):
            now_s = float(second)
            progress(second, 25, "ok")
            show(f"status {second}")
    assert capsys.readouterr().err.splitlines() == [
        "ride: 10/25 frames  ok", "status 10", "ride: 20/25 frames  ok", "status 20",
    ]  # fmt: skip


def test_a_status_line_is_cut_to_the_width_of_the_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with terminal.rewritten_line() as show:
        show("x" * 100)
    assert capsys.readouterr().err.count("x") == 39
