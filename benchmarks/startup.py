"""CPU seconds until something can begin: imports, and the answers of the command line, in fresh processes.

    .venv/bin/python benchmarks/startup.py
    .venv/bin/python benchmarks/startup.py --modules 20    # and the modules that take most of `import vislam.slam`

The least of several runs, for other work on the machine only adds; byte code and compiled kernels are there already.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
_ANSWER = "import sys; from vislam.cli import run_verb\ntry: run_verb({})\nexcept SystemExit: pass"
CASES = {
    "import numpy": "import numpy",
    "import numba, gtsam, cv2, scipy.spatial": "import numba, gtsam, cv2, scipy.spatial.transform",
    "import vislam.slam": "import vislam.slam",
    "vislam --help": _ANSWER.format(["--help"]),
    "vislam run --help": _ANSWER.format(["run", "--help"]),
    "vislam run --help-all": _ANSWER.format(["run", "--help-all"]),
}


def cpu_s(script: str, environment: dict[str, str], *options: str) -> tuple[float, str]:
    """Return user and system time in s of a script in a new interpreter, and what it said on stderr."""
    timed = (
        f"{script}\nimport time\nprint(time.process_time(), file=sys.stderr)"
        if "import sys" in script
        else (f"{script}\nimport sys, time\nprint(time.process_time(), file=sys.stderr)")
    )
    done = subprocess.run(
        [sys.executable, *options, "-c", timed], capture_output=True, text=True, check=True, cwd=ROOT, env=environment
    )
    return float(done.stderr.split()[-1]), done.stderr


def slowest(trace: str, count: int) -> list[tuple[str, float]]:
    """Return the packages (of vislam and scipy: rooms) that take most by themselves in s, by `-X importtime`."""
    sums: Counter[str] = Counter()
    for own_us, name in re.findall(r"import time:\s+(\d+) \|\s+\d+ \|\s+(\S+)", trace):
        top = name.split(".")
        sums[".".join(top[: 2 if top[0] in ("vislam", "scipy") else 1])] += int(own_us)
    return [(name, own_us * 1e-6) for name, own_us in sums.most_common(count)]


def main() -> None:
    """Print a line per case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--modules", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as bytecode:
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONPYCACHEPREFIX": bytecode}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        for name, script in CASES.items():
            cpu_s(script, environment)  # writes byte code
            print(f"{min(cpu_s(script, environment)[0] for _ in range(options.runs)):6.2f} s  {name}", flush=True)
        if options.modules:
            trace = cpu_s("import vislam.slam", environment, "-X", "importtime")[1]
            for name, own_s in slowest(trace, options.modules):
                print(f"{own_s:8.3f} s  {name}")


if __name__ == "__main__":
    main()
