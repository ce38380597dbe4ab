"""Readings of other sensors as they reach the graph: checked once, so that no factor meets a number that is none."""

from __future__ import annotations

import numpy as np

from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.core.readings import OwnStart, PlacedReading, Station

_RIGID = 1e-4  # how far R^T R may be from identity
_ROTATIONS = ("dR", "dR_all")
_VECTORS = ("dv_m_s", "dp_m", "dp_all_m", "rate_rad_s", "gyro_bias_rad_s", "accel_bias_m_s2")
_NUMBERS = ("since_s", "length_s", "gravity_m_s2", "accel_sigma_m_s2")


def checked_readings(placed: tuple[PlacedReading, ...], what: str) -> tuple[PlacedReading, ...]:
    """Return readings between two keyframes; DataError, with `what` they belong to, on any that cannot be used."""
    for one in placed:
        reading = one.reading
        name = f"{what}: reading of sensor {reading.sensor!r} at {reading.t_ns} ns"
        if np.ndim(reading.values) != 1 or not _are_finite(reading.values):
            raise DataError(f"{name}: its values must be a row of finite numbers")
        covariance = reading.covariance
        if covariance is not None and not (_is_square(covariance) and _are_finite(covariance)):
            raise DataError(f"{name}: its covariance must be square and finite")
        _check_station(one.station, name)
    return tuple(placed)


def checked_starts(starts: tuple[OwnStart, ...], what: str) -> tuple[OwnStart, ...]:
    """Return first values of sensors' own variables; DataError, with `what` they belong to, where they are none."""
    for start in starts:
        values, sigmas = np.asarray(start.values), np.asarray(start.sigmas)
        sound = values.ndim == 1 and values.shape == sigmas.shape and _are_finite(values) and _are_finite(sigmas)
        if not sound or np.any(sigmas < 0.0):
            raise DataError(
                f"{what}: the start of sensor {start.sensor!r} must be finite values with as many sigmas, "
                f"got shapes {values.shape} and {sigmas.shape}"
            )
    return tuple(starts)


def _check_station(station: Station, name: str) -> None:
    for key in _ROTATIONS:
        R = getattr(station, key)
        if np.shape(R) != (3, 3) or not _are_finite(R) or np.abs(R.T @ R - np.eye(3)).max() > _RIGID:
            raise DataError(f"{name}: its station's {key} is no rotation")
    for key in _VECTORS:
        if np.shape(getattr(station, key)) != (3,) or not _are_finite(getattr(station, key)):
            raise DataError(f"{name}: its station's {key} must be three finite numbers")
    for key in _NUMBERS:
        if not np.isfinite(getattr(station, key)):
            raise DataError(f"{name}: its station's {key} is not finite")
    if not (station.length_s > 0.0 and 0.0 <= station.since_s <= station.length_s):
        raise DataError(
            f"{name}: it must lie between its keyframes, {station.since_s:.6g} s of {station.length_s:.6g} s"
        )


def _are_finite(values: Array) -> bool:
    return bool(np.all(np.isfinite(values)))


def _is_square(matrix: Array) -> bool:
    return np.ndim(matrix) == 2 and np.shape(matrix)[0] == np.shape(matrix)[1]
