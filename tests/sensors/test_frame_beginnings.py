"""Frames that sensors measure in are found from their first readings, and not before these tell them."""

import math
from dataclasses import replace

import numpy as np
import pytest

from vislam.core.angles import wrapped
from vislam.core.geometry import so3_exp
from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.sensors import Begun, BodyState
from vislam.sensors.kinds import (
    AnchorRange,
    AnchorRangeSettings,
    Heading,
    Height,
    Odometry,
    Pose,
    PoseSettings,
    Position,
    PositionSettings,
)
from vislam.sensors.measuring_frame import ENOUGH_YAW_RAD
from vislam.sensors.sensor import Configured
from vislam.sensors.simulated import Faults, drawn_readings

SEEDS = range(20)
FEWER = range(8)  # of what searches
ROOM = {"1": (0.0, 0.0, 2.5), "2": (8.0, 0.0, 2.2), "3": (8.0, 6.0, 0.5), "4": (0.0, 6.0, 2.0)}
FLAT = {name: (x, y, 1.0) for name, (x, y, _) in ROOM.items()}


def a_walk(seconds: float, size_m: float = 2.0, height_m: float = 0.3, hz: float = 5.0) -> list[BodyState]:
    """A path that bends, in a plane where its height is 0."""
    bodies = []
    for k in range(int(seconds * hz)):
        s = k / hz
        place = np.array([math.sin(0.5 * s), 1.0 - math.cos(0.31 * s), height_m / size_m * math.sin(0.7 * s)]) * size_m
        speed = np.array([0.5 * math.cos(0.5 * s), 0.31 * math.sin(0.31 * s), 0.0]) * size_m
        R = so3_exp(np.array([0.0, 0.0, 0.4 * s])) @ so3_exp(np.array([0.1 * math.sin(s), 0.05, 0.0]))
        bodies.append(BodyState(int(s * 1e9), R, place, speed, np.zeros(3), np.zeros(3), np.zeros(3)))
    return bodies


def frame_at_random(rng: np.random.Generator, size_m: float = 10.0) -> Array:
    return np.array([rng.uniform(-math.pi, math.pi), *(size_m * rng.normal(size=3))])


def off_by_sigmas(found: Begun, truth: Array) -> Array:
    away = found.values - truth
    away[0] = wrapped(float(away[0]))
    return away / found.sigmas


def first_begin(sensor: Configured, readings: list[Reading], bodies: list[BodyState]) -> tuple[int, Begun]:
    for count in range(len(readings) + 1):
        if found := sensor.begin(readings[:count], bodies[:count]):
            return count, found
    raise AssertionError("never begun")


@pytest.mark.parametrize("sigma_m", [0.02, 1.0])
def test_fixes_find_their_frame_as_soon_as_the_path_is_long_enough(sigma_m: float) -> None:
    sensor = Position(PositionSettings(sigma_m, 2.0 * sigma_m, lever_m=(0.2, 0.1, 0.5)))
    bodies, off, counts = a_walk(60.0, size_m=15.0), [], []
    for seed in SEEDS:
        truth = frame_at_random(np.random.default_rng(seed))
        readings = drawn_readings("gnss", sensor, bodies, truth, seed)
        count, found = first_begin(sensor, readings, bodies)
        assert found.sigmas[0] < ENOUGH_YAW_RAD
        counts.append(count)
        off.append(off_by_sigmas(found, truth))
    assert 0.5 < np.mean(np.square(off)) < 2.0
    assert np.abs(off).max() < 6.0
    assert (np.mean(counts) < 8) == (sigma_m < 0.1), "the noisier, the longer"


@pytest.mark.parametrize("turns", [True, False])
def test_a_lever_arm_that_is_not_known_is_in_the_frame_that_fixes_find(turns: bool) -> None:
    """All fixes share its error: however many there are, the frame is not known better than it."""
    told = PositionSettings(0.02, 0.04, lever_m=(0.2, 0.1, 0.5), lever_sigma_m=0.3)
    sensor, bodies, off = Position(told), a_walk(60.0, size_m=15.0), []
    if not turns:
        bodies = [replace(body, R_world_body=so3_exp(np.array([0.0, 0.0, 1.0]))) for body in bodies]
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        truth = frame_at_random(rng)
        own = np.concatenate([truth, np.array(told.lever_m) + told.lever_sigma_m * rng.normal(size=3)])
        readings = drawn_readings("gnss", sensor, bodies, own, seed)
        _, found = first_begin(sensor, readings, bodies)
        late = sensor.begin(readings, bodies)
        assert late is not None
        assert (found.sigmas[4:] == 0.3).all() and late.sigmas[3] >= 0.3
        off += [off_by_sigmas(Begun(begun.values[:4], begun.sigmas[:4]), truth) for begun in (found, late)]
    print(np.mean(np.square(off), axis=0))
    assert np.mean(np.square(off), axis=0).max() < 1.6
    assert np.mean(np.square(off), axis=0)[1:].min() > 0.3


