"""Every kind of sensor that is built in: derivatives, noise, and what it draws."""

import math
from dataclasses import replace

import numpy as np
import pytest

from vislam.core.geometry import so3_exp
from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.sensors import BodyState, Suite, linearised
from vislam.sensors.kinds import (
    Ackermann,
    AckermannSettings,
    AnchorRange,
    AnchorRangeSettings,
    Heading,
    HeadingSettings,
    Height,
    HeightSettings,
    MagneticField,
    MagneticFieldSettings,
    Odometry,
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
from vislam.sensors.linear import derived
from vislam.sensors.measuring_frame import about_up
from vislam.sensors.sensor import Configured
from vislam.sensors.simulated import Faults, drawn_readings

ANCHORS = {"1": (4.0, 1.0, 2.0), "2": (-3.0, 5.0, 2.5), "0x10": (0.5, -6.0, 0.2)}
TURNED = tuple(np.array([0.1, -0.2, 0.3, 0.9]) / math.sqrt(0.95))
MOUNTED = {"axle_m": (-0.3, 0.1, -0.2), "mount_rpy_rad": (0.05, -0.1, 0.4)}
SENSORS: dict[str, Configured] = {
    "position": Position(),
    "position with a lever": Position(PositionSettings(lever_m=(0.3, -0.2, 0.5), lever_sigma_m=0.1)),
    "position in the world": Position(PositionSettings(frame="known", lever_m=(0.3, -0.2, 0.5))),
    "range": AnchorRange(AnchorRangeSettings(ANCHORS)),
    "range of all unknown": AnchorRange(
        AnchorRangeSettings(ANCHORS, anchor_sigma_m=0.2, lever_m=(0.1, 0.0, 0.3), lever_sigma_m=0.1, bias_sigma_m=0.3,
                            scale_sigma=0.1)
    ),
    "range in the world": AnchorRange(AnchorRangeSettings(ANCHORS, frame="known", bias_m=0.2)),
    "height": Height(HeightSettings(lever_m=(0.3, -0.2, 0.5))),
    "heading": Heading(),
    "compass": Heading(HeadingSettings(clockwise=True)),
    "magnetic_field": MagneticField(),
    "magnetic_field beside iron": MagneticField(MagneticFieldSettings(field_ut=(20.0, 0.0, -42.0), bias_sigma_ut=2.0)),
    "wheels": Wheels(WheelsSettings(gyro_rad_s=0.0)),
    "wheels mounted": Wheels(WheelsSettings(mount_sigma_rad=0.05, gyro_rad_s=0.0, **MOUNTED)),
    "ackermann": Ackermann(AckermannSettings(mount_sigma_rad=0.05, gyro_rad_s=0.0, **MOUNTED)),
    "twist": Twist(TwistSettings(mount_sigma_rad=0.05, gyro_rad_s=0.0)),
    "omni": Omni(TwistSettings(gyro_rad_s=0.0, base_m=(-0.3, 0.1, -0.2), mount_rpy_rad=(0.05, -0.1, 0.4))),
    "pose": Pose(),
    "pose late": Pose(PoseSettings(target_m=(0.1, 0.2, 0.3), target_quaternion_xyzw=TURNED, time_offset_sigma_s=0.05)),
    "pose in the world": Pose(PoseSettings(frame="known", time_offset_s=0.1)),
    "odometry": Odometry(),
}  # fmt: skip
# half the second derivative times the step of 1e-6; wheels that are steered by 88 deg have one of 1e5
FORWARD = {"rtol": 2e-4, "atol": 2e-5}
DRIVEN = ("wheels", "wheels mounted", "ackermann", "twist")


def a_body(rng: np.random.Generator) -> BodyState:
    return BodyState(
        0, so3_exp(0.6 * rng.normal(size=3)), 3.0 * rng.normal(size=3), rng.normal(size=3), np.zeros(3), np.zeros(3),
        0.5 * rng.normal(size=3),
    )  # fmt: skip


def a_driving_body(sensor: Configured, own: Array, rng: np.random.Generator) -> BodyState:
    """A body whose base goes neither sideways nor up, whatever its mounting."""
    body = a_body(rng)
    motion = sensor.base_motion(body, own)  # type: ignore[attr-defined]
    steps = [body.moved(np.eye(15)[k]) for k in (6, 7, 8)]
    by_velocity = np.array([sensor.base_motion(step, own) - motion for step in steps]).T  # type: ignore[attr-defined]
    wanted = np.array([abs(motion[0]) + 1.0, 0.0, 0.0]) - motion[:3]
    return body.moved(np.concatenate([np.zeros(6), np.linalg.solve(by_velocity[:3], wanted), np.zeros(6)]))


def own_of(sensor: Configured, rng: np.random.Generator, by: float = 0.02) -> Array:
    starts = np.array([variable.start for variable in sensor.variables])
    wide = np.array([min(variable.sigma, 50.0 * by) for variable in sensor.variables])
    return starts + wide * rng.normal(size=len(starts))


@pytest.mark.parametrize("name", SENSORS)
def test_a_sensor_has_the_derivatives_that_it_says(name: str) -> None:
    sensor, rng = SENSORS[name], np.random.default_rng(1)
    for _ in range(20):
        body, own = a_body(rng), own_of(sensor, rng)
        near = body.moved(0.05 * rng.normal(size=15))
        values = sensor.draw(near, own, rng)
        H, H_own = sensor.jacobians(values, body, own)  # type: ignore[misc]
        wanted, wanted_own = derived(sensor, values, body, own)
        np.testing.assert_allclose(H, wanted, **FORWARD)
        np.testing.assert_allclose(H_own, wanted_own, **FORWARD)
        assert len(H_own[0]) == len(sensor.variables)


@pytest.mark.parametrize("name", SENSORS)
def test_a_sensor_that_sees_motion_only_says_the_same_of_the_same_motion_elsewhere(name: str) -> None:
    sensor, rng = SENSORS[name], np.random.default_rng(6)
    body, own = a_body(rng), own_of(sensor, rng)
    values, turn = sensor.draw(body, own, rng), so3_exp(np.array([0.0, 0.0, 0.7]))
    elsewhere = replace(
        body,
        R_world_body=turn @ body.R_world_body,
        position_m=turn @ body.position_m + np.array([0.4, -0.3, 0.2]),
        velocity_m_s=turn @ body.velocity_m_s,
    )
    differs = np.abs(sensor.residual(values, elsewhere, own) - sensor.residual(values, body, own)).max()
    assert (differs < 1e-9) == sensor.sees_motion_only


@pytest.mark.parametrize("name", SENSORS)
def test_nothing_shows_in_a_sensor_but_what_it_touches(name: str) -> None:
    sensor, rng = SENSORS[name], np.random.default_rng(2)
    body, own = a_body(rng), own_of(sensor, rng)
    values = sensor.draw(body, own, rng)
    error = np.zeros(15)
    for part, k in {"rotation": 0, "position": 3, "velocity": 6, "gyro_bias": 9, "accel_bias": 12}.items():
        if part not in sensor.touches:
            error[k : k + 3] = 0.1
    np.testing.assert_array_equal(sensor.residual(values, body, own), sensor.residual(values, body.moved(error), own))


@pytest.mark.parametrize("name", SENSORS)
def test_what_is_drawn_has_the_noise_that_the_sensor_says(name: str) -> None:
    sensor, rng = SENSORS[name], np.random.default_rng(3)
    scaled = name in (*DRIVEN, "omni")  # their noise is told at nominal scales
    own = own_of(sensor, rng, 0.0 if scaled else 0.02)
    body = a_driving_body(sensor, own, rng) if name in DRIVEN else a_body(rng)
    drawn = [sensor.draw(body, own, rng) for _ in range(4000)]
    residuals = np.array([sensor.residual(values, body, own) for values in drawn])
    noise = np.mean([sensor.noise(values) for values in drawn], axis=0)
    told = np.flatnonzero(residuals.std(axis=0) > 1e-9)  # not what a vehicle is believed not to do
    if name in DRIVEN:
        assert np.abs(np.delete(residuals, told, axis=1)).max() < 1e-9
    elif name == "omni":
        told = np.array([0, 1, 3])
    else:
        assert len(told) == residuals.shape[1]
    residuals, noise = residuals[:, told], noise[np.ix_(told, told)]
    sigmas = np.sqrt(np.diag(noise))
    assert np.abs(residuals.mean(axis=0) / sigmas).max() < 4.0 / math.sqrt(4000)
    np.testing.assert_allclose(np.cov(residuals.T).reshape(noise.shape) / np.outer(sigmas, sigmas),
                               noise / np.outer(sigmas, sigmas), atol=0.12)  # fmt: skip


@pytest.mark.parametrize("name", SENSORS)
def test_a_suite_takes_what_a_sensor_draws(name: str) -> None:
    sensor, rng = SENSORS[name], np.random.default_rng(4)
    own = own_of(sensor, rng)
    suite = Suite({"it": sensor})
    bodies = [a_body(rng) for _ in range(20)]
    for reading in drawn_readings("it", sensor, bodies, own, seed=4):
        if sensor.columns != ("speed_m_s", "steering_rad"):  # a car that goes any way steers by more than it can
            assert suite.why_unusable(reading) == ""


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("range", [1.0, -0.1], "negative range"),
        ("range", [3.0, 1.0], "anchor 3 is not among 1, 2, 16"),
        ("range", [1.5, 1.0], "anchor 1.5"),
        ("heading", [90.0], "degrees"),
        ("wheels", [1000.0, 0.0], "mm/s"),
        ("ackermann", [1.0, 30.0], "degrees"),
        ("pose", [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], "norm 0"),
        ("pose", [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0], "norm 1.41"),
    ],
)
def test_values_that_cannot_be_are_refused_with_a_reason(name: str, values: list[float], message: str) -> None:
    assert message in Suite({"it": SENSORS[name]}).why_unusable(Reading("it", 0, np.array(values)))


