"""Turns journal records into factors and first guesses; a pure function of the records and the current estimate."""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from vislam.config import GraphConfig, MachineConfig
from vislam.core.geometry import invert, transform
from vislam.core.messages import Array
from vislam.factors import motion
from vislam.factors.journal import KeyframeRecord, StartRecord
from vislam.factors.keys import B, V, X, bias_of, nearest_rigid
from vislam.factors.motion import start_factors
from vislam.factors.noise_models import gaussian, huber, inflated
from vislam.factors.preintegration import Preintegrated, Preintegrator
from vislam.factors.visual import direction_as_pose, pose_factor
from vislam.imu import ImuNoise

_SUBMAP_SPEED_SIGMA_M_S = 3.0  # of the first velocity in a submap, with loose coupling


Label = tuple[str, int]  # names a factor that will be replaced or taken out: its kind and a number


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """State of one keyframe as numbers."""

    T_map_body: Array  # [4, 4]
    velocity_map_m_s: Array  # [3]
    bias: gtsam.imuBias.ConstantBias


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """The factors of one keyframe, the guess of its state, and the uncertainty its motion adds."""

    factors: list[gtsam.NonlinearFactor]
    guess: Guess
    variance_rad2: float  # per axis, of the motion since the previous keyframe
    variance_m2: float
    note: str
    named: dict[Label, gtsam.NonlinearFactor] = field(default_factory=dict)  # those that may be replaced later
    own: dict[int, float] = field(default_factory=dict)  # guesses of sensors' own variables that are new, by key


