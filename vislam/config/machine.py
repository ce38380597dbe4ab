"""Defaults of the machine that carries camera and IMU: stated once for front end, filter, window and graph."""

from dataclasses import dataclass
from typing import Annotated

from vislam.config.ranges import Finite, NonNegative, Positive, Range

USUAL_SLIP_M_S = 0.02  # of an axle, and the mounting of the IMU: 1 degree at 1 m/s


@dataclass(frozen=True, slots=True)
class MachineConfig:
    """What moves and where: gravity, how the body moves while nothing is measured, and the wheels of a cart."""

    gravity_m_s2: Annotated[float, Range(0.1, 100.0)] = (
        9.81  # where it was recorded: 9.780 at the equator to 9.832 at the poles
    )
    # a longer hole between inertial samples is an outage; of an IMU of 3 to 15 Hz, 1.5 of its periods
    max_gap_s: NonNegative = 0.1
    max_outage_s: NonNegative = 1.0  # outages up to this are bridged with the two sigmas below, longer ones are not
    outage_accel_sigma_m_s2: NonNegative = 3.0  # specific force during an outage, against its interpolation
    outage_gyro_sigma_rad_s: NonNegative = 1.0
    lost_speed_sigma_m_s: NonNegative = 1.0  # without vision and IMU the body keeps its velocity, to within this
    lost_rate_sigma_deg_s: NonNegative = 30.0
    rest_speed_sigma_m_s: Positive = 0.005  # of a keyframe at rest: motors and hands let a body sway
    rest_sigma_m: Positive = 0.001  # of a keyframe at rest against the one at which rest began
    rest_sigma_deg: Positive = 0.05
    # a cart on one level floor without ramps: its height varies by this; None: it may leave the floor
    floor_sigma_m: NonNegative | None = None
    # a cart on wheels: how fast its axle slips sideways or lifts, 0.02 with an IMU mounted to 1 degree at 1 m/s;
    # None: it has no such axle. The filter and the graph use it with loose coupling only
    slip_sigma_m_s: NonNegative | None = None
    axle_m: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)  # middle of the axle that does not steer, in the body frame
