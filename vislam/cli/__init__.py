"""The command line: finds the verb and sets the exit code.

Exit codes: 0 done, 2 usage, 3 input or data, 4 tracking lost or a quality gate failed, 5 hardware, 130 interrupted.
"""

import gc
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module

from vislam.cli.verbs import VERBS
from vislam.core import interrupts
from vislam.core.errors import UsageError, VislamError, printable, storage_failure

# the matrices here are small: threads cost more than they bring, and replay must not depend on them
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a verb and leave the process with its exit code, soon after a signal that asks for it."""
    gc.set_threshold(50_000)  # modules make 200,000 objects that live on, over which it would go again and again
    with interrupts.bounded():
        code = run_verb(list(sys.argv[1:] if arguments is None else arguments))
        if interrupts.has_come():
            interrupts.leave(code)
        _let_go_of_output()
        gc.freeze()  # the end of the process looks for garbage among all that is not frozen
        sys.exit(code)


def run_verb(arguments: list[str]) -> int:
    """Run a verb; return the exit code. Expected failures become one line on stderr, bugs keep their traceback."""
    try:
        code = _answered(arguments)
        sys.stdout.flush()  # a disk that is full shows here
        return code
    except BrokenPipeError:
        return 0
    except KeyboardInterrupt:
        return _interrupted()
    except Exception as error:
        if interrupts.has_raised():  # what was interrupted may make another error of it
            return _interrupted()
        failure = storage_failure(error) if isinstance(error, OSError) else error
        if not isinstance(failure, VislamError):
            raise
        _complain(str(failure))
        return failure.exit_code


def _answered(arguments: list[str]) -> int:
    """Do what the arguments say; return the exit code."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_help())
        return 0 if arguments else UsageError.exit_code
    if arguments[0] in ("-V", "--version"):
        from vislam.core.revision import version

        print(version())
        return 0
    name, *rest = arguments
    if name not in VERBS:
        raise UsageError(f"no verb '{name}'; there are: {', '.join(VERBS)}")
    from vislam.cli.verbs.arguments import take_option
    from vislam.core.log import set_level

    kept_level = take_option(rest, "--log-level")
    if kept_level is not None:
        set_level(kept_level)
    code: int = (VERBS[name].main or import_module(f"vislam.cli.verbs.{name}").main)(rest)
    return code


def _let_go_of_output() -> None:
    """Give up what stdout did not take: Python would try again at its end, and change the exit code to 120."""
    try:
        sys.stdout.flush()
    except OSError:
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _interrupted() -> int:
    _complain("interrupted; what was written by then is kept")
    return interrupts.EXIT_CODE


def _complain(message: str) -> None:
    with suppress(OSError):  # the terminal is gone
        print(f"vislam: {printable(message)}", file=sys.stderr)


def _help() -> str:
    lines = ["usage: vislam VERB ...", "", "SLAM from a camera and a cheap IMU.", ""]
    lines += [f"  {name:<12}{verb.summary}" for name, verb in VERBS.items()]
    lines += ["", "examples:"] + [f"  {verb.example}" for verb in VERBS.values()]
    lines += [
        "",
        "vislam --version; --log-level debug, info, warning or error sets what log.txt of a run folder keeps.",
        "vislam VERB --help has the rest. Exit codes: 0 done, 2 usage, 3 data, 4 tracking lost, 5 hardware.",
    ]
    return "\n".join(lines)
