"""Kinds of sensors by name: built in, one file each, registered by a program, or of an installed package."""

import re

from vislam.core.errors import UsageError
from vislam.core.kinds import Kinds
from vislam.sensors.kinds.ackermann import Ackermann, AckermannSettings
from vislam.sensors.kinds.anchor_range import AnchorRange, AnchorRangeSettings
from vislam.sensors.kinds.given_pose import Odometry, OdometrySettings, Pose, PoseSettings
from vislam.sensors.kinds.heading import Heading, HeadingSettings
from vislam.sensors.kinds.height import Height, HeightSettings
from vislam.sensors.kinds.magnetic_field import MagneticField, MagneticFieldSettings
from vislam.sensors.kinds.position import Position, PositionSettings
from vislam.sensors.kinds.twist import Omni, Twist, TwistSettings
from vislam.sensors.kinds.wheels import Wheels, WheelsSettings
from vislam.sensors.sensor import Configured

__all__ = [
    "Ackermann", "AckermannSettings", "AnchorRange", "AnchorRangeSettings", "Heading", "HeadingSettings", "Height",
    "HeightSettings", "MagneticField", "MagneticFieldSettings", "Odometry", "OdometrySettings", "Omni", "Pose",
    "PoseSettings", "Position", "PositionSettings", "Twist", "TwistSettings", "Wheels", "WheelsSettings",
]  # fmt: skip
_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")


def _no_sensor(cls: object) -> str:
    is_one = isinstance(cls, type) and issubclass(cls, Configured) and hasattr(cls, "Settings")
    return "" if is_one else "is no subclass of vislam.sensors.Configured with a dataclass `Settings`"


_BUILT_IN: dict[str, type[Configured]] = {
    "position": Position,
    "range": AnchorRange,
    "height": Height,
    "heading": Heading,
    "magnetic_field": MagneticField,
    "wheels": Wheels,
    "ackermann": Ackermann,
    "twist": Twist,
    "omni": Omni,
    "pose": Pose,
    "odometry": Odometry,
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