@pytest.mark.parametrize(("anchor_m", "lever_m", "bias_m"), [(0.2, 0.0, 0.0), (0.0, 0.1, 0.0), (0.2, 0.1, 0.3)])
def test_places_of_anchors_that_are_not_known_are_in_the_frame_that_ranges_find(
    anchor_m: float, lever_m: float, bias_m: float
) -> None:
    told = AnchorRangeSettings(
        ROOM, 0.05, anchor_sigma_m=anchor_m, lever_m=(0.1, 0.0, 0.3), lever_sigma_m=lever_m, bias_sigma_m=bias_m
    )
    sensor, bodies, off = AnchorRange(told), a_walk(40.0), []
    for seed in FEWER:
        rng = np.random.default_rng(seed)
        own = np.array([variable.start + variable.sigma * rng.normal() for variable in sensor.variables])
        own[:4] = frame_at_random(rng)
        found = sensor.begin(drawn_readings("uwb", sensor, bodies, own, seed), bodies)
        assert found is not None
        off.append(off_by_sigmas(Begun(found.values[:4], found.sigmas[:4]), own[:4]))
    print(np.mean(np.square(off), axis=0))
    assert np.mean(np.square(off), axis=0).max() < 2.5
    assert np.mean(np.square(off)) > 0.3


def test_fixes_of_a_body_that_stands_tell_no_heading() -> None:
    sensor = Position(PositionSettings(0.5, 1.0))
    bodies = [a_walk(1.0)[0]] * 500
    for seed in SEEDS:
        assert sensor.begin(drawn_readings("gnss", sensor, bodies, np.zeros(4), seed), bodies) is None


def test_wild_fixes_do_not_spoil_the_frame() -> None:
    sensor, bodies = Position(PositionSettings(0.5, 1.0)), a_walk(40.0, size_m=20.0)
    for seed in SEEDS:
        truth = frame_at_random(np.random.default_rng(seed))
        readings = drawn_readings("gnss", sensor, bodies, truth, seed, Faults(outliers=0.1, outlier_m=50.0))
        found = sensor.begin(readings, bodies)
        assert found is not None
        assert np.abs(off_by_sigmas(found, truth)).max() < 6.0


def test_a_fix_counts_by_what_the_device_says_of_it() -> None:
    sensor, bodies = Position(PositionSettings(0.02, 0.04)), a_walk(6.0)
    readings = drawn_readings("gnss", sensor, bodies, np.zeros(4), 1)
    unsure = [Reading("gnss", r.t_ns, r.values, np.diag([9.0, 9.0, 25.0])) for r in readings]
    assert sensor.begin(readings, bodies) is not None
    assert sensor.begin(unsure, bodies) is None


def test_what_is_in_the_world_already_begins_at_once() -> None:
    known = Position(PositionSettings(frame="known", lever_m=(0.1, 0.0, 0.2), lever_sigma_m=0.05)).begin([], [])
    assert known is not None
    np.testing.assert_array_equal(known.values, [0.1, 0.0, 0.2])
    assert Height().begin([], []) is not None and Heading().begin([], []) is not None  # linear from anywhere


