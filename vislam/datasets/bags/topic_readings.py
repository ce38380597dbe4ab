"""Topics of a bag as readings of further sensors: what each type of message gives each kind of sensor."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import numpy as np

from vislam.core.errors import DataError
from vislam.core.readings import Reading
from vislam.core.recording import Problems
from vislam.datasets.bags.bag import Bag
from vislam.datasets.bags.choice import wanted_topic
from vislam.datasets.bags.decoding import (
    FIX,
    JOINTS,
    MAGNETIC,
    ODOMETRY,
    POSES,
    PRESSURE,
    RANGE,
    TWIST,
    TWIST_COVARIANCE,
    field_ut,
    need_rosbags,
    pose_numbers,
)
from vislam.datasets.bags.listing import Entry, Listing, fitting, stamp
from vislam.datasets.bags.streams import messages_of
from vislam.sensors.geodetic import Geodetic
from vislam.sensors.gnss import Fix, FixReadings
from vislam.sensors.gnss.fixes import FixKind
from vislam.sensors.sensor import Configured
from vislam.sensors.toml import JointsSettings, SensorFile

_FIXES: dict[int, FixKind] = {0: "single", 1: "differential", 2: "float"}  # 2: anything that a station on earth helps
_SEA_LEVEL_PA, _SCALE_M, _EXPONENT = 101_325.0, 44_330.8, 0.190_263  # of the standard atmosphere
_LEAST_PA, _MOST_PA = 10_000.0, 120_000.0  # in the air that one breathes, and a little beyond; a hPa is below
_NUMBER = re.compile(r"(\d{1,9})$")
Numbers = Callable[[Any], list[float]]


def readings_of_topic(name: str, sensor: Configured, file: SensorFile, problems: Problems) -> Iterator[Reading]:
    """Yield the readings of a sensor whose file is a bag, as they were stored.

    Raises DataError when there is no such topic, when its messages say nothing to that kind of sensor, or when most of
    them cannot be used.
    """
    need_rosbags()
    takes = _takes(sensor)
    with closing(Bag(file.path)) as bag:
        entry = wanted_topic(Listing(bag, False, problems), "topic", file.topic, tuple(takes))
        if entry.topic.type == FIX:
            yield from _fixes(bag, entry, FixReadings(name, file.gnss), problems)
        elif entry.topic.type == JOINTS:
            yield from _wheels(bag, entry, name, file, problems)
        else:
            yield from _numbers(bag, entry, name, takes[entry.topic.type], problems)


def first_fix(made: FixReadings, file: SensorFile) -> None:
    """Give `made` the first fix of a bag that is good enough, so that it knows its frame. Raises DataError."""
    need_rosbags()
    with closing(Bag(file.path)) as bag:
        entry = wanted_topic(Listing(bag, False, Problems()), "topic", file.topic, tuple(_BY_COLUMNS[_PLACE]))
        if entry.topic.type == FIX:
            next(_fixes(bag, entry, made, Problems()), None)


def _takes(sensor: Configured) -> dict[str, Numbers]:
    """Return the types of messages that a sensor takes, and how."""
    takes = _BY_COLUMNS.get(sensor.columns)
    if takes is None:
        raise DataError(f"no message of a bag gives {', '.join(sensor.columns)}; give a table with these")
    return takes


def _numbers(bag: Bag, entry: Entry, name: str, numbers: Numbers, problems: Problems) -> Iterator[Reading]:
    for found, message in messages_of(bag, entry.topic, problems):
        try:
            values = np.array(numbers(message))
        except ValueError as error:
            problems.count(f"{entry.topic.name}: {error}", f"logged at {found.log_ns} ns")
            continue
        if np.all(np.isfinite(values)):
            yield Reading(name, _time_ns(found, entry, problems), values)
        else:
            problems.count(f"{entry.topic.name}: messages with NaN or infinity", f"logged at {found.log_ns} ns")


def _time_ns(found: Any, entry: Entry, problems: Problems) -> int:
    t_ns = stamp(found, False)
    if t_ns is None:
        problems.count(f"{entry.topic.name}: without a stamp, the recorder's time is taken")
    return fitting(found.log_ns) if t_ns is None else t_ns


def _fixes(bag: Bag, entry: Entry, made: FixReadings, problems: Problems) -> Iterator[Reading]:
    for found, message in messages_of(bag, entry.topic, problems):
        kind = _FIXES.get(int(message.status.status), "none")
        sigma = up = math.nan
        if message.position_covariance_type != 0:
            variances = [float(message.position_covariance[k]) for k in (0, 4, 8)]
            sigma, up = math.sqrt(max(0.0, *variances[:2])), math.sqrt(max(0.0, variances[2]))
        place = Geodetic(float(message.latitude), float(message.longitude), float(message.altitude))
        try:
            reading = made.reading(Fix(_time_ns(found, entry, problems), place, kind, sigma, up))
        except ValueError as error:
            problems.count(f"{entry.topic.name}: fixes refused", str(error))
            continue
        if reading is not None:
            yield reading


def _wheels(bag: Bag, entry: Entry, name: str, file: SensorFile, problems: Problems) -> Iterator[Reading]:
    """Yield speeds of two wheels by their rates, or where these are not given by what they turned between messages."""
    joints = file.joints
    if joints is None:
        example = 'joints = {left = "left_wheel_joint", right = "right_wheel_joint", radius_m = 0.08}'
        raise DataError(f"[sensors.{name}]: joint states need to know which joints are wheels: {example}")
    before: tuple[int, np.ndarray] | None = None
    for found, message in messages_of(bag, entry.topic, problems):
        t_ns = _time_ns(found, entry, problems)
        rates, angles = (_of_wheels(message, part, joints) for part in (message.velocity, message.position))
        if rates is None and angles is not None:
            if before is not None and t_ns > before[0]:
                rates = (angles - before[1]) / ((t_ns - before[0]) * 1e-9)
                middle_ns = (t_ns + before[0]) // 2
                yield Reading(name, middle_ns, rates * joints.radius_m)
            before = (t_ns, angles)
        elif rates is not None:
            yield Reading(name, t_ns, rates * joints.radius_m)
        else:
            problems.count(f"{entry.topic.name}: without both wheels", f"logged at {found.log_ns} ns")


def _of_wheels(message: Any, values: Any, joints: JointsSettings) -> np.ndarray | None:
    """Return the values of left and right wheel [2], None where they are absent or no numbers."""
    names = list(message.name)
    if len(values) != len(names) or joints.left not in names or joints.right not in names:
        return None
    both = np.array([values[names.index(joints.left)], values[names.index(joints.right)]], dtype=np.float64)
    return both if np.all(np.isfinite(both)) else None


def _twist(twist: Any) -> list[float]:
    return [twist.linear.x, twist.angular.z]


def _omni(twist: Any) -> list[float]:
    return [twist.linear.x, twist.linear.y, twist.angular.z]


def _height(message: Any) -> list[float]:
    pressure = float(message.fluid_pressure)
    if not _LEAST_PA < pressure < _MOST_PA:
        raise ValueError(f"pressures that are no air's in Pa (as {pressure:.4g})")
    return [_SCALE_M * (1.0 - (pressure / _SEA_LEVEL_PA) ** _EXPONENT)]


def _distance(message: Any) -> float:
    distance = float(message.range)
    if not float(message.min_range) <= distance <= float(message.max_range):
        raise ValueError("ranges beyond what their sensor can measure")
    return distance


def _anchored(message: Any) -> list[float]:
    number = _NUMBER.search(str(message.header.frame_id))
    if number is None:
        raise ValueError("ranges whose frame does not end in the number of an anchor")
    return [float(number[1]), _distance(message)]


_PLACE = ("east_m", "north_m", "up_m")


def _of_twists(values: Numbers) -> dict[str, Numbers]:
    return {
        TWIST: lambda message: values(message.twist),
        TWIST_COVARIANCE: lambda message: values(message.twist.twist),
        ODOMETRY: lambda message: values(message.twist.twist),
    }


_BY_COLUMNS: dict[tuple[str, ...], dict[str, Numbers]] = {
    _PLACE: {FIX: lambda _: [], **dict.fromkeys(POSES, lambda message: pose_numbers(message)[:3])},
    ("anchor", "range_m"): {RANGE: _anchored},
    ("height_m",): {PRESSURE: _height, RANGE: lambda message: [_distance(message)]},
    ("vx_m_s", "wz_rad_s"): _of_twists(_twist),
    ("vx_m_s", "vy_m_s", "wz_rad_s"): _of_twists(_omni),
    ("left_m_s", "right_m_s"): {JOINTS: lambda _: []},
    ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"): dict.fromkeys(POSES, pose_numbers),
    ("field_x_ut", "field_y_ut", "field_z_ut"): {MAGNETIC: field_ut},
}
