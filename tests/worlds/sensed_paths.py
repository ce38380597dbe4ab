"""Sensors beside IMU and camera, what they say on a simulated run, and filters that take it, for tests."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from vislam.config import EkfConfig
from vislam.core.messages import Array, ImuSample, NavState
from vislam.core.readings import OwnStart, Reading
from vislam.ekf import Ekf, MsckfEkf
from vislam.sensors import BodyState, Sensor, Suite, Variable
from worlds import monte_carlo as mc
from worlds.flight import MONO
from worlds.parts import MACHINE

KINDS = ("loose", "tight")


class Fix(Sensor):
    """Where an antenna beside the body is."""

    columns = ("x_m", "y_m", "z_m")
    touches = ("rotation", "position")
    lever_m = np.array([0.2, -0.1, 0.3])
    sigma_m = 0.05

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        return values - (body.position_m + body.R_world_body @ self.lever_m)

    def noise(self, values: Array) -> Array:
        return self.sigma_m**2 * np.eye(3)


class Height(Sensor):
    """Height above a zero that nobody knows and that wanders."""

    columns = ("z_m",)
    touches = ("position",)
    variables = (Variable("zero_m", 1.0, walk=0.03),)
    sigma_m = 0.05

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        return values - (body.position_m[2:] + own)

    def noise(self, values: Array) -> Array:
        return np.array([[self.sigma_m**2]])


class Beacon(Sensor):
    """Range from the body to a place that is not known well."""

    columns = ("range_m",)
    touches = ("position",)
    variables = (Variable("x_m", 0.1, 4.0), Variable("y_m", 0.1, -3.0), Variable("z_m", 0.1, 1.0))
    sigma_m = 0.03

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        return values - np.linalg.norm(body.position_m - own)

    def noise(self, values: Array) -> Array:
        return np.array([[self.sigma_m**2]])


class Speed(Sensor):
    """Velocity in body axes, all of it too large by a factor."""

    columns = ("x_m_s", "y_m_s", "z_m_s")
    touches = ("rotation", "velocity")
    variables = (Variable("scale", 0.1, 1.0),)
    sigma_m_s = 0.03

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        return values - own[0] * (body.R_world_body.T @ body.velocity_m_s)

    def noise(self, values: Array) -> Array:
        return self.sigma_m_s**2 * np.eye(3)


def every_sensor() -> dict[str, Sensor]:
    return {"fix": Fix(), "height": Height(), "beacon": Beacon(), "speed": Speed()}


def made(kind: str, suite: Suite | None, **settings: object) -> Ekf | MsckfEkf:
    """Return a filter that has not begun."""
    if kind == "loose":
        return Ekf(mc.honest(**settings), mc.IMU, MACHINE, suite=suite)
    return MsckfEkf(EkfConfig(coupling="tight", **settings), mc.IMU, MACHINE, MONO, suite)  # type: ignore[arg-type]


@dataclass
class SensedRun:
    """A run with what its sensors say, in order of time, and the true own variables as they end."""

    way: mc.Drive
    start: NavState
    starts: list[OwnStart]
    readings: list[Reading]
    own: dict[str, Array] = field(default_factory=dict)

    @staticmethod
    def make(seed: int, duration_s: float, sensors: Mapping[str, Sensor], every: Mapping[str, int]) -> SensedRun:
        """Draw a run; `every` so many samples there is a reading of a sensor. Own variables are drawn, too."""
        way, rng = mc.drive("hand", seed, duration_s), np.random.default_rng([seed, 2])
        start, starts, readings, own = mc.start(way, mc.START_SIGMAS, rng), [], [], {}
        for name, sensor in sensors.items():
            sigmas = np.array([variable.sigma for variable in sensor.variables])
            values = np.array([variable.start for variable in sensor.variables])
            if len(values):
                starts.append(OwnStart(name, values, sigmas))
            true = values + sigmas * rng.normal(size=len(values))
            step = every.get(name, len(way.t_ns))  # more than there are: none
            for k in range(step, len(way.t_ns), step):
                true = later(sensor, true, step / mc.IMU.rate_hz, rng)
                exact = said(sensor, body_of_truth(way, k), true)
                root = np.linalg.cholesky(sensor.noise(exact))
                noisy = exact + root @ rng.normal(size=len(exact))
                readings.append(Reading(name, int(way.t_ns[k]), noisy))
            own[name] = true
        readings.sort(key=lambda reading: reading.t_ns)
        return SensedRun(way, start, starts, readings, own)

    def replay(self, ekf: Ekf | MsckfEkf) -> Iterator[tuple[int, Ekf | MsckfEkf]]:
        """Begin a filter and tell it everything in time; yield after each sample k."""
        ekf.initialise(self.start)
        for begun in self.starts:
            assert ekf.begin_sensor(self.start.t_ns, begun).accepted
        i = 0
        for k, t_ns in enumerate(self.way.t_ns.tolist()):
            ekf.predict(self.sample(k))
            while i < len(self.readings) and self.readings[i].t_ns <= t_ns:
                ekf.update_sensor(self.readings[i])
                i += 1
            yield k, ekf

    def sample(self, k: int) -> ImuSample:
        return ImuSample(int(self.way.t_ns[k]), self.way.samples[k, :3], self.way.samples[k, 3:])


def body_of_truth(way: mc.Drive, k: int) -> BodyState:
    bias = way.biases[k]
    T, rate = way.pose(k), way.samples[k, :3] - bias[:3]
    return BodyState(int(way.t_ns[k]), T[:3, :3], T[:3, 3], way.truth[k, 3:6], bias[:3], bias[3:], rate)


def later(sensor: Sensor, own: Array, dt_s: float, rng: np.random.Generator) -> Array:
    """Return own variables [V] after a time."""
    steps = [variable.after(dt_s) for variable in sensor.variables]
    decays, variances = np.array(steps, dtype=np.float64).reshape(-1, 2).T
    starts = np.array([variable.start for variable in sensor.variables])
    return starts + decays * (own - starts) + np.sqrt(variances) * rng.normal(size=len(own))


def said(sensor: Sensor, body: BodyState, own: Array) -> Array:
    """Return what a sensor would say without noise: the values whose residual is zero; it is linear in them."""
    nothing = np.zeros(len(sensor.columns))
    return -sensor.residual(nothing, body, own)