def test_a_heading_wraps_and_an_upright_body_has_none() -> None:
    sensor, own = Heading(), np.array([math.pi - 0.01])
    ahead = BodyState(0, np.eye(3), *[np.zeros(3)] * 5)
    np.testing.assert_allclose(sensor.residual(np.array([-math.pi + 0.01]), ahead, own), 0.02, atol=1e-12)
    up = BodyState(0, so3_exp(np.array([0.0, -math.pi / 2, 0.0])), *[np.zeros(3)] * 5)
    assert linearised(sensor, Reading("it", 0, np.zeros(1)), up, own).H.any() == np.False_


def test_wheels_tell_a_turn_from_a_gyroscope_bias() -> None:
    sensor, own = Wheels(), np.array([1.0, 1.0, 0.5])
    body = BodyState(0, np.eye(3), np.zeros(3), np.array([1.0, 0.0, 0.0]), np.zeros(3), np.zeros(3),
                     np.array([0.0, 0.0, 0.2]))  # fmt: skip
    np.testing.assert_allclose(sensor.residual(np.array([0.95, 1.05]), body, own), 0.0, atol=1e-12)
    biased = body.moved(np.array([0.0] * 11 + [0.1] + [0.0] * 3))
    np.testing.assert_allclose(sensor.residual(np.array([0.95, 1.05]), biased, own)[:2], [-0.025, 0.025], atol=1e-12)
    slipping = linearised(sensor, Reading("wheels", 0, np.array([1.45, 1.05])), body, own)
    assert slipping.residual @ np.linalg.solve(slipping.noise, slipping.residual) > 18.5, "the gate shuts"


