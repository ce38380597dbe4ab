"""A reading as a linear system at an estimate; errors of a sensor's own code are reported by its name here."""

from typing import NamedTuple

import numpy as np

from vislam.core.errors import VislamError
from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.sensors.body import ERRORS, NUDGE, PARTS, BodyState
from vislam.sensors.sensor import USER_ERRORS, Sensor

_WRONG = 0.2  # of the larger one: a sign, a factor, a frame; less may be meant
_ROUNDING = 1e-4  # of slopes by differences


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
        H, H_own = derived(sensor, reading.values, body, own, residual) if given is None else given
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
    except USER_ERRORS as error:
        raise SensorError(f"sensor {reading.sensor!r} at {reading.t_ns} ns: {type(error).__name__}: {error}") from error
    return linear


def wrong_jacobians(sensor: Sensor, reading: Reading, body: BodyState, own: Array) -> str:
    """Return which of a sensor's own Jacobians differ from the slopes of its residual; empty: none, or it has none.

    Raises SensorError as `linearised` does.
    """
    linear = linearised(sensor, reading, body, own)
    if sensor.jacobians(reading.values, body, own) is None:
        return ""
    H, H_own = derived(sensor, reading.values, body, own, linear.residual)
    parts = [(part, linear.H[:, PARTS[part]], H[:, PARTS[part]]) for part in PARTS]
    wrong = [
        part
        for part, given, slopes in [*parts, ("own variables", linear.H_own, H_own)]
        if given.size and np.abs(given - slopes).max() > _WRONG * np.abs([given, slopes]).max() + _ROUNDING
    ]
    return f"its Jacobians are not those of its residual: {', '.join(wrong)}" if wrong else ""


def derived(
    sensor: Sensor, values: Array, body: BodyState, own: Array, residual: Array | None = None
) -> tuple[Array, Array]:
    """Return H [m, 15] and H_own [m, V] by differences of the residual, which is as given where it is known [m].

    Forward ones, for they cost half as much as central ones: a residual whose second derivative is 1 gets a first one
    that is off by half the step, 5e-7. That moves no estimate by anything near its sigma.
    """
    here = sensor.residual(values, body, own) if residual is None else residual
    columns: list[int] = []
    there: list[Array] = []
    for part in sensor.touches:
        columns += range(PARTS[part].start, PARTS[part].stop)
        there += [sensor.residual(values, moved, own) for moved in body.nudged(part)]
    there += [sensor.residual(values, body, moved) for moved in own + NUDGE * np.eye(len(own))]
    H, H_own = np.zeros((len(here), ERRORS)), np.zeros((len(here), len(own)))
    if there:
        minus_slopes = ((here - np.array(there)) / NUDGE).T
        H[:, columns], H_own[:] = minus_slopes[:, : len(columns)], minus_slopes[:, len(columns) :]
    return H, H_own
