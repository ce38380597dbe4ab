"""Inertial data: noise model, calibration, the buffer that cuts spans, preintegration, rest detection."""

from vislam.imu.buffer import ImuBuffer
from vislam.imu.envelope import NoiseEnvelope, NoiseRatios
from vislam.imu.noise import ImuCalibration, ImuNoise, MagCalibration
from vislam.imu.preintegration import Preintegrated, preintegrate
from vislam.imu.rest import RestDetector
from vislam.imu.series import ImuSeries, join, subtract_bias

__all__ = [
    "ImuBuffer",
    "ImuCalibration",
    "ImuNoise",
    "ImuSeries",
    "MagCalibration",
    "NoiseEnvelope",
    "NoiseRatios",
    "Preintegrated",
    "RestDetector",
    "join",
    "preintegrate",
    "subtract_bias",
]
