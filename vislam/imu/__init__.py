"""Inertial data: noise model, calibration, spans, preintegration, rest detection, power-up, attitude without vision.

Compiled by hand: 300 lines. Peers: gtsam's preintegration, not measured for time, and the library `vqf`, whose errors
of inclination stand beside ours in benchmarks/RESULTS.md, its time not. The process that publishes the pose must not
load gtsam; `vqf` is to be preferred if it takes a changing interval and is as good on carts.
"""

from vislam.core.imu_noise import ImuCalibration, ImuNoise, MagCalibration
from vislam.imu.attitude import AttitudeFilter
from vislam.imu.buffer import ImuBuffer
from vislam.imu.condition import ConditionWatch, InertialCondition
from vislam.imu.noise_floor import NoiseFloor, NoiseRatios, SeenNoise
from vislam.imu.power_up import BiasMemory, PowerUp, Refusal, power_up
from vislam.imu.preintegration import Preintegrated, pose_after, preintegrate
from vislam.imu.resting import RestDetector, is_slow, state_at_rest
from vislam.imu.series import ImuSeries, join, shifted, subtract_bias
from vislam.imu.witness import MotionWitness

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
    "MotionWitness",
    "NoiseFloor",
    "NoiseRatios",
    "PowerUp",
    "Preintegrated",
    "Refusal",
    "RestDetector",
    "SeenNoise",
    "is_slow",
    "join",
    "pose_after",
    "power_up",
    "preintegrate",
    "shifted",
    "state_at_rest",
    "subtract_bias",
]
