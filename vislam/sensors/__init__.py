"""Sensors other than IMU and camera: one definition of each, which filters, graph and batch use alike."""

from vislam.sensors.body import BodyState
from vislam.sensors.linear import Linear, SensorError, linearised
from vislam.sensors.sensor import Begun, Sensor, Variable
from vislam.sensors.suite import Suite

__all__ = ["Begun", "BodyState", "Linear", "Sensor", "SensorError", "Suite", "Variable", "linearised"]
