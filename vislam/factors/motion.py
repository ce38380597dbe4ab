"""Priors of the first state, the gauge fixed tightly, and factors that know how a body moves: rest, continuity."""

from __future__ import annotations

import gtsam
import numpy as np

from vislam.config import GraphConfig, MachineConfig
from vislam.core.geometry import skew
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
SUBMAP_SIGMA_DEG = 30.0


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


def zero_velocity(k: int, sigma_m_s: float) -> gtsam.PriorFactorVector:
    """Return the factor that keyframe k stands still."""
    return gtsam.PriorFactorVector(V(k), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, sigma_m_s))


def no_motion(rest_from: int, k: int, machine: MachineConfig) -> gtsam.BetweenFactorPose3:
    """Return the factor that keyframe k is where rest began.

    From one keyframe of a rest to the next, as many small errors as there are keyframes would add up.
    """
    spread = np.repeat([np.deg2rad(machine.rest_sigma_deg), machine.rest_sigma_m], 3)
    return gtsam.BetweenFactorPose3(X(rest_from), X(k), gtsam.Pose3(), sigmas(spread))


def on_floor(k: int, height_m: float, sigma_m: float) -> gtsam.CustomFactor:
    """Return the factor that keyframe k is at a height in map: a cart on one level floor."""

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        pose = values.atPose3(X(k))
        if jacobians is not None:
            jacobians[0] = np.concatenate([np.zeros(3), pose.rotation().matrix()[2]])[None]
        return np.array([pose.z() - height_m])

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, sigma_m), [X(k)], error)


def nonholonomic(k: int, by_turn_m_s: Array, sigma_m_s: float) -> gtsam.CustomFactor:
    """Return the factor that the axle of a cart goes neither sideways nor up at keyframe k.

    `by_turn_m_s` [3] is the velocity of the axle against the body's origin, in body axes: the rate of turn times its
    lever arm.
    """

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        R = values.atPose3(X(k)).rotation().matrix()
        velocity = R.T @ values.atVector(V(k))
        if jacobians is not None:
            jacobians[0] = np.hstack([skew(velocity), np.zeros((3, 3))])[1:]
            jacobians[1] = R.T[1:].copy()
        return np.asarray((velocity + by_turn_m_s)[1:])

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(2, sigma_m_s), [X(k), V(k)], error)


def loose_motion(k: int, T_guess: Array, sigma_rad: float, sigma_m: float) -> gtsam.BetweenFactorPose3:
    """Return a weak factor that keeps keyframe k tied to k - 1 by a guessed motion [4, 4]."""
    model = sigmas(np.repeat([sigma_rad, sigma_m], 3))
    return gtsam.BetweenFactorPose3(X(k - 1), X(k), gtsam.Pose3(T_guess), model)


def loose_velocity(k: int, velocity_m_s: Array, sigma_m_s: float) -> gtsam.PriorFactorVector:
    """Return a weak prior on the velocity of keyframe k, for where the IMU is missing."""
    return gtsam.PriorFactorVector(V(k), velocity_m_s, gtsam.noiseModel.Isotropic.Sigma(3, sigma_m_s))


def bias_walk(k: int, walk_sigmas: Array) -> gtsam.BetweenFactorConstantBias:
    """Return the random walk of the biases between keyframes k - 1 and k; sigmas [6] accelerometer first."""
    return gtsam.BetweenFactorConstantBias(B(k - 1), B(k), gtsam.imuBias.ConstantBias(), sigmas(walk_sigmas))
