"""Kinds of sensors by name: built in, registered by a program, or brought by a package that is installed."""

from __future__ import annotations

import re

from vislam.core.errors import UsageError
from vislam.sensors import kinds as built_in
from vislam.sensors.configured import Configured

GROUP = "vislam.sensors"  # of entry points: `kind = "package.module:Class"`
_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
_KINDS: dict[str, type[Configured]] = {
    "position": built_in.Position,
    "range": built_in.AnchorRange,
    "height": built_in.Height,
    "heading": built_in.Heading,
    "magnetic_field": built_in.MagneticField,
    "wheels": built_in.Wheels,
    "ackermann": built_in.Ackermann,
    "twist": built_in.Twist,
    "omni": built_in.Omni,
    "pose": built_in.Pose,
    "odometry": built_in.Odometry,
}
_BUILT_IN = frozenset(_KINDS)


def register(kind: str, cls: type[Configured]) -> None:
    """Make a class known as a kind, for this program; registered again, the later class counts.

    Raises UsageError for a name that is built in or none, and for what is no sensor with settings.
    """
    if not _NAME.fullmatch(kind):
        raise UsageError(f"kind {kind!r}: small letters, digits and _ are asked, a letter first, 32 at most")
    if kind in _BUILT_IN:
        raise UsageError(f"kind {kind!r} is built in; choose another name")
    _check(kind, cls, "")
    _KINDS[kind] = cls


def kind_class(kind: str) -> type[Configured]:
    """Return the class of a kind. Raises UsageError for one that nobody brings, or whose package is broken."""
    if kind not in _KINDS:
        _KINDS[kind] = _installed(kind)
    return _KINDS[kind]


def _installed(kind: str) -> type[Configured]:
    """Return the class that an installed package brings; packages are looked through only here, for it takes time."""
    from importlib.metadata import entry_points

    found = list(entry_points(group=GROUP, name=kind))
    if not found:
        known = sorted({*_KINDS, *(point.name for point in entry_points(group=GROUP))})
        raise UsageError(f"no kind of sensor is called {kind!r}; there are: {', '.join(known)}; docs/your-sensor.md")
    packages = [point.dist.name if point.dist else "an unknown package" for point in found]
    if len(found) > 1:
        raise UsageError(f"kind {kind!r} comes from several packages: {', '.join(packages)}; uninstall all but one")
    try:
        cls = found[0].load()
    except Exception as error:  # it is somebody else's code
        raise UsageError(
            f"kind {kind!r} of package {packages[0]} cannot be loaded from {found[0].value!r}: "
            f"{type(error).__name__}: {error}; repair or uninstall it"
        ) from error
    _check(kind, cls, f" of package {packages[0]}")
    return cls


def _check(kind: str, cls: object, of: str) -> None:
    if not (isinstance(cls, type) and issubclass(cls, Configured) and hasattr(cls, "Settings")):
        raise UsageError(
            f"kind {kind!r}{of}: {cls!r} is no subclass of vislam.sensors.Configured with a dataclass `Settings`"
        )
