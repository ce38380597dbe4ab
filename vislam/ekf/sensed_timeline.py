"""The doors of a filter for sensors other than IMU and camera."""

import numpy as np

from vislam.core.messages import Array, NoiseScale
from vislam.core.readings import OwnStart, Reading
from vislam.ekf.filter_core import S
from vislam.ekf.history import Event, KnownBias, M
from vislam.ekf.sensor_rows import body_of
from vislam.ekf.timeline import Timeline, UpdateResult
from vislam.sensors import BodyState


class SensedTimeline(Timeline[S, M]):
    """The timeline with readings of a `Suite` of sensors. Stamps are by the IMU's clock.

    As every measurement they may come late and in any order, those with one stamp included.
    """

    def follow_noise(self, t_ns: int, scale: NoiseScale) -> UpdateResult:
        """Assume white noise of `scale` times the model's from `t_ns` on: a ride shakes, a rest not."""
        if not (np.isfinite(scale).all() and min(scale) > 0.0):
            return self._refuse("noise_invalid", "factors on noise must be finite and positive")
        return self._insert(Event(t_ns, scale))

    def feed_back(
        self,
        gyro_bias: Array,
        accel_bias: Array,
        gyro_sigma: float | Array,
        accel_sigma: float | Array,
    ) -> UpdateResult:
        """Take biases [3] (rad/s, m/s^2) that the graph found, as soft measurements at the present time.

        Only the biases move: pose and velocity stay, now and when late measurements are replayed. The graph has used
        the same images, so give sigmas well above its own.
        """
        sigmas = np.broadcast_to(gyro_sigma, 3), np.broadcast_to(accel_sigma, 3)
        bias = np.concatenate([gyro_bias, accel_bias, *sigmas]).astype(np.float64)
        if not (np.isfinite(bias).all() and (bias[6:] > 0.0).all()):
            return self._refuse("bias_invalid", "biases must be finite and their sigmas positive")
        return self._insert(Event(self._t_ns, KnownBias(bias)))

    def begin_sensor(self, t_ns: int, start: OwnStart) -> UpdateResult:
        """Set a sensor's own variables at a time; its readings from then on are used.

        What was known of them before is forgotten, and what the rest of the state has learned from them stays. Sensors
        without variables need no start, and get none. `initialise` forgets all starts.
        """
        name = start.sensor
        if name not in self._core.sensing.suite.names:
            return self._refuse_unknown(name)
        reason = self._core.sensing.why_no_start(start)
        if not reason and self._has_start(t_ns, name):
            reason = f"sensor {name!r} has a start of {t_ns} ns already"
        return self._refuse(f"{name}_refused", reason) if reason else self._insert(Event(t_ns, start))

    def update_sensor(self, reading: Reading) -> UpdateResult:
        """Correct the state at the time of a reading.

        One that cannot be used, comes twice, is of a sensor that has not begun or that fails, or does not pass the gate
        is counted and changes nothing. A sensor of places whose refused readings agree is believed again: see `regain`.
        """
        name = reading.sensor
        if name not in self._core.sensing.suite.names:
            return self._refuse_unknown(name)
        reason = self._core.sensing.why_unusable(reading)
        if not reason and self._has_reading(reading):
            reason = f"sensor {name!r} has a reading of {reading.t_ns} ns already"
        return self._refuse(f"{name}_refused", reason) if reason else self._insert(Event(reading.t_ns, reading))

    def agrees(self, reading: Reading) -> bool:
        """Return whether a reading would pass the gate, which changes nothing; False outside of the history."""
        state = self._state_then(reading.t_ns)
        if state is None or self._core.sensing.why_unusable(reading):
            return False
        return self._core.apply(state, Event(reading.t_ns, reading), self._rate_at(reading.t_ns), 0.0).accepted

    def own(self, name: str) -> tuple[Array, Array]:
        """Return values [V] and sigmas [V] of a sensor's own variables now; before it begins, what it assumes of them.

        Raises KeyError for a sensor that is not there.
        """
        values, covariance = self._core.sensing.own(name, self._state.own, self._t_ns)
        return values, np.sqrt(np.diag(covariance))

    def own_covariance(self, name: str) -> Array:
        """Return the covariance [V, V] of a sensor's own variables, as `own` has them."""
        return self._core.sensing.own(name, self._state.own, self._t_ns)[1]

    def body_at(self, t_ns: int) -> BodyState | None:
        """Return the body at a time within the history, as a sensor sees it; None outside of it."""
        state = self._state_then(t_ns)
        return None if state is None else body_of(t_ns, state.x, self._rate_at(t_ns))

    def _refuse_unknown(self, name: str) -> UpdateResult:
        names = ", ".join(self._core.sensing.suite.names)
        self._counts.setdefault("sensor_unknown", 0)  # a filter without sensors counts what it always did
        return self._refuse("sensor_unknown", f"no sensor is called {name!r}; there is {names or 'none'}")

    def _has_start(self, t_ns: int, name: str) -> bool:
        known = self._measurements_of(t_ns)
        return any(isinstance(start, OwnStart) and start.sensor == name for start in known)

    def _has_reading(self, reading: Reading) -> bool:
        """Return whether the same thing was measured at the same time: a radio may range several anchors at once."""
        channel = self._core.sensing.suite[reading.sensor].channel
        return any(
            isinstance(other, Reading)
            and other.sensor == reading.sensor
            and channel(other.values) == channel(reading.values)
            for other in self._measurements_of(reading.t_ns)
        )

    def _measurements_of(self, t_ns: int) -> list[object]:
        return [] if self._history is None else [event.measurement for event in self._history.of(t_ns)]
