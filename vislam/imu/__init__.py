"""Inertial data: noise model, calibration, spans, preintegration, rest detection, power-up, attitude without vision."""

from vislam.imu.attitude import AttitudeFilter
from vislam.imu.bias_memory import BiasMemory
from vislam.imu.buffer import ImuBuffer
from vislam.imu.condition import ConditionWatch, InertialCondition
from vislam.imu.noise import ImuCalibration, ImuNoise, MagCalibration
from vislam.imu.noise_floor import NoiseFloor, NoiseRatios, SeenNoise
from vislam.imu.power_up import PowerUp, Refusal, power_up
from vislam.imu.preintegration import Preintegrated, pose_after, preintegrate
from vislam.imu.rest import RestDetector
from vislam.imu.series import ImuSeries, join, shifted, subtract_bias

__all__ = [
    "AttitudeFilter",
    "BiasMemory",
    "ConditionWatch",
    "ImuBuffer",
    "ImuCalibration",
    "ImuNoise",
    "ImuSeries",
    "InertialCondition",
    "MagCalibration",
    "NoiseFloor",
    "NoiseRatios",
    "PowerUp",
    "Preintegrated",
    "Refusal",
    "RestDetector",
    "SeenNoise",
    "join",
    "pose_after",
    "power_up",
    "preintegrate",
    "shifted",
    "subtract_bias",
]
