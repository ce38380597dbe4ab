"""Run tests beside busy loops, with their processes stopped at random: none may depend on the machine's speed.

python tests/under_load.py [--busy 8] [--seed 0] -- tests/hw tests/live -n 3
"""

import argparse
import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

_LONGEST_S = 2.0  # for which a process is stopped


def descendants(of: int) -> list[int]:
    """Return the processes that a process has started, and theirs."""
    found: list[int] = []
    for thread in Path(f"/proc/{of}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            for child in map(int, thread.read_text().split()):
                found += [child, *descendants(child)]
    return found


def main() -> int:
    """Return what pytest returned."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--busy", type=int, default=8, help="busy loops beside the tests")
    parser.add_argument("--seed", type=int, default=0, help="of which process stops when and for how long")
    parser.add_argument("tests", nargs="+", help="arguments of pytest, after --")
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(given.busy)]
    tests = subprocess.Popen([sys.executable, "-m", "pytest", "-q", *given.tests])
    rng = random.Random(given.seed)
    try:
        while tests.poll() is None:
            time.sleep(rng.uniform(0.0, _LONGEST_S))
            one, long_s = rng.choice([*descendants(tests.pid), 0]), rng.uniform(0.0, _LONGEST_S)
            with contextlib.suppress(OSError):  # it has ended, or none runs
                if ") T " in Path(f"/proc/{one}/stat").read_text():
                    continue  # a test has stopped it, and lets it go on itself
                os.kill(one, signal.SIGSTOP)
                time.sleep(long_s)
                os.kill(one, signal.SIGCONT)
    finally:
        for loop in loops:
            loop.kill()
        if tests.poll() is None:
            for one in [tests.pid, *descendants(tests.pid)]:
                with contextlib.suppress(OSError):
                    os.kill(one, signal.SIGTERM)
                    os.kill(one, signal.SIGCONT)
    return tests.wait()


if __name__ == "__main__":
    sys.exit(main())