class Builder:
    """Knows the sensors; holds no state of the run."""

    def __init__(self, config: GraphConfig, noise: ImuNoise | None, machine: MachineConfig, lever_m: Array) -> None:
        """Set up for a rig: `lever_m` [3] is cam0 in the body frame."""
        self._config = config
        self._machine = machine
        self._lever_m = lever_m
        self._preintegrator = None if noise is None else Preintegrator(config, noise, machine)

    def start(self, record: StartRecord) -> tuple[list[gtsam.NonlinearFactor], Guess]:
        """Return the priors and state of keyframe 0."""
        bias = bias_of(record.gyro_bias_rad_s, record.accel_bias_m_s2)
        return start_factors(record, self._config), Guess(record.T_map_body, record.velocity_map_m_s, bias)

    def keyframe(
        self,
        record: KeyframeRecord,
        previous: KeyframeRecord,
        before: Guess,
        *,
        last_motion: Array,
        has_imu: bool,
        vo_scale: float,
        floor_m: float = 0.0,
    ) -> Step:
        """Return the factors that tie a keyframe to the previous one, whose state is `before`.

        `last_motion` [4, 4] is the motion of the step before, the guess where neither vision nor IMU saw this one.
        `vo_scale` multiplies the sigma of visual odometry: what loops taught about it. `floor_m` is the height in map
        at which a floor keeps the body. Every variable gets at least one factor that bounds it, whatever is missing.
        """
        machine = self._machine
        duration_s = (record.t_ns - previous.t_ns) * 1e-9
        integrated = None
        if has_imu and self._preintegrator is not None:
            integrated = self._preintegrator.integrate(record.imu, previous.t_ns, record.t_ns, before.bias)
        guess = self._guess(record, before, last_motion, duration_s, integrated)
        factors: list[gtsam.NonlinearFactor] = []
        notes: list[str] = []
        if record.T_previous_body is not None:
            factors.append(self._visual(record, before, guess, vo_scale))
        if integrated is not None and self._preintegrator is not None:
            factors.append(self._preintegrator.factor(record.id - 1, record.id, integrated))
            if integrated.outage_s > 0.0:
                notes.append(f"IMU outage of {integrated.outage_s:.2f} s bridged")
        elif has_imu and self._preintegrator is not None:
            factors += self._without_imu(record, guess, duration_s)
            notes.append("IMU missing over the span")
        unscaled = not record.has_scale and integrated is None
        loose_rad = np.deg2rad(machine.lost_rate_sigma_deg_s) * duration_s
        loose_m = machine.lost_speed_sigma_m_s * duration_s
        if (record.T_previous_body is None and integrated is None) or unscaled:
            T = invert(before.T_map_body) @ guess.T_map_body
            factors.append(motion.loose_motion(record.id, T, loose_rad, loose_m))
        if record.T_previous_body is None:
            notes.append("vision lost, bridged by " + ("IMU" if integrated is not None else "constant motion"))
        if record.rest_from is not None:
            factors.append(motion.no_motion(record.rest_from, record.id, machine))
            if has_imu:
                factors.append(motion.zero_velocity(record.id, machine.rest_speed_sigma_m_s))
        factors += self._on_wheels(record, before, has_imu, floor_m)
        if record.covariance is None or not record.has_scale:
            variances = (loose_rad**2, loose_m**2)
        else:
            covariance = self._visual_covariance(record, vo_scale)
            variances = (float(np.trace(covariance[:3, :3])) / 3.0, float(np.trace(covariance[3:, 3:])) / 3.0)
        return Step(factors, guess, *variances, note="; ".join(notes))

    def _on_wheels(
        self, record: KeyframeRecord, before: Guess, has_imu: bool, floor_m: float
    ) -> list[gtsam.NonlinearFactor]:
        """Return the factors of a cart on its floor, where it is configured as one."""
        machine, out = self._machine, list[gtsam.NonlinearFactor]()
        if machine.floor_sigma_m is not None:
            out.append(motion.on_floor(record.id, floor_m, machine.floor_sigma_m))
        if machine.slip_sigma_m_s is not None and has_imu and record.imu is not None and len(record.imu.t_ns):
            rate = record.imu.gyro_rad_s[-1] - np.array(before.bias.gyroscope())
            by_turn = np.cross(rate, np.array(machine.axle_m))
            out.append(motion.nonholonomic(record.id, by_turn, machine.slip_sigma_m_s))
        return out

    def _visual_covariance(self, record: KeyframeRecord, vo_scale: float) -> Array:
        assert record.covariance is not None
        return record.covariance if record.begins_submap else of_vision(record, self._config, vo_scale)

    def _visual(self, record: KeyframeRecord, before: Guess, guess: Guess, vo_scale: float) -> gtsam.NonlinearFactor:
        assert record.T_previous_body is not None
        config, covariance = self._config, self._visual_covariance(record, vo_scale)
        a, b = X(record.id - 1), X(record.id)
        T = record.T_previous_body
        if not record.has_scale:
            moved = invert(before.T_map_body) @ guess.T_map_body
            T, covariance = direction_as_pose(T, covariance, self._lever_m, moved)
        model = huber(gaussian(covariance, config.covariance_ratio_max), config.huber_k)
        return pose_factor(a, b, T, model)

    def _without_imu(self, record: KeyframeRecord, guess: Guess, duration_s: float) -> list[gtsam.NonlinearFactor]:
        """Keep velocity and biases bounded where the IMU factor had to be dropped."""
        assert self._preintegrator is not None
        walk = self._preintegrator.bias_walk_sigmas(duration_s)
        lost_m_s = self._machine.lost_speed_sigma_m_s
        sigma_m_s = _SUBMAP_SPEED_SIGMA_M_S if record.begins_submap else lost_m_s
        speed = motion.loose_velocity(record.id, guess.velocity_map_m_s, sigma_m_s)
        return [speed, motion.bias_walk(record.id, walk)]

    def _guess(
        self,
        record: KeyframeRecord,
        before: Guess,
        last_motion: Array,
        duration_s: float,
        integrated: Preintegrated | None,
    ) -> Guess:
        """Return where the keyframe should be: by scaled vision, else by the IMU, else by going on as before."""
        T, velocity = before.T_map_body @ last_motion, before.velocity_map_m_s
        if integrated is not None:
            state = gtsam.NavState(gtsam.Pose3(before.T_map_body), before.velocity_map_m_s)
            predicted = integrated.pim.predict(state, before.bias)
            T, velocity = predicted.pose().matrix(), np.array(predicted.velocity())
        measured = record.T_previous_body
        if measured is not None and record.has_scale:
            T = before.T_map_body @ measured
        elif measured is not None and integrated is None:
            step_m = float(np.linalg.norm(last_motion[:3, 3]))
            T = before.T_map_body @ transform(measured[:3, :3].copy(), step_m * measured[:3, 3])
        if record.begins_submap:
            velocity = np.zeros(3)
        elif integrated is None:
            velocity = (T[:3, 3] - before.T_map_body[:3, 3]) / duration_s
        return Guess(nearest_rigid(T), velocity, before.bias)


def insert_guess(values: gtsam.Values, k: int, guess: Guess, has_imu: bool) -> None:
    """Add the variables of keyframe k to `values`."""
    values.insert(X(k), gtsam.Pose3(guess.T_map_body))
    if has_imu:
        values.insert(V(k), guess.velocity_map_m_s)
        values.insert(B(k), guess.bias)


def read_guess(values: gtsam.Values, k: int, has_imu: bool) -> Guess:
    """Return the state of keyframe k in `values`."""
    T = values.atPose3(X(k)).matrix()
    if not has_imu:
        return Guess(T, np.zeros(3), gtsam.imuBias.ConstantBias())
    return Guess(T, np.array(values.atVector(V(k))), values.atConstantBias(B(k)))


def of_vision(record: KeyframeRecord, config: GraphConfig, vo_scale: float = 1.0) -> Array:
    """Return the covariance [6, 6] of a keyframe's motion by vision.

    Front ends measure the covariance of metric motions; `vo_inflation` is for one camera, which uses residuals alone.
    """
    assert record.covariance is not None
    of_residuals = 1.0 if record.has_scale else config.vo_inflation
    factor = vo_scale * of_residuals * (config.vo_degraded_inflation if record.degraded else 1.0)
    floor_m = config.vo_floor_m if record.has_scale else 0.0
    return inflated(record.covariance, factor, np.deg2rad(config.vo_floor_deg), floor_m)
