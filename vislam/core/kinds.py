"""Tables of kinds by name: what vislam has itself, and what installed packages bring by an entry point."""

import logging
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, TypeVar

from vislam.core.errors import UsageError

T = TypeVar("T")
_MOST = 64  # of entry points that are looked at in one group
_LOG = logging.getLogger(__name__)


class Kinds(Mapping[str, T]):
    """A table that installed packages extend: docs/extend.md has the groups and what each asks for.

    A built-in name never asks what is installed, which takes time. A package that is broken is named in one line of the
    log, and left out where all kinds are gone through; asked for by name it raises UsageError with the reason.
    """

    def __init__(self, group: str, built_in: Mapping[str, T], check: Callable[[Any], str] = lambda _: "") -> None:
        """Take the built-in kinds; `check` returns why an object that a package brings cannot be one, empty: it can."""
        self.group = group
        self._known: dict[str, T] = dict(built_in)
        self._check = check
        self._left_out: set[str] = set()

    def __getitem__(self, name: str) -> T:
        if name not in self._known:
            self._known[name] = self._installed(name)
        return self._known[name]

    def __contains__(self, name: object) -> bool:
        return name in self._known or name in self._packages()

    def __iter__(self) -> Iterator[str]:
        for name in self._packages():
            if name not in self._known and name not in self._left_out:
                try:
                    self._known[name] = self._installed(name)
                except UsageError as error:
                    self._left_out.add(name)
                    _LOG.warning("left out: %s", error)
        return iter(tuple(self._known))

    def __len__(self) -> int:
        return len(tuple(iter(self)))

    def add(self, name: str, kind: T) -> None:
        """Make a kind known in this program; added again, the later one counts. Raises UsageError as a package does."""
        self._refuse(name, kind, "")
        self._known[name] = kind

    def forget(self, name: str) -> None:
        """Take a kind out again that was added, or that a package brought."""
        self._known.pop(name, None)

    def _packages(self) -> dict[str, list[Any]]:
        """Return the entry points of the group by name."""
        from importlib.metadata import entry_points  # takes time, and most never ask

        found: dict[str, list[Any]] = {}
        for point in sorted(entry_points(group=self.group), key=lambda point: (point.name, point.value))[:_MOST]:
            found.setdefault(point.name, []).append(point)
        return found

    def _installed(self, name: str) -> T:
        points = self._packages().get(name)
        if points is None:
            raise KeyError(name)
        packages = [point.dist.name if point.dist else "an unknown package" for point in points]
        if len(points) > 1:
            raise UsageError(
                f"{self.group} {name!r} comes from several packages: {', '.join(packages)}; uninstall all but one"
            )
        try:
            kind = points[0].load()
        except Exception as error:  # code of others
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise UsageError(
                f"{self.group} {name!r} of package {packages[0]} cannot be loaded from {points[0].value!r}: {reason}; "
                "repair or uninstall it"
            ) from error
        self._refuse(name, kind, f" of package {packages[0]}")
        return kind  # type: ignore[no-any-return]

    def _refuse(self, name: str, kind: Any, of: str) -> None:
        reason = self._check(kind)
        if reason:
            raise UsageError(f"{self.group} {name!r}{of}: {kind!r} {reason}; docs/extend.md")


def check_name(setting: str, name: str, built_in: Collection[str], group: str) -> None:
    """Raise UsageError where a setting names a kind that is neither built in nor brought by a package."""
    if name in built_in:
        return
    from importlib.metadata import entry_points

    known = [*built_in, *sorted({point.name for point in entry_points(group=group)})]
    if name not in known:
        raise UsageError(f"{setting}: there is no '{name}'; there are: {', '.join(known)}")


def lacking(*methods: str) -> Callable[[Any], str]:
    """Return a check that a kind has these attributes."""

    def check(kind: Any) -> str:
        missing = [name for name in methods if not hasattr(kind, name)]
        return f"has no {', '.join(missing)}" if missing else ""

    return check
