"""Doors of packages that load what they give only when it is asked for."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def late(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a `__getattr__` for a package that finds each name in the module that is its home.

    `homes` has several names of one module in a row, with blanks between them. A user of one
    small module of a package does not pay for the import of all that its door gives.
    """
    home_of = {name: home for names, home in homes.items() for name in names.split()}

    def find(name: str) -> Any:
        if name in home_of:
            return getattr(import_module(home_of[name]), name)
        raise AttributeError(f"module '{package}' has no attribute '{name}'")

    return find