def range_settings(**more: object) -> AnchorRangeSettings:
    return AnchorRangeSettings(ROOM, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("biased", [False, True])
def test_ranges_find_the_frame_of_their_anchors(biased: bool) -> None:
    bias = {"bias_sigma_m": 0.3} if biased else {}
    sensor = AnchorRange(range_settings(sigma_m=0.05, lever_m=(0.1, 0.0, 0.3), **bias))
    bodies, off = a_walk(30.0, height_m=0.8, hz=8.0), []
    for seed in FEWER:
        rng = np.random.default_rng(seed)
        truth = np.array([rng.uniform(-math.pi, math.pi), *rng.uniform([2.0, 1.0, 0.5], [5.0, 4.0, 1.5])])
        truth = np.append(truth, 0.2) if biased else truth
        readings = drawn_readings("uwb", sensor, bodies, truth, seed)
        found = next((f for n in range(6, 240, 6) if (f := sensor.begin(readings[:n], bodies[:n]))), None)
        assert found is not None, seed
        off.append(off_by_sigmas(found, truth))
    assert np.abs(off).max() < 6.0
    assert 0.5 < np.mean(np.square(off)) < 2.0


def test_ranges_in_one_plane_need_to_be_told_the_height() -> None:
    bodies = a_walk(30.0, height_m=0.0, hz=8.0)
    for seed in FEWER:
        truth = np.array([0.3 * seed - 3.0, 4.0, 3.0, 0.0])
        unknown = AnchorRange(AnchorRangeSettings(FLAT, sigma_m=0.05))
        readings = drawn_readings("uwb", unknown, bodies, truth, seed)
        assert unknown.begin(readings, bodies) is None, "above and below the anchors look alike"
        told = AnchorRange(AnchorRangeSettings(FLAT, sigma_m=0.05, frame_z_sigma_m=0.05))
        found = told.begin(readings, bodies)
        assert found is not None
        assert np.abs(off_by_sigmas(found, truth)).max() < 6.0


def test_ranges_from_a_straight_path_along_anchors_in_a_line_are_mirrored() -> None:
    row = {str(k): (2.0 * k, 0.0, 0.0) for k in range(4)}
    sensor = AnchorRange(AnchorRangeSettings(row, sigma_m=0.05, frame_z_sigma_m=0.05))
    bodies = [BodyState(k, np.eye(3), np.array([0.03 * k, 0.0, 0.0]), *[np.zeros(3)] * 4) for k in range(200)]
    for seed in FEWER:
        readings = drawn_readings("uwb", sensor, bodies, np.array([0.4, 1.0, 2.0, 0.0]), seed)
        assert sensor.begin(readings, bodies) is None


def test_ranges_of_a_body_that_stands_tell_no_heading() -> None:
    sensor = AnchorRange(range_settings(sigma_m=0.1))
    bodies = [a_walk(1.0)[0]] * 300
    for seed in FEWER:
        assert sensor.begin(drawn_readings("uwb", sensor, bodies, np.array([0, 4.0, 3, 1]), seed), bodies) is None


def test_wild_ranges_do_not_spoil_the_frame() -> None:
    sensor, bodies = AnchorRange(range_settings(sigma_m=0.05)), a_walk(30.0, height_m=0.8, hz=8.0)
    truth = np.array([2.0, 4.0, 3.0, 1.0])
    for seed in FEWER:
        readings = drawn_readings("uwb", sensor, bodies, truth, seed, Faults(outliers=0.1, outlier_m=5.0))
        found = sensor.begin(readings, bodies)
        assert found is not None
        assert np.abs(off_by_sigmas(found, truth)).max() < 6.0


def test_poses_find_their_frame_at_once() -> None:
    sensor, bodies = Pose(PoseSettings(target_m=(0.1, 0.0, 0.2), time_offset_sigma_s=0.02)), a_walk(4.0)
    for seed in SEEDS:
        truth = np.append(frame_at_random(np.random.default_rng(seed)), 0.0)
        readings = drawn_readings("mocap", sensor, bodies, truth, seed, Faults(outliers=0.1))
        found = sensor.begin(readings, bodies)
        assert found is not None and sensor.begin(readings[:2], bodies[:2]) is None
        assert np.abs(off_by_sigmas(found, truth)).max() < 5.0
        assert 0.01 <= found.sigmas[0] < 0.02


def test_the_frame_of_an_odometry_walks() -> None:
    sensor = Odometry()
    assert [v.name for v in sensor.variables] == ["yaw_rad", "x_m", "y_m", "z_m"]
    assert all(v.walk > 0.0 for v in sensor.variables)
    bodies = a_walk(4.0)
    truth = np.array([1.0, 2.0, 3.0, 0.5])
    found = sensor.begin(drawn_readings("lidar", sensor, bodies, truth, 1), bodies)
    assert found is not None and np.abs(off_by_sigmas(found, truth)).max() < 5.0
