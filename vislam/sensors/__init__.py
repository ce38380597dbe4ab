"""Sensors other than IMU and camera: one definition of each, which both filters and the graph use alike."""

from vislam.sensors.body import BodyState
from vislam.sensors.configured import Configured
from vislam.sensors.linear import Linear, SensorError, linearised
from vislam.sensors.registry import kind_class, register
from vislam.sensors.sensor import Begun, Sensor, Variable
from vislam.sensors.suite import Suite
from vislam.sensors.toml import SensorFile, SensorSetup, load_sensor_setup

__all__ = [
    "Begun",
    "BodyState",
    "Configured",
    "Linear",
    "Sensor",
    "SensorError",
    "SensorFile",
    "SensorSetup",
    "Suite",
    "Variable",
    "kind_class",
    "linearised",
    "load_sensor_setup",
    "register",
]
