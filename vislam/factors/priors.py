"""Priors of the first state: the gauge fixed tightly, tilt, velocity and biases as well as initialisation knew them."""

from __future__ import annotations

import gtsam
import numpy as np

from vislam.config import GraphConfig
from vislam.core.messages import Array
from vislam.factors.journal import StartRecord
from vislam.factors.keys import B, V, X, bias_of
from vislam.factors.noise_models import gaussian, sigmas

GAUGE_SIGMA = 1e-3  # m and rad: first position and yaw are a free choice, fixed far below what is measured
_TILT_SIGMA_MAX_DEG = 5.0  # first roll and pitch follow the initialisation, within these bounds
_TILT_SIGMA_MIN_DEG = 0.05
# rad/s; bounds of the first bias prior, so that pivots stay within what gtsam takes
GYRO_BIAS_SIGMA_MAX = 0.05
ACCEL_BIAS_SIGMA_MAX = 0.5  # m/s^2


def start_factors(start: StartRecord, config: GraphConfig) -> list[gtsam.NonlinearFactor]:
    """Return the priors of keyframe 0: pose, and with an IMU velocity and biases."""
    model = gaussian(pose_covariance(start), config.covariance_ratio_max)
    factors: list[gtsam.NonlinearFactor] = [gtsam.PriorFactorPose3(X(0), gtsam.Pose3(start.T_map_body), model)]
    if not start.has_imu:
        return factors
    velocity = gaussian(start.covariance[6:9, 6:9] + 1e-6 * np.eye(3), config.covariance_ratio_max)
    factors.append(gtsam.PriorFactorVector(V(0), start.velocity_map_m_s, velocity))
    own = np.sqrt(np.diag(start.covariance))
    gyro = np.clip(own[9:12], 1e-5, GYRO_BIAS_SIGMA_MAX)
    accel = np.clip(own[12:15], 1e-4, ACCEL_BIAS_SIGMA_MAX)
    bias = bias_of(start.gyro_bias_rad_s, start.accel_bias_m_s2)
    factors.append(gtsam.PriorFactorConstantBias(B(0), bias, sigmas(np.concatenate([accel, gyro]))))
    return factors


def pose_covariance(start: StartRecord) -> Array:
    """Return the prior's covariance [6, 6], body side: yaw and position tight, tilt from the initial state.

    The rotation block is turned to map axes, where yaw is the z axis, bounded there and turned back.
    """
    out = np.eye(6) * GAUGE_SIGMA**2
    if not start.has_imu:
        return out
    R = start.T_map_body[:3, :3]
    tilt = (R @ start.covariance[:3, :3] @ R.T)[:2, :2]
    values, vectors = np.linalg.eigh(tilt)
    low, high = np.deg2rad(_TILT_SIGMA_MIN_DEG) ** 2, np.deg2rad(_TILT_SIGMA_MAX_DEG) ** 2
    world = np.zeros((3, 3))
    world[:2, :2] = (vectors * np.clip(values, low, high)) @ vectors.T
    world[2, 2] = GAUGE_SIGMA**2
    out[:3, :3] = R.T @ world @ R
    return out


def held_pose(k: int, T_map_body: Array) -> gtsam.PriorFactorPose3:
    """Return the factor that holds keyframe k at a pose [4, 4]."""
    model = sigmas(np.full(6, GAUGE_SIGMA))
    return gtsam.PriorFactorPose3(X(k), gtsam.Pose3(T_map_body), model)
