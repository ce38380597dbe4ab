"""The body between keyframes, and sensors as linear systems."""

import sys

import numpy as np
import pytest

from vislam.core.geometry import se3_exp, so3_exp, so3_log
from vislam.core.messages import Array
from vislam.core.readings import Reading, Station
from vislam.sensors import BodyState, Sensor, SensorError, Variable, linearised
from vislam.sensors.body import NUDGE, PARTS, between_keyframes, by_keyframes, path_by_force


def a_body(rng: np.random.Generator) -> BodyState:
    return BodyState(
        0, so3_exp(rng.normal(size=3)), rng.normal(size=3), rng.normal(size=3), np.zeros(3), np.zeros(3),
        rng.normal(size=3),
    )  # fmt: skip


def a_station(rng: np.random.Generator) -> Station:
    return Station(
        0.2, 0.5, so3_exp(0.2 * rng.normal(size=3)), rng.normal(size=3), rng.normal(size=3),
        so3_exp(0.3 * rng.normal(size=3)), rng.normal(size=3), 9.81, rng.normal(size=3), np.zeros(3), np.zeros(3), 0.1,
    )  # fmt: skip


def error_between(one: BodyState, other: BodyState) -> Array:
    turned = so3_log(np.ascontiguousarray(one.R_world_body.T @ other.R_world_body))
    return np.concatenate([turned, other.position_m - one.position_m, other.velocity_m_s - one.velocity_m_s])


def test_the_path_between_keyframes_has_the_derivatives_that_it_says() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        T_a = se3_exp(rng.normal(size=6))
        T_b, station, h = T_a @ se3_exp(0.3 * rng.normal(size=6)), a_station(rng), 1e-6
        here = between_keyframes(T_a, T_b, 0, station)
        by_earlier, by_later = by_keyframes(T_a, T_b, station)
        for k, e in enumerate(np.eye(6) * h):
            moved = [between_keyframes(T_a @ se3_exp(s * e), T_b, 0, station) for s in (1, -1)]
            change = (error_between(here, moved[0]) - error_between(here, moved[1])) / (2 * h)
            np.testing.assert_allclose(by_earlier[:, k], change, atol=1e-7)
            moved = [between_keyframes(T_a, T_b @ se3_exp(s * e), 0, station) for s in (1, -1)]
            change = (error_between(here, moved[0]) - error_between(here, moved[1])) / (2 * h)
            np.testing.assert_allclose(by_later[:, k], change, atol=1e-7)


def test_the_path_ends_at_its_keyframes_and_is_surest_of_position_there() -> None:
    rng = np.random.default_rng(6)
    station, T_a = a_station(rng), se3_exp(rng.normal(size=6))
    T_b = T_a @ se3_exp(0.2 * rng.normal(size=6))
    begin = Station(
        0.0, 0.5, np.eye(3), np.zeros(3), np.zeros(3), station.dR_all, station.dp_all_m, 9.81, station.rate_rad_s,
        np.zeros(3), np.zeros(3), 0.1,
    )  # fmt: skip
    end = Station(
        0.5, 0.5, station.dR_all, np.zeros(3), station.dp_all_m, station.dR_all, station.dp_all_m, 9.81,
        station.rate_rad_s, np.zeros(3), np.zeros(3), 0.1,
    )  # fmt: skip
    for T, place in ((T_a, begin), (T_b, end)):
        body = between_keyframes(T_a, T_b, 0, place)
        np.testing.assert_allclose(body.R_world_body, T[:3, :3], atol=1e-12)
        np.testing.assert_allclose(body.position_m, T[:3, 3], atol=1e-12)
        assert abs(path_by_force(place)[0]) < 1e-15
    assert path_by_force(station)[0] < 0.0


@pytest.mark.parametrize("part", PARTS)
def test_a_nudged_body_is_one_that_was_moved(part: str) -> None:
    body = a_body(np.random.default_rng(4))
    for k, nudged in zip(range(PARTS[part].start, PARTS[part].stop), body.nudged(part), strict=True):
        moved = body.moved(NUDGE * np.eye(15)[k])
        for name in ("t_ns", "R_world_body", "position_m", "velocity_m_s", "rate_rad_s"):
            np.testing.assert_allclose(getattr(nudged, name), getattr(moved, name), rtol=0.0, atol=1e-15)
        for name in ("gyro_bias_rad_s", "accel_bias_m_s2"):
            np.testing.assert_array_equal(getattr(nudged, name), getattr(moved, name))


class Beacon(Sensor):
    """A range from an antenna to a place that is not known well."""

    columns = ("range_m",)
    touches = ("rotation", "position")
    variables = (Variable("x_m", 1.0), Variable("y_m", 1.0), Variable("z_m", 1.0))

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        antenna = body.position_m + body.R_world_body @ np.array([0.1, 0.0, 0.2])
        return values - np.linalg.norm(antenna - own)

    def noise(self, values: Array) -> Array:
        return np.array([[0.01]])


def test_derivatives_that_a_sensor_does_not_give_are_found() -> None:
    rng = np.random.default_rng(7)
    body, own = a_body(rng), np.array([3.0, -2.0, 1.0])
    linear = linearised(Beacon(), Reading("beacon", 0, np.array([4.0])), body, own)
    ray = body.position_m + body.R_world_body @ np.array([0.1, 0.0, 0.2]) - own
    ray /= np.linalg.norm(ray)
    np.testing.assert_allclose(linear.H[0, 3:6], ray, atol=1e-6)
    np.testing.assert_allclose(linear.H_own[0], -ray, atol=1e-6)
    assert not linear.H[0, 6:].any()


def longer_ahead(values: Array, body: BodyState, own: Array) -> Array:
    return np.zeros(1 + (body.position_m[0] > a_body(np.random.default_rng(8)).position_m[0]))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda values, body, own: np.zeros((1, 1)), "shape"),
        (longer_ahead, "shape"),
        (lambda values, body, own: np.full(1, np.nan), "not finite"),
        (lambda values, body, own: 1 / 0, "ZeroDivisionError"),
        (lambda values, body, own: sys.exit(1), "SystemExit"),
    ],
)
def test_what_a_sensor_does_wrong_is_told_by_its_name(wrong, message: str) -> None:
    sensor = Beacon()
    sensor.residual = wrong  # type: ignore[method-assign]
    with pytest.raises(SensorError, match=message) as caught:
        linearised(sensor, Reading("beacon", 7, np.array([4.0])), a_body(np.random.default_rng(8)), np.zeros(3))
    assert "'beacon' at 7 ns" in str(caught.value)
