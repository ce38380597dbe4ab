"""Ranges of the settings that are numbers: stated in their types, checked for a whole tree of settings at once.

`sigma_px: Positive = 1.0` is a float in code that uses it, and a value outside of its range is a usage error.
"""

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, get_args, get_type_hints

from vislam.core.errors import UsageError


@dataclass(frozen=True, slots=True)
class Range:
    """An interval of finite numbers, its ends included where they are not said to be left out."""

    low: float
    high: float
    without_low: bool = False
    without_high: bool = False

    def __contains__(self, value: float) -> bool:
        """Return whether a number lies inside; nan and infinities lie nowhere."""
        above = self.low < value if self.without_low else self.low <= value
        below = value < self.high if self.without_high else value <= self.high
        return math.isfinite(value) and above and below

    def __str__(self) -> str:
        low = f"more than {self.low:g}" if self.without_low else f"{self.low:g} or more"
        high = f"less than {self.high:g}" if self.without_high else f"{self.high:g} at most"
        return f"{low} and {high}"


_HUGE = 1e9
# by the ending of a setting's name, where its type allows more: an image's edge, a circle, half a day, 100 km, ...
_MOST_OF = {"_px": 2.0**14, "_deg": 360.0, "_s": 5e4, "_m": 1e5, "_hz": 1e5}

Finite = Annotated[float, Range(-_HUGE, _HUGE)]
NonNegative = Annotated[float, Range(0.0, _HUGE)]
Positive = Annotated[float, Range(1e-9, _HUGE)]
Cell = Annotated[float, Range(1e-3, 1e3)]  # edge of the cells of a map, in metres: memory goes with its third power
Share = Annotated[float, Range(0.0, 1.0)]
PositiveShare = Annotated[float, Range(0.0, 1.0, without_low=True)]
Probability = Annotated[float, Range(0.0, 1.0, without_low=True, without_high=True)]
Whole = Annotated[int, Range(0, 100_000)]
Count = Annotated[int, Range(1, 100_000)]
Few = Annotated[int, Range(1, 100)]  # of what each costs megabytes or a thread
Many = Annotated[int, Range(1, 10_000_000)]  # of what each costs bytes
Seed = Annotated[int, Range(0, 2**32 - 1)]


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting of a tree: `path` of names from the root, its type with its ranges, its class, what it is."""

    path: tuple[str, ...]
    type: Any
    owner: type
    value: Any

    @property
    def range(self) -> Range | None:
        """The interval that every number in it must lie in; None where it has no number."""
        found, name = range_of(self.type), self.path[-1]
        most = next((most for ending, most in _MOST_OF.items() if name.endswith(ending)), math.inf)
        if found is None or most >= found.high:
            return found
        return dataclasses.replace(found, low=max(found.low, -most), high=most)

    @property
    def option(self) -> str:
        """The option of the command line that sets it."""
        return "--" + ".".join(self.path).replace("_", "-")


def settings_of(root: Any, path: tuple[str, ...] = ()) -> Iterator[Setting]:
    """Yield the settings of a dataclass, or of an instance of one, with its defaults or values, depth first."""
    cls = root if isinstance(root, type) else type(root)
    types = _types(cls)
    for field in dataclasses.fields(cls):
        hint, value = types[field.name], _value(root, field)
        inner = get_args(hint)[0] if hasattr(hint, "__metadata__") else hint
        is_nameless = any(getattr(extra, "name", None) == "" for extra in getattr(hint, "__metadata__", ()))
        if dataclasses.is_dataclass(inner):
            yield from settings_of(
                value if dataclasses.is_dataclass(value) else inner, path if is_nameless else (*path, field.name)
            )
        else:
            yield Setting((*path, field.name), hint, cls, value)


def range_of(hint: Any) -> Range | None:
    """Return the range that a type carries: its own, or that of what it is made of."""
    for extra in getattr(hint, "__metadata__", ()):
        if isinstance(extra, Range):
            return extra
    return next((found for part in get_args(hint) if (found := range_of(part)) is not None), None)


def check_ranges(root: Any, where: str | None = None) -> None:
    """Raise UsageError for the first number of a tree of settings that is outside of its range.

    It names the setting in the file `where`, or without one the option of the command line.
    """
    for setting in settings_of(root):
        allowed = setting.range
        if allowed is None:
            continue
        for number in _numbers(setting.value):
            if number not in allowed:
                name = setting.option if where is None else f"{where}: {'.'.join(setting.path)}"
                raise UsageError(f"{name} is {number:g}; allowed is {allowed}")


@cache
def _types(cls: type) -> dict[str, Any]:
    return get_type_hints(cls, include_extras=True)


def _value(root: Any, field: dataclasses.Field[Any]) -> Any:
    if not isinstance(root, type):
        return getattr(root, field.name)
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return None if field.default is dataclasses.MISSING else field.default


def _numbers(value: Any) -> Iterator[float]:
    """Yield the numbers of a value: itself, or what is in its tuples."""
    if isinstance(value, tuple):
        for part in value:
            yield from _numbers(part)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield value
