"""Kinds of sensors by name: built in, registered by a program, or brought by a package that is installed."""

import re

from vislam.core.errors import UsageError
from vislam.core.kinds import Kinds
from vislam.sensors import kinds as built_in
from vislam.sensors.configured import Configured

_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")


def _no_sensor(cls: object) -> str:
    is_one = isinstance(cls, type) and issubclass(cls, Configured) and hasattr(cls, "Settings")
    return "" if is_one else "is no subclass of vislam.sensors.Configured with a dataclass `Settings`"


_BUILT_IN: dict[str, type[Configured]] = {
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
KINDS = Kinds[type[Configured]]("vislam.sensors", _BUILT_IN, _no_sensor)


def register(kind: str, cls: type[Configured]) -> None:
    """Make a class known as a kind, for this program; registered again, the later class counts.

    Raises UsageError for a name that is built in or none, and for what is no sensor with settings.
    """
    if not _NAME.fullmatch(kind):
        raise UsageError(f"kind {kind!r}: small letters, digits and _ are asked, a letter first, 32 at most")
    if kind in _BUILT_IN:
        raise UsageError(f"kind {kind!r} is built in; choose another name")
    KINDS.add(kind, cls)


def kind_class(kind: str) -> type[Configured]:
    """Return the class of a kind. Raises UsageError for one that there is not, or whose package is broken."""
    try:
        return KINDS[kind]
    except KeyError:
        known = ", ".join(sorted(KINDS))
        raise UsageError(f"no kind of sensor is called {kind!r}; there are: {known}; docs/extend.md") from None
