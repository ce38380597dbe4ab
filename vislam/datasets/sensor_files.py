"""Files of sensors other than IMU and camera: tables, and what satellite receivers write."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.core.reading import opened
from vislam.core.readings import Reading
from vislam.core.recording import Problems
from vislam.datasets.tables import Row, header, in_time_order, parse_ns, parse_seconds, read_rows
from vislam.datasets.telemetry import open_joined
from vislam.sensors.geodetic import Geodetic, LocalFrame
from vislam.sensors.gnss import Fix, FixReadings, NmeaFixes, UbxFixes
from vislam.sensors.sensor import Configured
from vislam.sensors.ticks import TickSpeeds
from vislam.sensors.toml import SensorFile

_STAMPS: dict[str, Callable[[str], int]] = {"t_ns": parse_ns, "t_s": parse_seconds}
_CHUNK_BYTES = 2**16
_PLACE, _ACCURACIES = ("latitude", "longitude", "altitude"), ("horizontalAccuracy", "verticalAccuracy")
_RADIUS_68 = math.sqrt(-2.0 * math.log(1.0 - 0.68))  # that holds 68 % of two axes, in sigmas of one
_TICKS = ("left_ticks", "right_ticks")


def sensor_readings(name: str, sensor: Configured, file: SensorFile, problems: Problems) -> Iterator[Reading]:
    """Yield a sensor's readings in time order, by the IMU's clock, in bounded memory.

    What cannot be used is left out and counted. Several readings may have the same stamp, as ranges to several anchors.

    Raises:
        DataError: the file cannot be read, lacks a column, or most of its rows are unusable.
    """
    if file.format == "bag":
        from vislam.datasets.bags import readings_of_topic

        readings = readings_of_topic(name, sensor, file, problems)
    elif (fixes := _fixes_of(file)) is not None:
        readings = fixes(FixReadings(name, file.gnss), file, problems)
    else:
        readings = _counts(name, file, problems) if file.ticks else _table(name, sensor, file, problems)
    rows = ((reading.t_ns, reading) for reading in readings)
    shift_ns = round(file.offset_s * 1e9)
    for t_ns, reading in in_time_order(rows, problems, f"{file.path.parent.name}/{file.path.name}", keep_equal=True):
        yield replace(reading, t_ns=t_ns + shift_ns)


def local_frame(file: SensorFile) -> LocalFrame:
    """Return the frame of a receiver's file, to turn east, north, up back into latitude, longitude, height.

    Its datum is the one that was given, or the first fix that is good enough. Raises DataError where there is none.
    """
    made = FixReadings("", file.gnss)
    if made.frame is None and file.format == "bag":
        from vislam.datasets.bags import first_fix

        first_fix(made, file)
    if made.frame is None and file.format != "bag" and (fixes := _fixes_of(file)) is not None:
        next(fixes(made, file, Problems()), None)
    if made.frame is None:
        raise DataError(f"{file.path}: no datum is given and no fix is good enough to be one")
    return made.frame


def _table(name: str, sensor: Configured, file: SensorFile, problems: Problems) -> Iterator[Reading]:
    sigmas = tuple(dict.fromkeys(sensor.sigma_columns))
    there = _header(file.path)
    has_sigmas = bool(sigmas) and set(sigmas) <= set(there)
    asked = sensor.columns + (sigmas if has_sigmas else ())
    for t_ns, numbers in read_rows(file.path, _row(asked, there, file.path), problems, ",", needs_line_end=True):
        values = np.array(numbers[: len(sensor.columns)])
        if not has_sigmas:
            yield Reading(name, t_ns, values)
        elif min(given := numbers[len(sensor.columns) :]) > 0.0:
            by_name = dict(zip(sigmas, given, strict=True))
            yield Reading(name, t_ns, values, _diagonal([by_name[column] for column in sensor.sigma_columns]))
        else:
            problems.count(f"{file.path.parent.name}/{file.path.name}: rows with a sigma that is not positive")


def _counts(name: str, file: SensorFile, problems: Problems) -> Iterator[Reading]:
    assert file.ticks is not None
    speeds = TickSpeeds(file.ticks)
    place = f"{file.path.parent.name}/{file.path.name}"
    parse = _row(_TICKS, _header(file.path), file.path)
    for t_ns, numbers in read_rows(file.path, parse, problems, ",", needs_line_end=True):
        if not all(number.is_integer() for number in numbers):
            problems.count(f"{place}: counts that are not whole")
            continue
        try:
            found = speeds.speeds(t_ns, *map(int, numbers))
        except ValueError as error:
            problems.count(f"{place}: counts that give no speed", str(error))
            continue
        if found is not None:
            yield Reading(name, found[0], np.array(found[1]))


def _row(asked: tuple[str, ...], header: tuple[str, ...], path: Path) -> Callable[[list[str]], Row[list[float]]]:
    """Return what makes stamp and asked numbers of a row's fields; without a header they stand in their order."""
    at, stamp_at, parse_stamp = list(range(1, 1 + len(asked))), 0, _STAMPS["t_ns"]
    if header:
        if missing := [column for column in asked if column not in header]:
            raise DataError(f"{path}: no column {missing[0]}; there are {', '.join(header)}; docs/more-sensors.md")
        stamp = next(column for column in header if column in _STAMPS)
        at, stamp_at, parse_stamp = [header.index(column) for column in asked], header.index(stamp), _STAMPS[stamp]

    def parse(fields: list[str]) -> Row[list[float]]:
        if len(fields) <= max(stamp_at, *at):
            raise ValueError
        numbers = [float(fields[k]) for k in at]
        if not all(map(math.isfinite, numbers)):
            raise ArithmeticError
        return parse_stamp(fields[stamp_at]), numbers

    return parse


