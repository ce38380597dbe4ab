"""The sensors of one machine, and where their own variables stand in the state of an estimator."""

from collections.abc import Mapping

import numpy as np

from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.sensors.sensor import Sensor


class Suite:
    """Sensors by name, in the order in which they were given."""

    def __init__(self, sensors: Mapping[str, Sensor] | None = None) -> None:
        """Take the sensors; without any nothing changes anywhere."""
        self._sensors = dict(sensors or {})
        self._slices: dict[str, slice] = {}
        at = 0
        for name, sensor in self._sensors.items():
            self._slices[name] = slice(at, at + len(sensor.variables))
            at += len(sensor.variables)
        self.size = at  # of all own variables together
        variables = [variable for sensor in self._sensors.values() for variable in sensor.variables]
        self.starts: Array = np.array([variable.start for variable in variables], dtype=np.float64)  # [K]
        self.sigmas: Array = np.array([variable.sigma for variable in variables], dtype=np.float64)  # [K]

    def __len__(self) -> int:
        return len(self._sensors)

    @property
    def names(self) -> tuple[str, ...]:
        """Of all sensors."""
        return tuple(self._sensors)

    def __getitem__(self, name: str) -> Sensor:
        return self._sensors[name]

    def own(self, name: str) -> slice:
        """Return where a sensor's own variables stand among all of them."""
        return self._slices[name]

    def after(self, name: str, dt_s: float) -> tuple[Array, Array]:
        """Return decays [V] and variances [V] of a sensor's own variables, as `Variable.after` has them."""
        decays, variances = np.array([variable.after(dt_s) for variable in self._sensors[name].variables]).T
        return decays, variances

    def drawn_own(self, name: str, rng: np.random.Generator) -> Array:
        """Return true own variables [V] of a simulated sensor, as its starts and sigmas have them."""
        at = self._slices[name]
        return self.starts[at] + self.sigmas[at] * rng.normal(size=at.stop - at.start)

    def why_unusable(self, reading: Reading) -> str:
        """Return why a reading cannot be used by anybody; empty: it can."""
        sensor = self._sensors.get(reading.sensor)
        if sensor is None:
            return f"no sensor is called {reading.sensor!r}; there is {', '.join(self.names) or 'none'}"
        if np.shape(reading.values) != (len(sensor.columns),):
            return f"{np.shape(reading.values)} values, {len(sensor.columns)} asked: {', '.join(sensor.columns)}"
        if not np.isfinite(reading.values).all():
            return "values that are not finite"
        covariance = reading.covariance
        if covariance is not None and not (np.isfinite(covariance).all() and (np.diag(covariance) > 0.0).all()):
            return "a covariance that is not finite and positive"
        return sensor.check(reading.values)
