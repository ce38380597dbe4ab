"""Readings of other sensors, and where their own variables began, as rows of a session."""

import math
import sqlite3
from collections.abc import Iterable
from typing import Any

import numpy as np

from vislam.core.messages import Array, KeyframePacket
from vislam.core.readings import OwnStart, PlacedReading, Reading, Station
from vislam.runs.session.schema import maybe_bytes, numbers, to_bytes

_PARTS: tuple[tuple[str, tuple[int, ...]], ...] = (  # of a station, in the order of its numbers
    ("since_s", ()), ("length_s", ()), ("dR", (3, 3)), ("dv_m_s", (3,)), ("dp_m", (3,)), ("dR_all", (3, 3)),
    ("dp_all_m", (3,)), ("gravity_m_s2", ()), ("rate_rad_s", (3,)), ("gyro_bias_rad_s", (3,)),
    ("accel_bias_m_s2", (3,)), ("accel_sigma_m_s2", ()),
)  # fmt: skip
_STATION_NUMBERS = sum(math.prod(shape) for _, shape in _PARTS)
_MOST_NUMBERS = 1024  # of one reading; more is damage
_LONGEST_NAME = 256


def reading_rows(packet: KeyframePacket) -> list[tuple[Any, ...]]:
    """Return the rows of a packet's readings."""
    return [
        (
            packet.keyframe.id, number, placed.reading.sensor, int(placed.reading.t_ns),
            to_bytes(placed.reading.values, "<f8"), maybe_bytes(placed.reading.covariance, "<f8"),
            _station_bytes(placed.station),
        )
        for number, placed in enumerate(packet.readings)
    ]  # fmt: skip


def start_rows(packet: KeyframePacket) -> list[tuple[Any, ...]]:
    """Return the rows of the own starts that came with a packet."""
    return [
        (packet.keyframe.id, number, start.sensor, to_bytes(start.values, "<f8"), to_bytes(start.sigmas, "<f8"))
        for number, start in enumerate(packet.own_starts)
    ]


def readings_of(db: sqlite3.Connection) -> dict[int, tuple[PlacedReading, ...]]:
    """Return all readings by keyframe, in the order in which they came; ValueError or TypeError on damage."""
    out: dict[int, list[PlacedReading]] = {}
    query = "SELECT id, sensor, t_ns, numbers, covariance, station FROM readings ORDER BY id, number"
    for k, sensor, t_ns, values, covariance, station in db.execute(query):
        if not isinstance(t_ns, int):
            raise TypeError(f"a reading with keyframe {k} has no time")
        measured = _some(values)
        spread = None
        if covariance is not None:
            m = math.isqrt(len(covariance) // 8)
            if m > _MOST_NUMBERS:
                raise ValueError(f"a covariance of {m} numbers")
            spread = numbers(covariance, "<f8", (m, m))
        reading = Reading(_name(sensor), t_ns, measured, spread)
        out.setdefault(k, []).append(PlacedReading(reading, _station_of(station)))
    return {k: tuple(placed) for k, placed in out.items()}


def starts_of(db: sqlite3.Connection) -> dict[int, tuple[OwnStart, ...]]:
    """Return all own starts by keyframe; ValueError or TypeError on damage."""
    out: dict[int, list[OwnStart]] = {}
    for k, sensor, values, sigmas in db.execute(
        "SELECT id, sensor, numbers, sigmas FROM own_starts ORDER BY id, number"
    ):
        out.setdefault(k, []).append(OwnStart(_name(sensor), _some(values), _some(sigmas)))
    return {k: tuple(starts) for k, starts in out.items()}


def own_data(own: Iterable[OwnStart]) -> list[dict[str, Any]]:
    """Return own variables as plain data."""
    return [{"sensor": one.sensor, "values": one.values.tolist(), "sigmas": one.sigmas.tolist()} for one in own]


def own_of(data: list[dict[str, Any]]) -> tuple[OwnStart, ...]:
    """Return what `own_data` stored; KeyError, ValueError or TypeError when it is damaged."""
    out = []
    for one in data:
        values, sigmas = (np.array(one[part], dtype=np.float64).reshape(-1) for part in ("values", "sigmas"))
        if values.shape != sigmas.shape or not np.isfinite([values, sigmas]).all():
            raise ValueError("own variables that are not finite")
        out.append(OwnStart(_name(one["sensor"]), values, sigmas))
    return tuple(out)


def _station_bytes(station: Station) -> bytes:
    return to_bytes(np.concatenate([np.ravel(getattr(station, name)) for name, _ in _PARTS]), "<f8")


def _station_of(blob: bytes) -> Station:
    stored = numbers(blob, "<f8", (_STATION_NUMBERS,))
    parts: dict[str, Any] = {}
    at = 0
    for name, shape in _PARTS:
        size = math.prod(shape)
        parts[name] = stored[at : at + size].reshape(shape) if shape else float(stored[at])
        at += size
    return Station(**parts)


def _some(blob: bytes) -> Array:
    if len(blob) > 8 * _MOST_NUMBERS:
        raise ValueError(f"{len(blob)} bytes of numbers with a sensor")
    return numbers(blob, "<f8", (-1,))


def _name(sensor: Any) -> str:
    if not isinstance(sensor, str) or not 0 < len(sensor) <= _LONGEST_NAME:
        raise ValueError("a reading without the name of a sensor")
    return sensor
