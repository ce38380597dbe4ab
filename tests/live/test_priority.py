"""The pose's process asks the system to let it run soon, whatever the system makes of that."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

_CODE = """
import os
from pathlib import Path
from vislam.live.processes.fast import take_short_turns
before = os.nice(3), os.sched_getscheduler(0)
take_short_turns()
print(before == (os.nice(0), os.sched_getscheduler(0)))
print(Path("/proc/self/sched").read_text() if Path("/proc/self/sched").exists() else "")
"""


def test_short_turns_are_asked_for_and_change_nothing_else() -> None:
    done = subprocess.run([sys.executable, "-c", _CODE], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("True")
    turn_ns = re.search(r"se\.slice +: +(\d+)", done.stdout)
    release = re.match(r"(\d+)\.(\d+)", Path("/proc/sys/kernel/osrelease").read_text())
    if turn_ns is None or release is None or tuple(map(int, release.groups())) < (6, 12):
        pytest.skip("this kernel has no turns of one's own, or does not show them")
    assert int(turn_ns[1]) == 500_000
