"""Own variables are found from drawn readings along a known path, as surely as the sensor's noise says."""

import math

import numpy as np
import pytest

from vislam.core.geometry import so3_exp
from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.sensors import BodyState, linearised
from vislam.sensors.kinds import (
    Ackermann,
    AckermannSettings,
    AnchorRange,
    AnchorRangeSettings,
    Heading,
    Height,
    Omni,
    Pose,
    PoseSettings,
    Position,
    PositionSettings,
    Twist,
    TwistSettings,
    Wheels,
    WheelsSettings,
)
from vislam.sensors.sensor import Configured
from vislam.sensors.simulated import drawn_readings

ANCHORS = {"1": (0.0, 0.0, 2.5), "2": (30.0, 0.0, 6.0), "3": (30.0, 30.0, 0.5), "4": (0.0, 30.0, 4.0)}
EVEN = {"slip": 0.0, "turn_slip": 0.0, "gyro_rad_s": 0.0}  # what is drawn, and at all speeds alike
SENSORS: dict[str, tuple[Configured, Array]] = {
    "position and its lever arm": (
        Position(PositionSettings(0.1, 0.2, lever_m=(0.3, 0.0, 0.4), lever_sigma_m=0.1)),
        np.array([2.0, 5.0, -3.0, 1.0]),
    ),
    "range, its anchors and its bias": (
        AnchorRange(AnchorRangeSettings(ANCHORS, sigma_m=0.1, anchor_sigma_m=0.05, bias_sigma_m=0.2)),
        np.array([-1.0, 12.0, 10.0, 1.0]),
    ),
    "height": (Height(), np.array([520.0])),
    "heading": (Heading(), np.array([2.0])),
    "wheels": (Wheels(WheelsSettings(**EVEN)), np.zeros(0)),
    "wheels and their mounting": (Wheels(WheelsSettings(mount_sigma_rad=0.03, upward_m_s=0.05, **EVEN)), np.zeros(0)),
    "ackermann": (Ackermann(AckermannSettings(gyro_rad_s=0.001, slip=0.0)), np.zeros(0)),
    "twist": (Twist(TwistSettings(**EVEN)), np.zeros(0)),
    "omni": (Omni(TwistSettings(**EVEN)), np.zeros(0)),
    "pose and its delay": (Pose(PoseSettings(time_offset_sigma_s=0.03)), np.array([3.0, 1.0, 2.0, 3.0])),
}  # fmt: skip


def a_drive(count: int = 450) -> list[BodyState]:
    """A cart that drives bends on a road that goes up and down, always straight ahead."""
    bodies, place, yaw, dt = [], np.zeros(3), 0.0, 0.1
    for k in range(count):
        speed, rate, slope = 1.5 + math.sin(0.05 * k), 0.8 * math.sin(0.031 * k), 0.15 * math.sin(0.04 * k)
        R = so3_exp(np.array([0.0, 0.0, yaw])) @ so3_exp(np.array([0.0, -slope, 0.0]))
        velocity = R @ np.array([speed, 0.0, 0.0])
        bodies.append(BodyState(k * 10**8, R, place, velocity, np.zeros(3), np.zeros(3), np.array([0.0, 0.0, rate])))
        place, yaw = place + dt * velocity, yaw + dt * rate
    return bodies


def estimated(sensor: Configured, readings: list[Reading], bodies: list[BodyState]) -> tuple[Array, Array]:
    """Return own variables and their covariance by a filter that knows the body."""
    begun, after = next(
        (found, count) for count in range(0, len(readings), 5)
        if (found := sensor.begin(readings[:count], bodies[:count])) is not None
    )  # fmt: skip
    own, P = begun.values.copy(), np.diag(begun.sigmas**2)
    for reading, body in zip(readings[after:], bodies[after:], strict=True):
        linear = linearised(sensor, reading, body, own)
        S = linear.H_own @ P @ linear.H_own.T + linear.noise
        gain = np.linalg.solve(S, linear.H_own @ P).T
        own = own + gain @ linear.residual
        left = np.eye(len(own)) - gain @ linear.H_own
        P = left @ P @ left.T + gain @ linear.noise @ gain.T
    return own, P


@pytest.mark.parametrize("name", SENSORS)
def test_own_variables_are_found_as_surely_as_is_said(name: str) -> None:
    (sensor, frame), bodies = SENSORS[name], a_drive()
    starts, sigmas = (np.array([getattr(v, part) for v in sensor.variables]) for part in ("start", "sigma"))
    nees = []
    for seed in range(5):
        truth = starts + sigmas * np.random.default_rng(seed).normal(size=len(starts))
        truth[: len(frame)] = frame
        if "mounting" in name:  # a base that is turned in the body goes its own way straight ahead
            truth[-2:] = 0.0
        readings = drawn_readings("it", sensor, bodies, truth, seed)
        own, P = estimated(sensor, readings, bodies)
        assert (np.sqrt(np.diag(P)) < 0.999 * sigmas).all(), "every one is learnt"
        nees.append((own - truth) @ np.linalg.solve(P, own - truth) / len(own))
    assert np.mean(nees) < 1.6
    assert np.mean(nees) > 0.4 or "mounting" in name, "nothing sideways was drawn, and the truth was the start"


def test_noise_that_grows_with_what_is_told_makes_scales_wrong_by_little() -> None:
    """Readings that are too small by chance count as surer ones: a bias of twice the squared share."""
    sensor, bodies, off = Twist(TwistSettings(slip=0.02, turn_slip=0.05)), a_drive(), []
    for seed in range(8):
        own, _ = estimated(sensor, drawn_readings("it", sensor, bodies, np.ones(2), seed), bodies)
        off.append(own - 1.0)
    bias = np.abs(np.mean(off, axis=0))
    assert bias[0] < 2.0 * 0.02**2 + 0.001 and bias[1] < 2.0 * 0.05**2 + 0.003
