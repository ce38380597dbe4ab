"""How verbs understand their arguments: tyro on a dataclass of options, whose comments are the --help."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import tyro

from vislam.errors import UsageError
from vislam.verbs import VERBS

Options = TypeVar("Options")


def parse(options: type[Options], arguments: list[str], verb: str, default: Options | None = None) -> Options:
    """Parse the arguments of a verb into its options; wrong ones leave with exit code 2, --help with 0."""
    start = tyro.MISSING_NONPROP if default is None else default
    return tyro.cli(options, prog=f"vislam {verb}", description=VERBS[verb].summary, args=arguments, default=start)


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
