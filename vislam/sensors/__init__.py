"""Sensors other than IMU and camera: one definition of each, which both filters and the graph use alike."""

from typing import TYPE_CHECKING

from vislam.core.late import late
from vislam.sensors.body import BodyState
from vislam.sensors.correlated import Correlated
from vislam.sensors.kinds import kind_class, register
from vislam.sensors.linear import Linear, SensorError, derived, linearised, wrong_jacobians
from vislam.sensors.sensor import USER_ERRORS, Begun, Configured, Sensor, Variable
from vislam.sensors.toml import SensorFile, SensorSetup, Suite, load_sensor_setup

if TYPE_CHECKING:
    from vislam.sensors.simulated import Faults, bodies_on, drawn_readings

__all__ = [
    "USER_ERRORS",
    "Begun",
    "BodyState",
    "Configured",
    "Correlated",
    "Faults",
    "Linear",
    "Sensor",
    "SensorError",
    "SensorFile",
    "SensorSetup",
    "Suite",
    "Variable",
    "bodies_on",
    "derived",
    "drawn_readings",
    "kind_class",
    "linearised",
    "load_sensor_setup",
    "register",
    "wrong_jacobians",
]

__getattr__ = late(
    __name__,
    {
        "Faults": "vislam.sensors.simulated",
        "bodies_on": "vislam.sensors.simulated",
        "drawn_readings": "vislam.sensors.simulated",
    },
)
