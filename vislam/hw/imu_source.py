"""What every path to inertial chips shares: calibration, a watch over each sensor, temperature, faults, silence."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from vislam.config import SensorCalibration
from vislam.core.messages import Array, ImuSample, MagSample
from vislam.hw.affine import Affine
from vislam.hw.health import Health
from vislam.hw.timing import Clock, HostClock

# equal to the last bit in a row: noise at rest gives 10 at most in 40 minutes (LSM6DSOX at 2000 deg/s), a hung chip any
# number; samples are withheld from HELD on, a chip of STUCK ones hangs
HELD_SAMPLES, STUCK_SAMPLES = 20, 100
_NS = 1_000_000_000
_NOTHING = Health(0)


class Faults:
    """What went wrong.

    Attributes:
        counts: how often each fault occurred since the start.
        events: health bits of what happened since they were last taken.
    """

    def __init__(self) -> None:
        """Begin with none."""
        self.counts: Counter[str] = Counter()
        self.events = Health(0)

    def add(self, name: str, bits: Health = _NOTHING, times: int = 1) -> None:
        """Count a fault, with the bits that report it."""
        self.counts[name] += times
        self.events |= bits

    def taken(self) -> Health:
        """Return the events, and forget them."""
        events, self.events = self.events, Health(0)
        return events


class Watch:
    """Whether one sensor still measures, and within its range; judges samples before anything is made of them.

    Attributes:
        fault: bit of the health word of a sensor that hangs.
        limit: an axis at this value or beyond is saturated.
    """

    def __init__(self, name: str, faults: Faults) -> None:
        """Watch `gyro`, `accel` or `mag`, and count in `faults`."""
        self._name, self._faults = name, faults
        self.fault = Health[f"{name.upper()}_FAULT"]
        is_inertial = name != "mag"
        self._lost = Health.IMU_GAP if is_inertial else _NOTHING
        self._saturated = Health[f"{name.upper()}_SATURATED"] if is_inertial else _NOTHING
        self.limit = float("inf")
        self._last: Sequence[float] = ()
        self._repeats = 0  # equal samples in a row
        self.held, self.stuck = HELD_SAMPLES, STUCK_SAMPLES

    @property
    def is_held(self) -> bool:
        """Whether it has given the same for so long that its samples are withheld."""
        return self._repeats >= self.held

    @property
    def is_stuck(self) -> bool:
        """Whether it hangs."""
        return self._repeats >= self.stuck

    def begin(self) -> None:
        """The chip was set up again: it hangs no more, but nothing is given out until its value is another one."""
        self._repeats = min(self._repeats, self.held)

    def sound(self, rows: Sequence[Sequence[float]]) -> list[bool]:
        """Return which of new samples [N][3] can be used, in order; counts faults."""
        sound, beyond = [], 0
        for row in rows:
            self._repeats = self._repeats + 1 if row == self._last else 0
            self._last = row
            sound.append(not self.is_held)
            beyond += max(map(abs, row)) >= self.limit
        if beyond:
            self._faults.add(f"{self._name}_saturated", self._saturated, beyond)
        if not all(sound):
            self._faults.events |= self._lost
        if self.is_stuck:
            self._faults.add(f"{self._name}_stuck")
        return sound


class InertialSource:
    """An IMU, and its magnetometer if any, that yields calibrated body-frame samples stamped at capture.

    Attributes:
        rate_hz: samples per second.
        stamped_by: where the stamps come from, for a person; empty: not stated.
    """

    rate_hz: float
    stamped_by = ""

    def __init__(
        self,
        calibration: SensorCalibration,
        silent_s: float,
        most_change_c: float = float("inf"),
        clock: Clock | None = None,
    ) -> None:
        """Take settings; values are rad/s, m/s^2 and uT until `_scaled`.

        Args:
            calibration: from the axes of the chips to those of the body.
            silent_s: without a sample for so long, the IMU is missing.
            most_change_c: from the temperature at which biases were taken; beyond, TEMPERATURE_DRIFT is set.
            clock: the host's if None.

        Raises HardwareError for axes that name one twice.
        """
        self._clock: Clock = HostClock() if clock is None else clock
        self._calibration, self._silent_ns, self._most_change_c = calibration, round(silent_s * _NS), most_change_c
        self._faults = Faults()
        self._gyro, self._accel, self._field = (Watch(name, self._faults) for name in ("gyro", "accel", "mag"))
        self._temperature_c: float | None = None
        self._zero_c: float | None = None  # at which the gyro's biases were taken
        self._per_c: Array = np.zeros(3)  # by which they change, rad/s
        self._last_out_ns = self._clock.now_ns()  # when a sample was last given out
        self._scaled(1.0, 1.0)

    @property
    def temperature_c(self) -> float | None:
        """Temperature of the gyro, smoothed over a second; None before it was read, or where it has none."""
        return self._temperature_c

    def zeroed_at(self, temperature_c: float, gyro_per_c: Array) -> None:
        """Set at which temperature biases were taken, and by how much [3] the gyro's change per deg C (rad/s).

        From then on samples come without that drift, so that an estimator's bias stays what it was there.
        TEMPERATURE_DRIFT is set when it is far.
        """
        self._zero_c, self._per_c = temperature_c, np.asarray(gyro_per_c)

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return what was captured since the last call, in time order (CLOCK_MONOTONIC ns).

        Waits at most `timeout_s` for the first one; an empty list: none came, and `health` has the reason. A sensor
        that went away is looked for again in later calls. Never raises for what a plug or a cable can cause.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Give the device back; may be called twice."""
        raise NotImplementedError

    def health(self) -> Health:
        """Return the sensor bits that hold now; passing events (a gap, saturation) stay set until this call."""
        word = self._faults.taken()
        for watch in (self._gyro, self._accel, self._field):
            word |= watch.fault if watch.is_stuck else _NOTHING
        if self._clock.now_ns() - self._last_out_ns > self._silent_ns:
            word |= Health.IMU_MISSING
        return word | (Health.TEMPERATURE_DRIFT if abs(self._change_c()) > self._most_change_c else _NOTHING)

    def counters(self) -> dict[str, int]:
        """Return how often each fault occurred since the start."""
        return dict(self._faults.counts)

    def _scaled(self, gyro_rad_s: float, accel_m_s2: float, mag_ut: float = 1.0) -> None:
        """Take what a count of each sensor is worth."""
        c = self._calibration
        self._maps = (
            Affine.of(c.gyro_axes, c.gyro_matrix, c.gyro_bias_rad_s, gyro_rad_s),
            Affine.of(c.accel_axes, c.accel_matrix, c.accel_bias_m_s2, accel_m_s2),
            Affine.of(c.mag_axes, c.mag_matrix, c.mag_bias_ut, mag_ut),
        )

    def _warmed(self, found_c: float, gain: float = 1.0) -> None:
        """Take a temperature, smoothed."""
        before_c = found_c if self._temperature_c is None else self._temperature_c
        self._temperature_c = before_c + min(gain, 1.0) * (found_c - before_c)

    def _change_c(self) -> float:
        known = self._zero_c is not None and self._temperature_c is not None
        return self._temperature_c - self._zero_c if known else 0.0  # type: ignore[operator]

    def _inertial(self, t_ns: int, rate: Any, force: Any) -> ImuSample:
        """Return the sample of counts [3] and [3] that were judged, or of what lies between two of them."""
        gyro, accel, _ = self._maps
        return ImuSample(t_ns, gyro(rate) - self._per_c * self._change_c(), accel(force))

    def _magnetic(self, t_ns: int, field: Sequence[float], is_beyond: bool = False) -> list[MagSample]:
        """Return the sample of a new field [3] in counts; none of one that hangs or is beyond its range."""
        if is_beyond:
            self._faults.add("mag_overflow", Health.MAG_FAULT)
        elif self._field.sound([field])[0]:
            return [MagSample(t_ns, self._maps[2](field))]
        return []
