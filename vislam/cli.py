"""The command line: finds the verb and sets the exit code.

Exit codes: 0 done, 2 usage, 3 input or data, 4 tracking lost or a quality gate failed, 5 hardware, 130 interrupted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module

from vislam.errors import UsageError, VislamError, printable
from vislam.verbs import VERBS

# the matrices here are small: threads cost more than they bring, and replay must not depend on them
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a verb and leave the process with its exit code."""
    sys.exit(run_verb(list(sys.argv[1:] if arguments is None else arguments)))


def run_verb(arguments: list[str]) -> int:
    """Run a verb; return the exit code. Expected failures become one line on stderr, bugs keep their traceback."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_help())
        return 0 if arguments else UsageError.exit_code
    name, *rest = arguments
    try:
        if name not in VERBS:
            raise UsageError(f"no verb '{name}'; there are: {', '.join(VERBS)}")
        return import_module(f"vislam.verbs.{name}").main(rest)
    except VislamError as error:
        _complain(str(error))
        return error.exit_code
    except BrokenPipeError:
        return 0
    except KeyboardInterrupt:
        _complain("interrupted; what was computed is in the run folder")
        return _INTERRUPTED


def _complain(message: str) -> None:
    print(f"vislam: {printable(message)}", file=sys.stderr)


def _help() -> str:
    lines = ["usage: vislam VERB ...", "", "SLAM from a camera and a cheap IMU.", ""]
    lines += [f"  {name:<12}{verb.summary}" for name, verb in VERBS.items()]
    lines += ["", "examples:"] + [f"  {verb.example}" for verb in VERBS.values()]
    lines += [
        "",
        "vislam VERB --help tells the rest. Exit codes: 0 done, 2 usage, 3 data, 4 tracking lost, 5 hardware.",
    ]
    return "\n".join(lines)
