"""Factors that know how a body moves: rest, and loose continuity where nothing was measured."""

from __future__ import annotations

import gtsam
import numpy as np

from vislam.config import GraphConfig
from vislam.factors.keys import B, V, X
from vislam.factors.noise import sigmas
from vislam.messages import Array


def zero_velocity(k: int, sigma_m_s: float) -> gtsam.PriorFactorVector:
    """Return the factor that keyframe k stands still."""
    return gtsam.PriorFactorVector(V(k), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, sigma_m_s))


def no_motion(rest_from: int, k: int, config: GraphConfig) -> gtsam.BetweenFactorPose3:
    """Return the factor that keyframe k is where rest began.

    From one keyframe of a rest to the next, as many small errors as there are keyframes would add up.
    """
    spread = np.repeat([np.deg2rad(config.rest_sigma_deg), config.rest_sigma_m], 3)
    return gtsam.BetweenFactorPose3(X(rest_from), X(k), gtsam.Pose3(), sigmas(spread))


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
