"""Factors that know how a body moves: rest, and loose continuity where nothing was measured."""

from __future__ import annotations

import gtsam
import numpy as np

from vislam.config import MachineConfig
from vislam.core.geometry import skew
from vislam.core.messages import Array
from vislam.factors.keys import B, V, X
from vislam.factors.noise_models import sigmas

SUBMAP_SIGMA_DEG = 30.0


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
