"""What a test beside load starts ends with it."""

import signal
import subprocess
import sys
from pathlib import Path

import psutil

from waiting import is_gone, wait_for

_SCRIPT = Path(__file__).parent.parent / "under_load.py"
_HANGS = """import pathlib, subprocess, sys, time
def test_it():
    subprocess.Popen([sys.executable, "-c", "import time; time.sleep(900)"])
    pathlib.Path("begun").touch()
    time.sleep(900)
"""


def test_when_it_is_terminated_pytest_and_what_that_started_end(tmp_path: Path) -> None:
    (tmp_path / "test_hangs.py").write_text(_HANGS)
    command = [sys.executable, str(_SCRIPT), "--busy", "1", "--", "-p", "no:cacheprovider", "test_hangs.py"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL) as run:
        wait_for((tmp_path / "begun").exists)
        started = psutil.Process(run.pid).children(recursive=True)
        assert len(started) == 3
        run.send_signal(signal.SIGTERM)
        assert run.wait() != 0
        wait_for(lambda: all(map(is_gone, started)))
