"""A reading as a linear system at an estimate; whatever is wrong with a sensor's own code is told by its name here."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vislam.core.errors import VislamError
from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.sensors.body import ERRORS, PARTS, BodyState
from vislam.sensors.sensor import Sensor

_STEP = 1e-6


class SensorError(VislamError):
    """A sensor's own code failed: it raised, or gave numbers of another shape, or none at all."""


class Linear(NamedTuple):
    """A reading at an estimate: `residual ~ H @ error + H_own @ own_error + noise`."""

    residual: Array  # [m]
    H: Array  # [m, 15]
    H_own: Array  # [m, V]
    noise: Array  # [m, m]


def linearised(sensor: Sensor, reading: Reading, body: BodyState, own: Array) -> Linear:
    """Return a reading as a linear system at a body's state and own variables [V].

    Raises SensorError, with the sensor's name, on whatever its code does wrong.
    """
    try:
        residual = np.asarray(sensor.residual(reading.values, body, own), dtype=np.float64)
        if residual.ndim != 1 or not len(residual):
            raise ValueError(f"residual of shape {residual.shape}, it has to be [m]")
        m = len(residual)
        given = sensor.jacobians(reading.values, body, own)
        H, H_own = derived(sensor, reading.values, body, own) if given is None else given
        noise = sensor.noise(reading.values) if reading.covariance is None else reading.covariance
        parts = {"H": (H, (m, ERRORS)), "H_own": (H_own, (m, len(own))), "noise": (noise, (m, m))}
        for name, (value, shape) in parts.items():
            if np.shape(value) != shape:
                raise ValueError(f"{name} of shape {np.shape(value)}, it has to be {shape}")
        linear = Linear(residual, *(np.ascontiguousarray(value, dtype=np.float64) for value, _ in parts.values()))
        if not all(np.isfinite(part).all() for part in linear):
            raise ValueError("numbers that are not finite")
        if not (np.diag(linear.noise) > 0.0).all():
            raise ValueError("noise without a positive variance of every number")
    except Exception as error:  # it is somebody else's code
        raise SensorError(f"sensor {reading.sensor!r} at {reading.t_ns} ns: {type(error).__name__}: {error}") from error
    return linear


def derived(sensor: Sensor, values: Array, body: BodyState, own: Array) -> tuple[Array, Array]:
    """Return H [m, 15] and H_own [m, V] by central differences of the residual."""
    columns = [np.arange(PARTS[part].start, PARTS[part].stop) for part in sensor.touches]
    error = np.zeros(ERRORS)
    H: Array | None = None
    for k in np.concatenate(columns).tolist() if columns else []:
        error[k] = _STEP
        change = sensor.residual(values, body.moved(error), own) - sensor.residual(values, body.moved(-error), own)
        error[k] = 0.0
        H = np.zeros((len(change), ERRORS)) if H is None else H
        H[:, k] = change / (-2.0 * _STEP)
    by_own = []
    for k in range(len(own)):
        more, less = own.copy(), own.copy()
        more[k] += _STEP
        less[k] -= _STEP
        change = sensor.residual(values, body, more) - sensor.residual(values, body, less)
        by_own.append(change / (-2.0 * _STEP))
    m = len(by_own[0]) if H is None and by_own else (0 if H is None else len(H))
    return np.zeros((m, ERRORS)) if H is None else H, np.array(by_own).T if by_own else np.zeros((m, 0))
