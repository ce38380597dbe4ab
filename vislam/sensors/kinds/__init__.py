"""The kinds of sensors that are built in, one file each."""

from vislam.sensors.kinds.ackermann import Ackermann, AckermannSettings
from vislam.sensors.kinds.anchor_range import AnchorRange, AnchorRangeSettings
from vislam.sensors.kinds.given_pose import Odometry, OdometrySettings, Pose, PoseSettings
from vislam.sensors.kinds.heading import Heading, HeadingSettings
from vislam.sensors.kinds.height import Height, HeightSettings
from vislam.sensors.kinds.magnetic_field import MagneticField, MagneticFieldSettings
from vislam.sensors.kinds.position import Position, PositionSettings
from vislam.sensors.kinds.twist import Omni, Twist, TwistSettings
from vislam.sensors.kinds.wheels import Wheels, WheelsSettings

__all__ = [
    "Ackermann", "AckermannSettings", "AnchorRange", "AnchorRangeSettings", "Heading", "HeadingSettings", "Height",
    "HeightSettings", "MagneticField", "MagneticFieldSettings", "Odometry", "OdometrySettings", "Omni", "Pose",
    "PoseSettings", "Position", "PositionSettings", "Twist", "TwistSettings", "Wheels", "WheelsSettings",
]  # fmt: skip
