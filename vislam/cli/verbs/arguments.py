"""How verbs understand their arguments: tyro on a dataclass of options, whose comments are the --help."""

import re
import sys
from contextlib import redirect_stderr
from functools import cache
from io import StringIO
from pathlib import Path
from typing import TypeVar

from vislam.cli.verbs import VERBS
from vislam.cli.verbs.ahead import compile_ahead
from vislam.cli.verbs.brief import Brief, brief_help
from vislam.config.moved import refuse_moved
from vislam.config.ranges import check_ranges
from vislam.core.compiling import on_compilation
from vislam.core.errors import UsageError

Options = TypeVar("Options")


def parse(
    options: type[Options],
    arguments: list[str],
    verb: str,
    default: Options | None = None,
    brief: Brief | None = None,
    summary: str = "",
) -> Options:
    """Parse the arguments of a verb into its options; wrong ones leave with exit code 2, --help with 0.

    With `brief`, --help has the usual options and --help-all the rest. Raises UsageError for a number out of range.
    """
    if brief is not None and {"-h", "--help"} & {*arguments}:
        print(brief_help(verb, options, brief))
        raise SystemExit(0)
    arguments = ["--help" if argument == "--help-all" else argument for argument in arguments]
    refuse_moved(arguments)
    import tyro

    start = tyro.MISSING_NONPROP if default is None else default
    described = summary or VERBS[verb].summary
    said = StringIO()
    try:
        with redirect_stderr(said):
            parsed = tyro.cli(options, prog=f"vislam {verb}", description=described, args=arguments, default=start)
    except SystemExit as end:
        if end.code:
            raise UsageError(_in_one_line(said.getvalue(), verb)) from None
        raise
    check_ranges(parsed)
    _announce_compilation(verb)
    return parsed


def _in_one_line(box: str, verb: str) -> str:
    """Return the message of the parser of arguments, without the box around it, its title and its advice."""
    _, *lines = [line.strip(" \u2502\u256d\u256e\u2570\u256f\u2500") for line in box.splitlines()] or [""]
    said = " ".join(line for line in lines if line and not line.endswith("--help"))
    said = re.split(r" ?(?:Got errors:|Argument helptext:|For full helptext)", said)[0].rstrip(".")
    return f"{said}; vislam {verb} --help has the options"


@cache
def _announce_compilation(verb: str) -> None:
    """When this process has compiled for a second: say so on stderr, and have all compiled that the verb needs."""
    jobs = VERBS[verb.partition(" ")[0]].compiles

    def ahead() -> None:
        print("vislam: compiling for this processor, once ...", file=sys.stderr, flush=True)
        compile_ahead(jobs, shown=False)

    on_compilation(ahead)


def take_option(arguments: list[str], name: str) -> str | None:
    """Remove `--name VALUE` or `--name=VALUE` from the arguments and return the value."""
    for i, argument in enumerate(arguments):
        if argument == name:
            if i + 1 == len(arguments):
                raise UsageError(f"{name} needs a value")
            value = arguments[i + 1]
            del arguments[i : i + 2]
            return value
        if argument.startswith(f"{name}="):
            del arguments[i]
            return argument.partition("=")[2]
    return None


def take_path(arguments: list[str], name: str) -> Path | None:
    """Remove an option as `take_option` and return its value as a path."""
    value = take_option(arguments, name)
    return Path(value) if value else None