def bodies_in_a_row(count: int) -> list[BodyState]:
    return [BodyState(k * 100_000_000, np.eye(3), np.array([0.1 * k, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]),
                      *[np.zeros(3)] * 3) for k in range(count)]  # fmt: skip


def test_faults_are_drawn_where_they_are_asked() -> None:
    sensor = Wheels()
    own = np.array([1.0, 1.0, 0.5])
    faults = Faults(outages=((1.0, 2.0),), stuck=((3.0, 4.0),), slips=((5.0, 6.0),), slip_share=1.0)
    drawn = drawn_readings("it", sensor, bodies_in_a_row(80), own, 5, faults)
    at = {reading.t_ns // 100_000_000: reading.values for reading in drawn}
    assert len(drawn) == 70
    assert not any(10 <= k < 20 for k in at)
    assert all((at[k] == at[29]).all() for k in range(30, 40))
    assert np.mean([at[k] for k in range(50, 60)]) == pytest.approx(2.0, abs=0.05)
    assert np.mean([at[k] for k in range(60, 80)]) == pytest.approx(1.0, abs=0.05)
    again = drawn_readings("it", sensor, bodies_in_a_row(80), own, 5, faults)
    assert all((a.values == b.values).all() for a, b in zip(drawn, again, strict=True))


def test_outliers_and_backward_stamps_come_as_often_as_asked() -> None:
    sensor, bodies = Position(PositionSettings(frame="known")), bodies_in_a_row(2000)
    drawn = drawn_readings("it", sensor, bodies, np.zeros(0), 6, Faults(outliers=0.1, backward=0.05, outlier_m=100.0))
    off = [np.abs(r.values - b.position_m).max() > 15.0 for r, b in zip(drawn, bodies, strict=True)]
    assert 0.07 < np.mean(off) < 0.13
    assert 0.03 < np.mean([r.t_ns < b.t_ns for r, b in zip(drawn, bodies, strict=True)]) < 0.07


@pytest.mark.parametrize("told", [(0.0, 1e4), (0.7, 0.1)])
def test_simulated_anchors_stand_about_the_path(told: tuple[float, float]) -> None:
    settings = AnchorRangeSettings(ANCHORS, anchor_sigma_m=0.1, frame_z_m=told[0], frame_z_sigma_m=told[1])
    suite, rng = Suite({"uwb": AnchorRange(settings)}), np.random.default_rng(7)
    path = np.array([100.0, -50.0, 3.0]) + rng.uniform(-4.0, 4.0, (50, 3))
    drawn = suite.drawn_own("uwb", rng)
    sensor = suite["uwb"]
    assert isinstance(sensor, AnchorRange)
    own = sensor.about(path, drawn)
    anchors = own[4:].reshape(-1, 3)
    assert own[0] == drawn[0]
    assert (own[4:] == drawn[4:]).all()
    middle, there = (0.5 * (places.min(axis=0) + places.max(axis=0)) for places in (path, anchors))
    assert (about_up(own[0]) @ middle + own[1:4])[:2] == pytest.approx(there[:2])
    assert own[3] == (drawn[3] if told[1] < 1e4 else told[0])
    known = AnchorRange(AnchorRangeSettings(ANCHORS, frame="known"))
    assert known.about(path, np.zeros(0)).shape == (0,)
