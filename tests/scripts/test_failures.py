"""A full disk, missing rights, absent boards and bad files: a short fixed part of `experiments/failures.py`."""

import importlib.util
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from run_folder import make_run
from vislam.cli import run_verb
from vislam.core.errors import UsageError
from vislam.core.files import write_json
from vislam.core.log import log_to
from vislam.runs.folder import prepare
from vislam.runs.viewer import recording

_PATH = Path(__file__).resolve().parents[2] / "experiments" / "failures.py"
_SPEC = importlib.util.spec_from_file_location("failures", _PATH)
failures = importlib.util.module_from_spec(_SPEC)
sys.modules["failures"] = failures  # dataclasses look their module up
_SPEC.loader.exec_module(failures)

SHORT = [case for case in failures.cases() if case.is_short]


def can_mount(folder: Path) -> bool:
    if subprocess.run(["mount", "-t", "tmpfs", "tmpfs", str(folder)], capture_output=True, check=False).returncode:
        return False
    subprocess.run(["umount", str(folder)], check=True)
    return True


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    failures._MOUNTS = failures._MOUNTS and can_mount(folder)
    make_run(folder / "run", loops=4)
    assert run_verb([*failures.SIMULATE.split(), str(folder / "world")]) == 0
    assert run_verb(["simulate", "--graph", "grid3d", "--out", str(folder / "graph.g2o")]) == 0
    failures.make_small_files(folder)
    return folder


def test_the_short_part_has_every_kind_of_failure() -> None:
    assert {case.fault for case in SHORT} >= {"none", "full", "read-only"}
    assert {code for case in SHORT for code in case.codes} >= {3, 5}


@pytest.mark.parametrize("case", SHORT, ids=lambda case: case.name)
def test_what_fails_is_told_in_one_line_and_can_be_tried_again(
    case, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(data)
    outcome = failures.run_case(case, data, tmp_path, lambda words: (run_verb(words), 0.0, capsys.readouterr().err))
    assert outcome.faults == (), outcome.said


class Stream:
    """Rerun's, on a full disk."""

    def __init__(self, hangs: bool) -> None:
        self.released = threading.Event()
        self._hangs = hangs

    def flush(self) -> None:
        if not self._hangs:
            raise RuntimeError("File-writer thread shut down prematurely")
        self.released.wait(60.0)

    def disconnect(self) -> None:
        pass


@pytest.mark.parametrize(("hangs", "why"), [(True, "nothing was written for 0.3 s"), (False, "shut down prematurely")])
def test_a_recording_that_cannot_be_finished_is_given_up(
    hangs: bool, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "_STILL_S", 0.3)
    stream = Stream(hangs)
    problem = recording.finished(stream, tmp_path / "run.rrd")
    stream.released.set()
    assert problem is not None and problem.startswith("run.rrd is cut short") and why in problem


def test_a_run_that_ended_before_its_first_frame_may_be_tried_again(tmp_path: Path) -> None:
    out = tmp_path / "run"
    prepare(out, overwrite=False)
    with log_to(out, ["vislam", "live"]):
        write_json(out / "sensors.json", {})
        (out / ".config.json.123.partial").write_text("half")
        with pytest.raises(UsageError, match="at work"):
            prepare(out, overwrite=False)
    prepare(out, overwrite=False)
    assert list(out.iterdir()) == []


@pytest.mark.parametrize("name", ["notes.txt", "config/x", "trajectory.tum"])
def test_a_folder_with_something_else_in_it_is_left_alone(name: str, tmp_path: Path) -> None:
    (tmp_path / "log.txt").write_text("mine\n")
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine\n")
    with pytest.raises(UsageError, match="is not a run"):
        prepare(tmp_path, overwrite=True)
    assert (tmp_path / "log.txt").read_text() == "mine\n"


def test_a_run_whose_session_was_removed_still_asks(tmp_path: Path) -> None:
    make_run(tmp_path / "run", loops=4)
    (tmp_path / "run" / "manifest.json").write_text("{}")
    (tmp_path / "run" / "log.txt").write_text("")
    with pytest.raises(UsageError, match="add --overwrite"):
        prepare(tmp_path / "run", overwrite=False)
