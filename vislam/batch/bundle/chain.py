"""Factors along the chain of keyframes: first state, IMU, rest, and odometry where too few landmarks were seen."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from vislam.batch.posegraph.problem import RelativePoses
from vislam.config import GraphConfig, MachineConfig
from vislam.core.errors import DataError
from vislam.core.geometry import invert
from vislam.core.messages import Array
from vislam.factors import motion
from vislam.factors.builder import of_vision
from vislam.factors.factor_log import FactorLog
from vislam.factors.journal import KeyframeRecord, checked_poses, keyframe_records, start_record
from vislam.factors.keys import B, V, X, bias_of, nearest_rigid
from vislam.factors.motion import SUBMAP_SIGMA_DEG, start_factors
from vislam.factors.noise_models import DIRECTION_SCALE_SIGMA, gaussian, huber
from vislam.factors.preintegration import Preintegrator
from vislam.factors.visual import direction_as_pose, measurement_of, pose_factor

Factors = list[gtsam.NonlinearFactor]
_UNSCALED_SIGMA = 0.1  # relative, on the steps of the run's own odometry with one camera, among its loops


class Chain:
    """The validated measurements between keyframes of a run, and the factors that they make.

    Raises DataError when a keyframe of the log cannot be used.
    """

    def __init__(self, log: FactorLog, config: GraphConfig, machine: MachineConfig) -> None:
        """Check everything in the log but its tracks."""
        if not log.keyframes:
            raise DataError("the run has no keyframe to optimise; see tracking.csv for why none was taken")
        self._config = config
        self._machine = replace(machine, gravity_m_s2=log.gravity_m_s2)
        self._lever_m = log.rig.T_body_cam0[:3, 3]
        self.has_imu = log.first_state is not None and log.noise is not None
        first = log.first_state if self.has_imu else None
        self.start = start_record(first, log.keyframes[0].T_map_body)
        self._preintegrator = None
        if self.has_imu and log.noise is not None:
            self._preintegrator = Preintegrator(config, log.noise, self._machine)
        self.records = keyframe_records([keyframe.packet for keyframe in log.keyframes])
        whats = [f"the factor log's keyframe {i}" for i in range(len(log.keyframes))]
        self.poses = checked_poses([k.T_map_body for k in log.keyframes], whats)
        odom = checked_poses([k.T_odom_body for k in log.keyframes], whats)
        self._odometry = np.array([invert(a) @ b for a, b in pairwise(odom)]).reshape(-1, 4, 4)
        if not self.has_imu and any(not r.has_scale for r in self.records[1:]):
            raise DataError("the run is of one camera without an IMU: nothing in it shows scale")
        self._log = log

    def initial(self) -> gtsam.Values:
        """Return the run's own last estimate: poses, and with an IMU velocities and biases."""
        values = gtsam.Values()
        for k, T in enumerate(self.poses):
            values.insert(X(k), gtsam.Pose3(T))
        if not self.has_imu:
            return values
        gyro, accel = self.start.gyro_bias_rad_s, self.start.accel_bias_m_s2
        for k, logged in enumerate(self._log.keyframes):
            velocity = self._slope(k)
            if logged.velocity_map_m_s is not None and np.all(np.isfinite(logged.velocity_map_m_s)):
                velocity = logged.velocity_map_m_s
            if logged.gyro_bias_rad_s is not None and logged.accel_bias_m_s2 is not None:
                both = np.concatenate([logged.gyro_bias_rad_s, logged.accel_bias_m_s2])
                if np.all(np.isfinite(both)):
                    gyro, accel = both[:3], both[3:]
            values.insert(V(k), np.asarray(velocity, dtype=np.float64))
            values.insert(B(k), bias_of(gyro, accel))
        return values

    def factors(self, values: gtsam.Values, seen: NDArray[np.int64], min_seen: int) -> tuple[Factors, list[int]]:
        """Return the factors at the biases of `values`, and the keyframes that odometry had to tie.

        `seen` [K] is how many landmarks tie each keyframe; the others count on their own measurement of the motion.
        """
        factors: Factors = list(start_factors(self.start, self._config))
        tied = []
        for before, record in pairwise(self.records):
            k, duration_s = record.id, _duration_s(before, record)
            has_imu = self.has_imu and self._inertial(factors, record, before, values, duration_s)
            if record.begins_submap:
                factors.append(self._weak_link(record, robust=True))
            elif seen[k] < min_seen:
                tied.append(k)
                factors += self._odometry_factors(record, values, duration_s, has_imu)
            if record.rest_from is not None:
                factors.append(motion.no_motion(record.rest_from, k, self._machine))
                if self.has_imu:
                    factors.append(motion.zero_velocity(k, self._machine.rest_speed_sigma_m_s))
        return factors, tied

    def odometry(self) -> RelativePoses:
        """Return the run's own odometry from keyframe to keyframe, metric also where vision had no scale."""
        factors = [self._odometry_edge(before, record) for before, record in pairwise(self.records)]
        return RelativePoses.of([(r.id - 1, r.id) for r in self.records[1:]], [measurement_of(f) for f in factors])

    def _odometry_edge(self, before: KeyframeRecord, record: KeyframeRecord) -> gtsam.BetweenFactorPose3:
        """Return what the run's own odometry states of the motion to a keyframe."""
        if record.begins_submap:
            return self._weak_link(record, robust=False)
        T = self._odometry[record.id - 1]
        if record.T_previous_body is None or record.covariance is None:
            return motion.loose_motion(record.id, T, *self._loose(_duration_s(before, record)))
        T, covariance = self._metric(record, T, _UNSCALED_SIGMA)
        model = gaussian(covariance, self._config.covariance_ratio_max)
        return pose_factor(X(record.id - 1), X(record.id), T, model)

    def _inertial(
        self, factors: Factors, record: KeyframeRecord, before: KeyframeRecord, values: gtsam.Values, duration_s: float
    ) -> bool:
        """Add the IMU factor of a span, or what keeps velocity and biases bounded without; return whether it is one."""
        assert self._preintegrator is not None
        k = record.id
        bias = values.atConstantBias(B(k - 1))
        integrated = self._preintegrator.integrate(record.imu, before.t_ns, record.t_ns, bias)
        if integrated is not None:
            factors.append(self._preintegrator.factor(k - 1, k, integrated))
            return True
        walk = self._preintegrator.bias_walk_sigmas(duration_s)
        factors.append(motion.loose_velocity(k, self._slope(k), self._machine.lost_speed_sigma_m_s))
        factors.append(motion.bias_walk(k, walk))
        return False

    def _odometry_factors(
        self, record: KeyframeRecord, values: gtsam.Values, duration_s: float, has_imu: bool
    ) -> Factors:
        """Return what ties a keyframe that saw few landmarks to the one before."""
        k = record.id
        factors: Factors = []
        moved = nearest_rigid(invert(values.atPose3(X(k - 1)).matrix()) @ values.atPose3(X(k)).matrix())
        if record.T_previous_body is not None and record.covariance is not None:
            T, covariance = self._metric(record, moved, DIRECTION_SCALE_SIGMA)
            model = gaussian(covariance, self._config.covariance_ratio_max)
            factors.append(pose_factor(X(k - 1), X(k), T, huber(model, self._config.huber_k)))
        if not has_imu and not (factors and record.has_scale):
            factors.append(motion.loose_motion(k, self._odometry[k - 1], *self._loose(duration_s)))
        return factors

    def _metric(self, record: KeyframeRecord, T_expected: Array, scale_sigma: float) -> tuple[Array, Array]:
        """Return measured odometry as a metric motion with covariance; without scale `T_expected` lends its length."""
        assert record.T_previous_body is not None
        assert record.covariance is not None
        T, covariance = record.T_previous_body, of_vision(record, self._config)
        if record.has_scale:
            return T, covariance
        return direction_as_pose(T, covariance, self._lever_m, T_expected, scale_sigma)

    def _weak_link(self, record: KeyframeRecord, robust: bool) -> gtsam.BetweenFactorPose3:
        """Return what keeps a submap near where habit or else the run had it, should no loop tie it.

        `robust`: where habit has it, under Huber's kernel.
        """
        config, k = self._config, record.id
        if record.is_tied and record.T_previous_body is not None and record.covariance is not None:
            model: gtsam.noiseModel.Base = gaussian(record.covariance, config.covariance_ratio_max)
            model = huber(model, config.huber_k) if robust else model
            return pose_factor(X(k - 1), X(k), record.T_previous_body, model)
        T = nearest_rigid(invert(self.poses[k - 1]) @ self.poses[k])
        return motion.loose_motion(k, T, np.deg2rad(SUBMAP_SIGMA_DEG), config.submap_sigma_m)

    def _loose(self, duration_s: float) -> tuple[float, float]:
        machine = self._machine
        return np.deg2rad(machine.lost_rate_sigma_deg_s) * duration_s, machine.lost_speed_sigma_m_s * duration_s

    def _slope(self, k: int) -> Array:
        """Return the velocity [3] of keyframe k in map by differences of the run's poses."""
        last = len(self.poses) - 1
        a = k if k == 0 or self.records[k].begins_submap else k - 1
        b = k if k == last or self.records[k + 1].begins_submap else k + 1
        if a == b:
            return self.start.velocity_map_m_s
        duration_s = (self.records[b].t_ns - self.records[a].t_ns) * 1e-9
        return np.asarray((self.poses[b, :3, 3] - self.poses[a, :3, 3]) / duration_s)


def _duration_s(before: KeyframeRecord, record: KeyframeRecord) -> float:
    """Return the seconds between two keyframes; before a new submap, whose clock may begin again, at least one."""
    duration_s = (record.t_ns - before.t_ns) * 1e-9
    return max(duration_s, 1.0) if record.begins_submap else duration_s
