"""Readings drawn from a known path with a sensor's own noise, and what goes wrong with real ones."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.geometry import so3_exp
from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.core.trajectory import Trajectory
from vislam.sensors.body import BodyState
from vislam.sensors.sensor import Configured

Spans = tuple[tuple[float, float], ...]  # from and to, in seconds after the first body
_KNOT_NS = 50_000_000  # finer, the noise of a measured truth would be taken for motion
_MIN_KNOTS = 8


@dataclass(frozen=True, slots=True)
class Faults:
    """What goes wrong, with a probability per reading or for a time."""

    outages: Spans = ()  # nothing is said
    stuck: Spans = ()  # the last values again and again
    slips: Spans = ()  # wheels turn faster than they roll
    slip_share: float = 0.5  # by so much
    slip_columns: tuple[str, ...] = ()  # of one wheel; empty: of all columns of the sensor that can slip
    outliers: float = 0.0  # probability of a reading of a body that is elsewhere and moves otherwise
    outlier_m: float = 10.0  # sigma per axis of how far off; 0.1 of it in m/s, and 0.1 of it in rad about each axis
    backward: float = 0.0  # probability of a stamp before that of the last reading
    backward_s: float = 0.5  # by so much at most


NO_FAULTS = Faults()


def drawn_readings(
    name: str, sensor: Configured, bodies: Sequence[BodyState], own: Array, seed: int, faults: Faults = NO_FAULTS
) -> list[Reading]:
    """Return the readings of a sensor along a true path.

    Args:
        name: of the sensor.
        sensor: that draws.
        bodies: the truth at each reading, in time order.
        own: true own variables: [V] at first, of which those that forget wander on, or [N, V] one row for each body.
        seed: of noise and faults; the same one gives the same readings.
        faults: what goes wrong. Values that `check` refuses are drawn like others.
    """
    return list(_drawn(name, sensor, bodies, own, np.random.default_rng(seed), faults))


def _drawn(
    name: str, sensor: Configured, bodies: Sequence[BodyState], own: Array, rng: np.random.Generator, faults: Faults
) -> Iterator[Reading]:
    owns = np.array(np.broadcast_to(own, (len(bodies), len(sensor.variables))))
    if own.ndim == 1 and (forgets := [n for n, one in enumerate(sensor.variables) if one.correlation_s > 0.0]):
        for k in range(1, len(bodies)):
            for n in forgets:
                one, dt_s = sensor.variables[n], (bodies[k].t_ns - bodies[k - 1].t_ns) * 1e-9
                decay, variance = one.after(dt_s)
                owns[k, n] = one.start + decay * (owns[k - 1, n] - one.start) + variance**0.5 * rng.normal()
    last: Array | None = None
    for body, true_own in zip(bodies, owns, strict=True):
        since_s = (body.t_ns - bodies[0].t_ns) * 1e-9
        seen = _elsewhere(body, faults.outlier_m, rng) if rng.random() < faults.outliers else body
        values = sensor.draw(seen, np.array(true_own), rng)
        if within(since_s, faults.slips):
            values = slipping(sensor, values, faults)
        t_ns = body.t_ns
        if rng.random() < faults.backward:
            t_ns -= int(rng.uniform(0.0, faults.backward_s) * 1e9)
        if within(since_s, faults.outages):
            continue
        if last is not None and within(since_s, faults.stuck):
            values = last
        last = values
        yield Reading(name, t_ns, values)


def slipping(sensor: Configured, values: Array, faults: Faults) -> Array:
    """Return the values [C] that wheels give which turn faster than they roll."""
    slips = np.array([column in (faults.slip_columns or sensor.slips) for column in sensor.columns])
    return np.where(slips, (1.0 + faults.slip_share) * values, values)


def within(since_s: float, spans: Spans) -> bool:
    """Return whether a time is in one of the spans."""
    return any(begin <= since_s < end for begin, end in spans)


def _elsewhere(body: BodyState, sigma_m: float, rng: np.random.Generator) -> BodyState:
    """Return a body that has nothing to do with this one, as a wild reading shows."""
    return replace(
        body,
        R_world_body=body.R_world_body @ so3_exp(0.1 * sigma_m * rng.normal(size=3)),
        position_m=body.position_m + sigma_m * rng.normal(size=3),
        velocity_m_s=body.velocity_m_s + 0.1 * sigma_m * rng.normal(size=3),
        rate_rad_s=body.rate_rad_s + 0.1 * sigma_m * rng.normal(size=3),
    )


def bodies_on(truth: Trajectory, t_ns: NDArray[np.int64]) -> list[BodyState]:
    """Return the body at times [N] within a true path, smooth between poses 50 ms apart; biases are zero.

    Raises DataError where the path is too short.
    """
    from scipy.interpolate import CubicSpline  # what reads a sensor's file does without
    from scipy.spatial.transform import Rotation, RotationSpline

    kept = [0]
    for k, stamp in enumerate(truth.t_ns.tolist()):
        if stamp - int(truth.t_ns[kept[-1]]) >= _KNOT_NS:
            kept.append(k)
    if len(truth) == 0 or len(kept) < _MIN_KNOTS:
        raise DataError(f"sensors can be drawn on a path of {_MIN_KNOTS} poses 50 ms apart, got {len(truth)} poses")
    zero_ns = int(truth.t_ns[0])
    knots_s = (truth.t_ns[kept] - zero_ns) * 1e-9
    place = CubicSpline(knots_s, truth.positions_m[kept])
    attitude = RotationSpline(knots_s, Rotation.from_matrix(truth.T_world_body[kept, :3, :3]))
    at_s = (t_ns - zero_ns) * 1e-9
    R, rate = attitude(at_s).as_matrix(), attitude(at_s, 1)  # in body axes
    positions, velocities, none = place(at_s), place(at_s, 1), np.zeros(3)
    return [
        BodyState(int(t), R[k], positions[k], velocities[k], none, none, rate[k]) for k, t in enumerate(t_ns.tolist())
    ]