def _header(path: Path, of: Collection[str] = tuple(_STAMPS)) -> tuple[str, ...]:
    """Return the names of a table's columns, in a comment or not, with one `of` them; empty: it does not say."""
    return header(path, ",", lambda names: bool(set(names) & set(of)))


def _nmea(made: FixReadings, file: SensorFile, problems: Problems) -> Iterator[Reading]:
    fixes = NmeaFixes()

    def parse(fields: list[str]) -> Row[Fix | None]:
        return 0, fixes.feed(fields[0])

    for _t_ns, fix in read_rows(file.path, parse, problems, "\n", needs_line_end=True):
        yield from _made(fix, made, file, problems)
    yield from _made(fixes.end(), made, file, problems)
    problems.count(f"{file.path.parent.name}/{file.path.name}: fixes before any date", times=fixes.undated)


def _ubx(made: FixReadings, file: SensorFile, problems: Problems) -> Iterator[Reading]:
    fixes, count = UbxFixes(), 0
    with opened(file.path) as stream:
        while data := stream.read(_CHUNK_BYTES):
            for fix in fixes.feed(data):
                count += 1
                yield from _made(fix, made, file, problems)
    if not count and not fixes.undated:
        raise DataError(f"{file.path}: no message NAV-PVT with a fix; set the receiver to send UBX-NAV-PVT")
    place = f"{file.path.parent.name}/{file.path.name}"
    problems.count(f"{place}: damaged messages", times=fixes.damaged)
    problems.count(f"{place}: fixes before any date", times=fixes.undated)


def _gpmf(made: FixReadings, file: SensorFile, problems: Problems) -> Iterator[Reading]:
    telemetry = open_joined(file.path)
    if telemetry is None or not telemetry.fix_count:
        raise DataError(f"{file.path}: no GNSS in it; switch the camera's GPS on, or name a .nmea, .ubx or .csv file")
    for fix in telemetry.fixes(problems):
        yield from _made(fix, made, file, problems)


def _location(made: FixReadings, file: SensorFile, problems: Problems) -> Iterator[Reading]:
    """Yield the fixes of a phone's Location.csv (Sensor Logger); accuracies are radii of 68 %, negative: no fix."""
    there = _header(file.path, _PLACE)
    if missing := [name for name in ("time", *_PLACE, *_ACCURACIES) if name not in there]:
        raise DataError(f"{file.path}: no column {missing[0]}; there are {', '.join(there)}; docs/sensors/gnss.md")
    at = [there.index(name) for name in (*_PLACE, *_ACCURACIES)]

    def parse(fields: list[str]) -> Row[Fix]:
        if len(fields) <= max(at):
            raise ValueError
        latitude, longitude, height, radius, up = (float(fields[k]) for k in at)
        t_ns, place = parse_ns(fields[there.index("time")]), Geodetic(latitude, longitude, height)
        return t_ns, Fix(t_ns, place, "single" if radius > 0.0 and up > 0.0 else "none", radius / _RADIUS_68, up)

    for _t_ns, fix in read_rows(file.path, parse, problems, ",", needs_line_end=True):
        yield from _made(fix, made, file, problems)


_FIXES = {"nmea": _nmea, "ubx": _ubx, "gpmf": _gpmf}


def _fixes_of(file: SensorFile) -> Callable[[FixReadings, SensorFile, Problems], Iterator[Reading]] | None:
    """Return what reads the fixes in a file that is no bag, None for a table of readings."""
    if file.format == "csv" and {"latitude", "longitude"} <= set(_header(file.path, _PLACE)):
        return _location
    return _FIXES.get(file.format)


def _made(fix: Fix | None, made: FixReadings, file: SensorFile, problems: Problems) -> Iterator[Reading]:
    try:
        reading = None if fix is None else made.reading(fix)
    except ValueError as error:
        problems.count(f"{file.path.parent.name}/{file.path.name}: fixes refused", str(error))
        return
    if reading is not None:
        yield reading


def _diagonal(sigmas: list[float]) -> Array:
    return np.diag(np.square(sigmas))
