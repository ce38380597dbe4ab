"""The public API as a user meets it: a script that mypy accepts strictly, and that runs, entry by entry."""

import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import vislam

SCRIPT = Path(__file__).with_name("user_script.py")


def test_each_name_of_the_public_api_is_there_and_no_other_is_promised():
    for name in vislam.__all__:
        assert getattr(vislam, name) is not None
    assert set(vislam.__all__) <= set(dir(vislam))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = vislam.nothing


def test_run_is_a_function_also_after_its_room_was_imported():
    importlib.import_module("vislam.runs.folder")
    assert callable(vislam.run)


@pytest.mark.slow
def test_a_users_script_passes_mypy_strictly(tmp_path):
    """From another folder and without vislam's own settings: what is checked is what `py.typed` promises."""
    shutil.copy(SCRIPT, tmp_path)
    cache = SCRIPT.parents[2] / ".mypy_cache" / "user"  # kept: what has not changed takes half a minute
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(cache), SCRIPT.name]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_users_script_runs(tmp_path):
    done = subprocess.run(
        [sys.executable, str(SCRIPT)], cwd=tmp_path, env={**os.environ, "TMPDIR": str(tmp_path)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    shown = done.stdout.splitlines()
    for begin in ("run in ", "Slam(", "Ekf(", "Window(", "LoopDetector(", "Optimised(", "Octree(", "PoseGraphFile("):
        assert any(line.startswith(begin) for line in shown), f"{begin} prints what it is"
        assert not any("array(" in line for line in shown)
